"""An arm is refused what it cannot do by name, when a task is loaded."""

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_tasks.arms import object_refusal, skill_refusal
from roboxim_tasks.choices import VectorChoice
from roboxim_tasks.components.robot import _reachable_box
from roboxim_tasks.config import task_config
from roboxim_tasks.motion import JAW_CLEARANCE_M, grasp_poses
from roboxim_tasks.skills import SKILLS

LIBRARY = ModelLibrary()
SO101 = LIBRARY.robot("so101")


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ({"skill": "open_drawer"}, "takes 3 rotations .* 'so101' has 5 joints and 2 rotations. Its skills are pick_up"),
        ({"skill": "push_object"}, "the gripper of 'so101' has one moving jaw"),
        (
            {
                "skill": "pick_up+close_drawer",
                "steps": [{"skill": "pick_up"}, {"skill": "close_drawer", "roles": {"target": "cabinet"}}],
                "objects": {"target": {"models": ["cube"]}, "cabinet": {"models": ["cabinet"]}},
            },
            "close_drawer leans the tool",
        ),
        ({"objects": {"target": {"models": ["apple"]}}}, "apple is 70 mm wide .* up to 50 mm wide; it grasps banana"),
        ({"objects": {"target": {"models": ["bowl"]}}}, "no grasp of the bowl has the tool pointing down"),
        ({"objects": {"target": {"models": ["bottle"]}}}, "approaches the bottle from 272 mm above the table"),
        ({"objects": {"target": {"modifiers": {"size": ["large"]}}}}, "cube is 58 mm wide"),
    ],
)
def test_what_an_arm_of_five_joints_with_one_jaw_lacks_is_said(task, said):
    with pytest.raises(ConfigError, match=said):
        task_config(task | {"robot": "so101"})


@pytest.mark.parametrize("robot_id", [i for i in LIBRARY.robot_ids if i != "so101"])
def test_the_other_arms_are_refused_nothing(robot_id):
    robot = LIBRARY.robot(robot_id)
    assert [name for name in SKILLS if skill_refusal(SKILLS[name], robot)] == []
    assert [i for i in LIBRARY.object_ids if object_refusal(LIBRARY.object(i), robot)] == []


def test_the_fixed_jaw_goes_beside_the_object():
    cube = LIBRARY.object("cube")
    for grasp in grasp_poses(cube, Pose(), Pose(), one_jaw=True)[:4]:
        _, beside, _ = grasp.inverse().position
        assert beside == pytest.approx(0.0225 + JAW_CLEARANCE_M, abs=1e-4)


def test_a_start_is_drawn_where_the_task_and_the_arm_agree():
    wanted = VectorChoice(lower=(0.41, -0.06, 0.26), upper=(0.53, 0.06, 0.38))
    found = _reachable_box(wanted, SO101.start)
    assert (found.lower, found.upper) == ((0.41, -0.06, 0.16), (0.49, 0.06, 0.20))
    assert _reachable_box(wanted, ()) is wanted


def test_an_arm_of_five_joints_reaches_the_place_first():
    from scipy.spatial.transform import Rotation

    arm = ArmKinematics(SO101)
    home = arm.fk(SO101.home)
    for axis in np.eye(3):
        turned = Rotation.from_rotvec(0.15 * axis) * home.rotation
        target = Pose.from_arrays(np.add(home.position, (0.01, 0.02, -0.02)), turned)
        found = arm.ik_near(target, SO101.home)
        assert found.placed
        assert arm.fk(found.joints).position == pytest.approx(target.position, abs=1e-6)
        assert found.rotation_error_rad <= 0.16
        assert arm.within_limits(found.joints)
    down = Pose.from_arrays(np.add(home.position, (0.01, 0.03, -0.05)), Rotation.from_euler("z", 0.5) * home.rotation)
    levelled = Pose(position=down.position, quat_xyzw=down.quat_xyzw)
    assert arm.ik_near(levelled, SO101.home).rotation_error_rad < 1e-4
