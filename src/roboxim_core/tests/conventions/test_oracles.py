"""Every shipped convention gives the numbers that its source states; literal numbers, independent of our transforms."""

import numpy as np

from roboxim_core.actions import ActionContext
from roboxim_core.conventions import load_convention, to_actions
from roboxim_core.poses import Pose

DOWN = Pose(position=(0.5, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
AT_REST = ActionContext(
    pose_commanded=DOWN, pose_measured=DOWN, joints_commanded=(0.0,) * 7, joints_measured=(0.0,) * 7
)


def test_libero_moves_50_mm_in_x_and_opens():
    np.testing.assert_allclose(
        to_actions(load_convention("libero"), [1, 0, 0, 0, 0, 0, -1], AT_REST), [[0.05, 0, 0, 0, 0, 0, 1]], atol=1e-12
    )


def test_droid_velocity_turns_joint_1_by_02_rad_and_closes():
    np.testing.assert_allclose(
        to_actions(load_convention("droid_velocity"), [1, 0, 0, 0, 0, 0, 0, 1], AT_REST), [[0.2, *[0] * 7]], atol=1e-12
    )
