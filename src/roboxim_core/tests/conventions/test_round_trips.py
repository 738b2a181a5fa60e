"""What a convention says of an action or a state is read back as the same action or state."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionContext, ActionSemantics
from roboxim_core.actions.gripper import GripperSwitch
from roboxim_core.actions.transforms import convert_rows, target_of
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import ArmReadings, from_actions, load_convention, to_actions
from roboxim_core.errors import InvalidRequestError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose

NAMES = config_names("conventions")
END_EFFECTOR = [name for name in NAMES if not load_convention(name).semantics.control.is_joint_space]
JOINT_SPACE = sorted(set(NAMES) - set(END_EFFECTOR))


@lru_cache
def panda():
    return ArmKinematics(ModelLibrary().robot("panda"))


def poses(rng, count):
    """Return poses around the working pose, tilted by up to about 60 degrees."""
    tilt = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, (count, 3)))
    positions = np.array([0.5, 0.0, 0.3]) + rng.uniform(-0.1, 0.1, (count, 3))
    return list(map(Pose.from_arrays, positions, tilt * Rotation.from_quat([1.0, 0.0, 0.0, 0.0])))


def track(rng, count):
    joints = (map(tuple, rng.uniform(-2, 2, (count, 7)).tolist()) for _ in range(2))
    states = zip(poses(rng, count), poses(rng, count), *joints, strict=True)
    return [
        ActionContext(pose_commanded=a, pose_measured=b, joints_commanded=c, joints_measured=d) for a, b, c, d in states
    ]


def actions(rng, convention, count):
    """Return actions that the convention can express: rotations of up to 45 degrees, of 140 where it has no limit."""
    if convention.semantics.control.is_joint_space:
        motion = rng.uniform(-0.2, 0.2, (count, 7))
    else:
        motion = np.zeros((count, 6))
        motion[:, :3] = rng.uniform(-0.02, 0.02, (count, 3))
        angle = 0.49 if convention.action.rotation_range else 1.4
        if convention.name == "rt1_widowx" or convention.action.response:
            angle = 0.12 if convention.name == "rt1_widowx" else 0.05
        if convention.action.response:
            motion[:, :3] *= 0.5
        turn = rng.uniform(-angle, angle, (count, 3))
        motion[:, 3:] = Rotation.from_rotvec(turn).as_euler("xyz")
    openings = rng.uniform(0, 1, count)
    if convention.action.gripper.binary:
        gripper = convention.action.gripper  # one that stays after a change cannot follow openings at random
        openings = np.full(count, 1.0) if gripper.on_change or gripper.hold else np.round(openings)
    return np.column_stack([motion, openings])


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_actions_come_back(name, seed, count):
    """Test chunks of which each action has a state of its own, as in a recorded episode."""
    rng = np.random.default_rng(seed)
    convention = load_convention(name)
    states = track(rng, count)
    if convention.action.delta_base == "measured" and not convention.semantics.control.is_joint_space:
        # deltas to the measured pose must stay inside what the convention can say: keep the arm near its command
        lag = Rotation.from_rotvec(rng.uniform(-0.005, 0.005, (count, 3)))
        shift = rng.uniform(-0.005, 0.005, (count, 3))
        commanded = [state.pose_commanded for state in states]
        states = [
            ActionContext(pose_commanded=pose, pose_measured=Pose.from_arrays(pose.position + by, turn * pose.rotation))
            for pose, by, turn in zip(commanded, shift, lag, strict=True)
        ]
    given_actions = actions(rng, convention, count) * ([1] * 3 + [0.9] * 3 + [1] if name in END_EFFECTOR else [1] * 8)
    raw = from_actions(convention, given_actions, states)
    assert raw.shape == (count, convention.action.raw_size)
    back = to_actions(convention, raw, states)
    np.testing.assert_allclose(back, given_actions, atol=1e-9)
    numbers = np.asarray(raw, dtype=np.float32)  # as exports store them
    np.testing.assert_allclose(to_actions(convention, numbers, states), given_actions, atol=2e-6)


@pytest.mark.parametrize("name", END_EFFECTOR)
def test_a_chunk_from_one_state_comes_back_unless_its_deltas_need_later_measurements(name):
    convention = load_convention(name)
    rng = np.random.default_rng(1)
    given_actions = actions(rng, convention, 4) * [1, 1, 1, 0.5, 0.5, 0.5, 1]
    first = ActionContext(pose_commanded=poses(rng, 1)[0])
    if convention.action.delta_base == "measured":
        with pytest.raises(InvalidRequestError, match="measured"):
            from_actions(convention, given_actions, first)
    else:
        raw = from_actions(convention, given_actions, first)
        np.testing.assert_allclose(to_actions(convention, raw, first), given_actions, atol=1e-9)


@pytest.mark.parametrize("name", JOINT_SPACE)
def test_end_effector_actions_become_joint_actions_that_reach_the_same_poses(name):
    convention = load_convention(name)
    home = np.array(panda().model.home)
    rng = np.random.default_rng(2)
    joints = home + rng.uniform(-0.2, 0.2, (5, 7))
    source = ActionSemantics(rate_hz=convention.rate_hz)
    given_actions = np.column_stack([rng.uniform(-0.02, 0.02, (5, 6)), [1, 1, 0, 0, 1]])
    states = [
        ActionContext(
            pose_commanded=panda().fk(row), pose_measured=panda().fk(row), joints_commanded=tuple(row),
            joints_measured=tuple(row), kinematics=panda(),
        )
        for row in joints
    ]  # fmt: skip
    raw = from_actions(convention, given_actions, states, source=source)
    executed = to_actions(convention, raw, states)
    wanted = [target_of(row, source, state).pose for row, state in zip(given_actions, states, strict=True)]
    reached = convert_rows(
        executed,
        convention.semantics,
        ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw", rate_hz=convention.rate_hz),
        states,
    )
    np.testing.assert_allclose(reached[:, :3], [pose.position for pose in wanted], atol=1e-6)
    turns = Rotation.from_quat([pose.quat_xyzw for pose in wanted])
    assert (Rotation.from_quat(reached[:, 3:7]) * turns.inv()).magnitude().max() < 1e-5


def test_recorded_joints_are_used_instead_of_inverse_kinematics():
    """Test that an export's joint labels are bit for bit what the controller commanded, where it is known."""
    convention = load_convention("droid_position")
    rng = np.random.default_rng(3)
    joints, after = panda().model.home + rng.uniform(-0.3, 0.3, (3, 7)), rng.uniform(-1, 1, (3, 7))
    source = ActionSemantics(rate_hz=15)
    states = [
        ActionContext(pose_commanded=panda().fk(row), joints_commanded=tuple(row), joints_after=tuple(then))
        for row, then in zip(joints, after, strict=True)
    ]
    raw = from_actions(convention, np.zeros((3, 7)), states, source=source)
    np.testing.assert_array_equal(raw[:, :7], after)
    # an action that noise replaced: its joints are searched, here those that it stays at
    states[1] = replace(states[1], joints_after=None, kinematics=panda())
    raw = from_actions(convention, np.zeros((3, 7)), states, source=source)
    np.testing.assert_array_equal(raw[[0, 2], :7], after[[0, 2]])
    np.testing.assert_allclose(raw[1, :7], joints[1], atol=1e-5)


@pytest.mark.parametrize("name", [name for name in NAMES if load_convention(name).states])
def test_states_come_back(name):
    convention = load_convention(name)
    rng = np.random.default_rng(4)
    count = 30
    readings = ArmReadings(
        tcp_positions=rng.uniform(-1, 1, (count, 3)),
        tcp_rotations=Rotation.from_rotvec(rng.uniform(-1.2, 1.2, (count, 3))) * Rotation.from_quat([1.0, 0, 0, 0]),
        joint_positions=rng.uniform(-2, 2, (count, 7)), joint_velocities=rng.uniform(-2, 2, (count, 7)),
        openings=rng.uniform(0, 1, count),
    )  # fmt: skip
    stated = 0
    for state in convention.states:
        rows = state.rows(readings, convention.frames)
        assert rows.shape == (count, state.size(7)) == (count, len(state.names([f"j{i}" for i in range(7)])))
        known = state.split(rows, convention.frames, 7)
        if not np.isnan(known.tcp_positions).any():
            stated += 1
            np.testing.assert_allclose(known.tcp_positions, readings.tcp_positions, atol=1e-6)
        if known.tcp_rotations.magnitude().any():
            stated += 1
            assert (known.tcp_rotations * readings.tcp_rotations.inv()).magnitude().max() < 1e-5
        if known.joint_positions.size:
            stated += 1
            np.testing.assert_allclose(known.joint_positions, readings.joint_positions, atol=1e-6)
        if not np.isnan(known.openings).any():
            stated += 1
            np.testing.assert_allclose(known.openings, readings.openings, atol=1e-6)
    assert stated or name.startswith("groot_")  # whose states hold one number each


@pytest.mark.parametrize("control", ["end_effector_delta", "end_effector_absolute"])
@pytest.mark.parametrize("frame", ["robot_base", "tool"])
@pytest.mark.parametrize("rotation", ["euler_xyz_extrinsic", "rotation_vector", "rotation_6d", "quaternion_xyzw"])
@pytest.mark.parametrize("axes", ["[x, y, z]", "['-y', x, z]", "['-y', z, x]"])
def test_own_conventions_come_back(tmp_path, control, frame, rotation, axes):
    """Test every form of action that a user can write, with turned and with left-handed axes."""
    if control == "end_effector_absolute" and frame == "tool":
        return
    scaled = "\n  rotation_scale_rad: 0.7" if rotation in ("euler_xyz_extrinsic", "rotation_vector") else ""
    (tmp_path / "own.yaml").write_text(
        f"rate_hz: 10\nframes: {{base_axes: {axes}, tool_axes: {axes}, base_origin_m: [0.1, -0.2, 0.3]}}\n"
        f"action:\n  control: {control}\n  frame: {frame}\n  rotation: {rotation}\n  translation_scale_m: 0.3{scaled}\n"
    )
    convention = load_convention(str(tmp_path / "own.yaml"))
    rng = np.random.default_rng(5)
    states, count = track(rng, 20), 20
    given_actions = actions(rng, convention, count)
    raw = from_actions(convention, given_actions, states)
    np.testing.assert_allclose(to_actions(convention, raw, states), given_actions, atol=1e-9)


@pytest.mark.parametrize("control", ["end_effector_delta", "end_effector_absolute", "joint_delta", "joint_velocity"])
def test_actions_of_an_episode_come_back_each_with_the_state_before_it(control):
    rng = np.random.default_rng(6)
    states = track(rng, 8)
    for base in ("commanded", "measured"):
        semantics = ActionSemantics(control=control, delta_base=base, rotation="rotation_vector")
        start = ActionSemantics(control="joint_position" if "joint" in control else "end_effector_absolute")
        rows = rng.uniform(-1, 1, (8, 8 if "joint" in control else 7))
        converted = convert_rows(rows, start, semantics, states)
        back = convert_rows(convert_rows(converted, semantics, start, states), start, semantics, states)
        np.testing.assert_allclose(back, converted, atol=1e-9)
    with pytest.raises(InvalidRequestError, match="8 actions need the state before each, got 7"):
        convert_rows(rows, start, semantics, states[:7])


def test_the_switch_goes_on_over_the_chunks_of_an_episode():
    """Test a rule whose change needs agreement: the votes of one chunk count in the next."""
    convention = load_convention("libero")
    patient = replace(
        convention, action=replace(convention.action, gripper=replace(convention.action.gripper, agree=3))
    )
    states = track(np.random.default_rng(7), 2)
    closing = np.array([[0, 0, 0, 0, 0, 0, 1.0]] * 2)
    switch = GripperSwitch(patient.action.gripper.rule)
    openings = [to_actions(patient, closing, states, switch)[:, 6] for _ in range(2)]
    np.testing.assert_array_equal(openings, [[1, 1], [0, 0]])
