"""Transforms between action semantics preserve the target, and rotation deltas never jump."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roboxim_core.actions import (
    ANY_RATE,
    ActionContext,
    ActionSemantics,
    ActionTransform,
    ControlMode,
    DeltaBase,
    GripperConvention,
    ReferenceFrame,
    RotationRepresentation,
)
from roboxim_core.actions.transforms import target_of
from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError, ErrorCode, EvaluationError, InvalidRequestError
from roboxim_core.kinematics import ArmKinematics, DeltaController, delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, distance

JOINTS = 7


def every_semantics():
    """Return semantics that cover every meaning; the four gripper conventions alternate, as they are independent."""
    rotations = [r for r in RotationRepresentation if r != "none"]
    bases = [DeltaBase.COMMANDED, DeltaBase.MEASURED]
    found = {}
    for control, frame, rotation, base in product(ControlMode, ["robot_base", "tool"], rotations, bases):
        if control == ControlMode.END_EFFECTOR_ABSOLUTE and frame == "tool":
            continue
        gripper = list(GripperConvention)[len(found) % 4]
        semantics = ActionSemantics(control=control, frame=frame, rotation=rotation, delta_base=base, gripper=gripper)
        found.setdefault(replace(semantics, gripper=GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0), semantics)
    return list(found.values())


ALL = every_semantics()
END_EFFECTOR = [s for s in ALL if not s.control.is_joint_space]
JOINT_SPACE = [s for s in ALL if s.control.is_joint_space]

angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-1.0, 1.0)
unit = st.floats(0.0, 1.0)


@st.composite
def rotations(draw):
    return Rotation.from_euler("xyz", [draw(angles), draw(angles), draw(angles)])


@st.composite
def poses(draw):
    return Pose.from_arrays([draw(lengths), draw(lengths), draw(lengths)], draw(rotations()))


joints = st.tuples(*[st.floats(-3.0, 3.0)] * JOINTS)


@st.composite
def contexts(draw):
    return ActionContext(
        pose_commanded=draw(poses()), pose_measured=draw(poses()), joints_commanded=draw(joints),
        joints_measured=draw(joints),
    )  # fmt: skip


def same_target(a, b):
    if a.pose is not None:
        metres, radians = distance(a.pose, b.pose)
        assert metres < 1e-9
        assert radians < 2e-7  # the angle of two nearly equal rotations: the root of the rounding
    else:
        np.testing.assert_allclose(a.joints, b.joints, atol=1e-9)
    assert a.opening == pytest.approx(b.opening, abs=1e-12)


@st.composite
def pairs(draw):
    space = draw(st.sampled_from([END_EFFECTOR, JOINT_SPACE]))
    return draw(st.sampled_from(space)), draw(st.sampled_from(space))


@settings(max_examples=150, deadline=None)
@given(pairs(), contexts(), poses(), joints, unit)
def test_a_round_trip_keeps_the_meaning_of_every_action(pair, context, pose, ends_at, opening):
    source, target = pair
    start = ActionSemantics(control="joint_position" if source.control.is_joint_space else "end_effector_absolute")
    given = [*ends_at, opening] if source.control.is_joint_space else [
        *pose.position, *pose.rotation.as_euler("xyz"), opening
    ]  # fmt: skip
    action = ActionTransform.between(start, source).apply(given, context)
    assert action.shape == (source.dimension(JOINTS),)
    there = ActionTransform.between(source, target)
    converted = there.apply(action, context)
    same_target(target_of(action, source, context), target_of(converted, target, context))
    back = ActionTransform.between(target, source).apply(converted, context)
    same_target(target_of(back, source, context), target_of(action, source, context))


@pytest.mark.parametrize("source", ALL, ids=lambda s: f"{s.control}-{s.frame}-{s.rotation}-{s.delta_base}")
def test_the_meaning_is_kept_between_every_pair(source):
    """Test all pairs from one state, and some pairs across the two spaces with a real arm."""
    rng = np.random.default_rng(0)
    now, measured, ahead = (
        Pose.from_arrays(rng.uniform(-1, 1, 3), Rotation.random(random_state=int(rng.integers(1000)))) for _ in range(3)
    )
    q, measured_q, ahead_q = (tuple(rng.uniform(-1, 1, JOINTS).tolist()) for _ in range(3))
    context = ActionContext(
        pose_commanded=now, pose_measured=measured, joints_commanded=q, joints_measured=measured_q
    )  # fmt: skip
    in_joints = source.control.is_joint_space
    start = ActionSemantics(control="joint_position" if in_joints else "end_effector_absolute")
    given = [*ahead_q, 0.3] if in_joints else [*ahead.position, *ahead.rotation.as_euler("xyz"), 0.3]
    action = ActionTransform.between(start, source).apply(given, context)
    for target in ALL:
        transform = ActionTransform.between(source, target)
        crosses = source.control.is_joint_space != target.control.is_joint_space
        assert ("kinematics" in transform.needs) == transform.needs_kinematics == crosses
        if not crosses:
            converted = transform.apply(action, context)
            same_target(target_of(converted, target, context), target_of(action, source, context))
            # Away from seams, as here, the numbers are also equal.
            back = ActionTransform.between(target, source).apply(converted, context)
            np.testing.assert_allclose(back, action, atol=1e-6)
        else:
            with pytest.raises(InvalidRequestError, match="'kinematics', which the context lacks"):
                transform.apply(action, context)


@settings(max_examples=60, deadline=None)
@given(pairs(), st.data(), contexts(), poses(), joints)
def test_transforms_compose(pair, data, context, pose, ends_at):
    a, b = pair
    c = data.draw(st.sampled_from(JOINT_SPACE if a.control.is_joint_space else END_EFFECTOR))
    start = ActionSemantics(control="joint_position" if a.control.is_joint_space else "end_effector_absolute")
    given = [*ends_at, 0.5] if a.control.is_joint_space else [*pose.position, *pose.rotation.as_euler("xyz"), 0.5]
    action = ActionTransform.between(start, a).apply(given, context)
    first, second = ActionTransform.between(a, b), ActionTransform.between(b, c)
    one_by_one = second.apply(first.apply(action, context), context)
    at_once = ActionTransform.between(a, c).apply(action, context)
    same_target(target_of(at_once, c, context), target_of(one_by_one, c, context))


@settings(max_examples=100, deadline=None)
@given(
    rotations(),
    st.tuples(lengths, lengths, lengths).filter(lambda axis: np.linalg.norm(axis) > 0.1),
    st.floats(-0.2, 0.2),
    st.sampled_from([s for s in END_EFFECTOR if s.control == ControlMode.END_EFFECTOR_DELTA]),
)
def test_a_rotation_delta_never_jumps(now, axis, angle, semantics):
    """In every pose, also across a seam of the pose's numbers, a small rotation is a small delta."""
    turn = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)
    context = ActionContext(
        pose_commanded=Pose.from_arrays(np.zeros(3), now), pose_measured=Pose.from_arrays(np.zeros(3), now)
    )
    absolute = ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw")
    # Both signs of a quaternion are the same rotation, so the meaning must not depend on the sign.
    for sign in (1.0, -1.0):
        quaternion = sign * (turn * now).as_quat()
        action = ActionTransform.between(absolute, semantics).apply([0, 0, 0, *quaternion, 1], context)
        still = ActionTransform.between(absolute, semantics).apply([0, 0, 0, *now.as_quat(), 1], context)
        assert np.linalg.norm(action - still) <= 1.5 * abs(angle) + 1e-7


def test_euler_deltas_do_not_jump_where_the_pose_s_angles_do():
    above, below = (Pose.from_arrays(np.zeros(3), Rotation.from_euler("xyz", [a, 0, 0])) for a in (3.14, -3.14))
    assert np.abs(above.rotation.as_euler("xyz") - below.rotation.as_euler("xyz")).max() > 6.0
    action = delta_between(above, below, 1.0)
    transform = ActionTransform.between(
        ActionSemantics(control="end_effector_absolute", rotation="euler_xyz_extrinsic"), ActionSemantics()
    )
    converted = transform.apply([0, 0, 0, -3.14, 0, 0, 1], ActionContext(pose_commanded=above))
    np.testing.assert_allclose(converted, action, atol=1e-7)
    assert np.abs(converted[3:6]).max() == pytest.approx(2 * np.pi - 6.28)


def test_a_chunk_of_deltas_becomes_the_poses_that_the_controller_commands():
    arm = ArmKinematics(ModelLibrary().robot("panda"))
    controller = DeltaController(arm)
    rng = np.random.default_rng(1)
    actions = np.hstack([rng.uniform(-0.01, 0.01, (6, 6)), np.ones((6, 1))]).astype(np.float32)
    start = controller.start(arm.model.home)
    transform = ActionTransform.between(ActionSemantics(), ActionSemantics(control="end_effector_absolute"))
    rows = transform.apply_chunk(actions, ActionContext(pose_commanded=start.pose))
    state = start
    for row, action in zip(rows, actions, strict=True):
        state = controller.step(state, action).state
        np.testing.assert_allclose(row[:3], state.pose.position, atol=1e-9)
        reached = Rotation.from_euler("xyz", row[3:6])
        assert (reached * state.pose.rotation.inv()).magnitude() < 1e-7
    back = ActionTransform.between(transform.target, transform.source).apply_chunk(
        rows, ActionContext(pose_commanded=start.pose)
    )
    np.testing.assert_allclose(back, actions, atol=1e-6)
    measured = replace(ActionSemantics(), delta_base="measured")
    with pytest.raises(InvalidRequestError, match="pose_measured"):
        ActionTransform.between(measured, ActionSemantics()).apply_chunk(
            actions, ActionContext(pose_commanded=start.pose, pose_measured=start.pose)
        )


@pytest.mark.parametrize("source", ["end_effector_delta", "end_effector_absolute"])
@pytest.mark.parametrize("target", ["joint_position", "joint_velocity", "joint_delta"])
def test_across_the_spaces_kinematics_tell(source, target):
    arm = ArmKinematics(ModelLibrary().robot("panda"))
    home = arm.model.home
    ahead = tuple(np.add(home, 0.02).tolist())
    context = ActionContext(
        pose_commanded=arm.fk(home), joints_commanded=home, joints_measured=home, kinematics=arm
    )  # fmt: skip
    into_joints = ActionTransform.between(ActionSemantics(control=source), ActionSemantics(control=target))
    pose = arm.fk(ahead)
    absolute = [*pose.position, *pose.rotation.as_euler("xyz"), 1.0]
    action = ActionTransform.between(
        ActionSemantics(control="end_effector_absolute"), into_joints.source
    ).apply(absolute, context)  # fmt: skip
    there = into_joints.apply(action, context)
    np.testing.assert_allclose(
        ActionTransform.between(into_joints.target, into_joints.source).apply(there, context), action, atol=5e-6
    )  # by FK, to IK's tolerance
    far = Pose(position=(3.0, 0.0, 0.0), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidRequestError, match=r"no joints near.*mm") as caught:
        ActionTransform.between(ActionSemantics(control="end_effector_absolute"), into_joints.target).apply(
            [*far.position, *far.rotation.as_euler("xyz"), 1.0], context
        )
    assert caught.value.code == ErrorCode.INVALID_ACTION


def test_a_joint_velocity_is_a_motion_per_tick():
    context = ActionContext(joints_commanded=(0.0, 1.0))
    transform = ActionTransform.between(
        ActionSemantics(control="joint_velocity", rate_hz=20), ActionSemantics(control="joint_delta", rate_hz=20)
    )
    assert transform.apply([1.0, -2.0, 0.0], context).tolist() == pytest.approx([0.05, -0.1, 0.0])
    with pytest.raises(EvaluationError, match="set rate_hz"):
        ActionTransform.between(
            ActionSemantics(control="joint_velocity", rate_hz=ANY_RATE),
            ActionSemantics(control="joint_delta", rate_hz=ANY_RATE),
        )


def test_gripper_conventions():
    numbers = {convention: (convention.number(1.0), convention.number(0.0)) for convention in GripperConvention}
    assert list(numbers.values()) == [(1, 0), (0, 1), (1, -1), (-1, 1)]
    assert [convention.opening(0.5) for convention in GripperConvention] == [0.5, 0.5, 0.75, 0.25]


def test_sizes_and_names():
    names = ("a", "b")
    assert ActionSemantics().component_names() == ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
    absolute = ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw")
    assert absolute.component_names() == ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
    assert ActionSemantics(control="joint_velocity").component_names(names) == ("a.velocity", "b.velocity", "gripper")
    for semantics in ALL:
        assert len(semantics.component_names(names)) == semantics.dimension(2)
    with pytest.raises(InvalidRequestError, match="depends on the robot"):
        ActionSemantics(control="joint_delta").dimension()


def test_values_are_closed_and_canonical():
    joint = ActionSemantics(control="joint_position", rotation="quaternion_xyzw")
    assert joint == ActionSemantics(control=ControlMode.JOINT_POSITION)
    assert (joint.frame, joint.rotation, joint.delta_base) == (ReferenceFrame.NONE, "none", DeltaBase.NONE)
    for semantics in ALL:
        assert from_plain(to_plain(semantics), ActionSemantics) == semantics
    with pytest.raises(InvalidRequestError, match=r"gripper: unknown value 'open'; expected one of: absolute_open_0"):
        ActionSemantics(gripper="open")
    with pytest.raises(ConfigError, match=r"rotation.*euler_xyz_extrinsc.*did you mean 'euler_xyz_extrinsic'"):
        from_plain({"rotation": "euler_xyz_extrinsc"}, ActionSemantics)
    with pytest.raises(InvalidRequestError, match="needs one, got 'none'"):
        ActionSemantics(rotation="none")
    with pytest.raises(InvalidRequestError, match="absolute pose in the tool"):
        ActionSemantics(control="end_effector_absolute", frame="tool")
    for bad in ({"rate_hz": -1.0}, {"rate_hz": float("nan")}, {"max_rotation_rad": 0.0}):
        with pytest.raises(InvalidRequestError, match=next(iter(bad))):
            ActionSemantics(**bad)


@pytest.mark.parametrize(
    ("change", "fields", "advice"),
    [
        ({"gripper": "absolute_open_0_closed_1"}, "gripper: 'absolute_open_0_closed_1' against", "a transform exists:"),
        ({"delta_base": "measured"}, "delta_base: 'measured' against 'commanded'", "a transform exists:"),
        ({"control": "joint_delta"}, "control: 'joint_delta' against", "exists that needs the kinematics"),
        ({"rate_hz": 5.0}, "rate_hz: 5.0 against 10.0", "no transform exists"),
    ],
)
def test_a_mismatch_is_refused_by_field_and_says_whether_a_transform_exists(change, fields, advice):
    with pytest.raises(EvaluationError) as caught:
        ActionSemantics(**change).require_compatible(ActionSemantics(), owner="a", other_owner="b")
    assert caught.value.code == ErrorCode.SEMANTICS_MISMATCH
    assert fields in str(caught.value)
    assert advice in str(caught.value)
    if "rate_hz" in change:
        with pytest.raises(EvaluationError, match="no transform"):
            ActionTransform.between(ActionSemantics(**change), ActionSemantics())


def test_any_rate_fits_every_rate_and_limits_may_differ():
    ActionSemantics(rate_hz=ANY_RATE).require_compatible(ActionSemantics(rate_hz=5.0), owner="a", other_owner="b")
    ActionSemantics(max_translation_m=0.01).require_compatible(ActionSemantics(), owner="a", other_owner="b")


def test_numbers_that_are_not_a_rotation_are_refused():
    context = ActionContext(pose_commanded=Pose())
    for rotation, numbers in (
        ("quaternion_xyzw", [0, 0, 0, 0]), ("rotation_6d", [0, 0, 0, 1, 0, 0]), ("rotation_6d", [1, 0, 0, 2, 0, 0]),
    ):  # fmt: skip
        transform = ActionTransform.between(ActionSemantics(rotation=rotation), ActionSemantics())
        with pytest.raises(InvalidRequestError, match=f"not a valid {rotation}"):
            transform.apply([0, 0, 0, *numbers, 1], context)
    with pytest.raises(InvalidRequestError, match="7 finite numbers"):
        ActionTransform.between(ActionSemantics(), ActionSemantics(frame="tool")).apply([0] * 6, context)
