"""Proprioception has no seam in the robot's working range, and names its components."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose, distance
from roboxim_core.proprioception import STATE_NAMES, Proprioception, ProprioField
from roboxim_core.rotation.representations import (
    RotationRepresentation,
    decode,
    encode,
    gripper_down,
)
from roboxim_core.state import RobotState, StateRecord

ROTATION_FIELDS = (ProprioField.TCP_ROTATION_6D, ProprioField.TCP_QUATERNION_XYZW, ProprioField.TCP_EULER_XYZ)


def state(pose: Pose) -> StateRecord:
    robot = RobotState(
        joint_names=("a", "b"), joint_positions=(0.1, 0.2), joint_velocities=(0.3, 0.4), joint_commands=(0.1, 0.2),
        pose_tcp_measured=pose, pose_tcp_commanded=IDENTITY, gripper_opening=0.5, gripper_command=1.0,
    )  # fmt: skip
    return StateRecord(episode_id="e", seq=0, stamp_ns=0, robot=robot)


def test_it_holds_the_measured_state_in_the_base():
    base = Pose(position=(1.0, 0.0, 0.0), quat_xyzw=(0.0, 0.0, 1.0, 0.0))
    pose = Pose.from_arrays([0.5, 0.2, 0.3], Rotation.from_euler("xyz", [3.0, 0.1, 1.0]))
    proprio = Proprioception.of(state(base @ pose), base)
    assert np.allclose(distance(proprio.tcp_pose, pose), 0.0, atol=1e-7)
    assert proprio.vector().dtype == np.float32
    assert proprio.vector()[:9] == pytest.approx([*pose.position, *pose.matrix[:3, 0], *pose.matrix[:3, 1]], abs=1e-6)
    assert proprio.vector()[9] == 0.5
    assert len(STATE_NAMES) == 10
    fields = ("joint_positions", "joint_velocities", "gripper_opening")
    assert proprio.vector(fields).tolist() == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert proprio.component_names(fields) == (
        "a.position",
        "b.position",
        "a.velocity",
        "b.velocity",
        "gripper.opening",
    )
    for field in ProprioField:
        assert len(proprio.component_names([field])) == proprio.vector([field]).size
        assert np.array_equal(proprio.vector(field), proprio.vector([field]))
    with pytest.raises(InvalidRequestError, match="did you mean 'tcp_position'"):
        proprio.vector(["tcp_positon"])


@pytest.mark.parametrize(
    "bad", [{"tcp_position": (0.0, 0.0)}, {"joint_names": ("a",)}, {"gripper_opening": float("nan")}]
)
def test_what_is_not_whole_is_refused(bad):
    with pytest.raises(InvalidRequestError, match="proprioception"):
        Proprioception(**bad)


tilts = st.floats(-1.4, 1.4)


@settings(max_examples=100, deadline=None)
@given(tilts, tilts, st.floats(-1.5, 1.5), st.tuples(*[st.floats(-0.1, 0.1)] * 3), st.sampled_from(ROTATION_FIELDS))
def test_around_the_working_pose_no_representation_jumps(roll, pitch, yaw, turn, field):
    """The gripper points down, tilted by up to 80 degrees, at any yaw within a quarter turn."""
    tilt = Rotation.from_euler("zyx", [yaw, 0.0, 0.0]) * Rotation.from_rotvec(np.array([roll, pitch, 0.0]) / 2)
    before = tilt * gripper_down()
    after = Rotation.from_rotvec(turn) * before
    a, b = (Proprioception.of(state(Pose.from_arrays([0, 0, 0], r))).vector([field]) for r in (before, after))
    assert np.abs(a - b).max() <= 4.0 * np.linalg.norm(turn) + 1e-5


def test_a_quaternion_with_positive_w_jumps_where_this_one_does_not():
    before, after = (Rotation.from_euler("xyz", [np.pi + a, 0, 0.3]) for a in (-0.01, 0.01))
    old = [rotation.as_quat(canonical=True) for rotation in (before, after)]
    new = [encode(r, RotationRepresentation.QUATERNION_XYZW, gripper_down()) for r in (before, after)]
    assert np.abs(old[0] - old[1]).max() > 1.9
    assert np.abs(new[0] - new[1]).max() < 0.02


@settings(max_examples=100, deadline=None)
@given(
    st.tuples(*[st.floats(-np.pi, np.pi)] * 3),
    st.sampled_from([r for r in RotationRepresentation if r != "none"]),
    st.sampled_from([Rotation.identity(), gripper_down()]),
)
def test_a_rotation_is_read_back_as_written(angles, representation, near):
    rotation = Rotation.from_euler("xyz", angles)
    numbers = encode(rotation, representation, near)
    assert numbers.shape == (representation.size,)
    np.testing.assert_allclose(decode(numbers, representation).as_matrix(), rotation.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
@pytest.mark.parametrize("representation", ["euler_xyz_extrinsic", "euler_xyz_intrinsic"])
def test_a_horizontal_gripper_loses_no_accuracy_in_euler_angles(pitch, representation):
    kind = RotationRepresentation(representation)
    rotation = Rotation.from_matrix(
        Rotation.from_euler("xyz" if "extrinsic" in representation else "XYZ", [0.4, pitch, -1.1]).as_matrix()
    )
    again = decode(encode(rotation, kind), kind)
    np.testing.assert_allclose(again.as_matrix(), rotation.as_matrix(), atol=1e-9)
