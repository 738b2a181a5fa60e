"""Kinematics and the delta controller."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionSemantics, hold_action
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError
from roboxim_core.kinematics import ArmKinematics, DeltaController, delta_between
from roboxim_core.kinematics.controller import ControlStep
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import WorkspaceSpec

LIBRARY = ModelLibrary()
ARM = ArmKinematics(LIBRARY.robot("panda"))
HOME = ARM.model.home
CONTROLLER = DeltaController(ARM)


def _apart(a: Pose, b: Pose, position_m: float, rotation_rad: float) -> bool:
    translation, rotation = distance(a, b)
    return translation > position_m or rotation > rotation_rad


def _random_joints(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(ARM.lower, ARM.upper)


def test_fk_of_the_panda_agrees_with_its_data_sheet() -> None:
    """Denavit-Hartenberg parameters of the maker (modified convention), flange to TCP 0.2104 m and -45 degrees."""
    a = [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
    d = [0.333, 0, 0.316, 0, 0.384, 0, 0]
    alpha = [0, -math.pi / 2, math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, math.pi / 2]
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = _random_joints(rng)
        expected = np.eye(4)
        for i in range(7):
            turn = Pose.from_arrays([a[i], 0, 0], Rotation.from_euler("x", alpha[i])).matrix
            screw = Pose.from_arrays([0, 0, d[i]], Rotation.from_euler("z", joints[i])).matrix
            expected = expected @ turn @ screw
        tcp = Pose.from_arrays([0, 0, 0.107 + 0.1034], Rotation.from_euler("z", -math.pi / 4)).matrix
        assert ARM.fk(joints).matrix == pytest.approx(expected @ tcp, abs=1e-9)


def test_jacobian_is_the_derivative_of_fk() -> None:
    rng = np.random.default_rng(1)
    joints, step = _random_joints(rng), 1e-6
    jacobian = ARM.jacobian(joints)
    here = ARM.fk(joints)
    for i in range(7):
        there = ARM.fk(joints + step * np.eye(7)[i])
        linear = np.subtract(there.position, here.position) / step
        angular = (there.rotation * here.rotation.inv()).as_rotvec() / step
        assert jacobian[:, i] == pytest.approx([*linear, *angular], abs=1e-4)


def test_ik_follows_a_near_target_within_limits() -> None:
    rng = np.random.default_rng(2)
    reached = 0
    for _ in range(100):
        joints = ARM.lower + (ARM.upper - ARM.lower) * rng.uniform(0.1, 0.9, 7)
        target = ARM.fk(joints + rng.normal(scale=0.03, size=7))
        result = ARM.ik_near(target, joints)
        assert ARM.within_limits(result.joints)
        if result.converged:
            reached += 1
            assert not _apart(ARM.fk(result.joints), target, 1e-6, 1e-5)
    assert reached >= 97


def test_ik_names_what_it_missed_and_stays_within_limits() -> None:
    result = ARM.ik_near(Pose(position=(2.0, 0.0, 0.5)), HOME)
    assert not result.converged
    assert result.position_error_m > 0.5
    assert ARM.within_limits(result.joints)


def test_posture_pull_keeps_the_pose() -> None:
    turned = np.array(HOME) + [0.4, 0, -0.4, 0, 0, 0, 0]
    target = ARM.fk(turned)
    joints = turned
    for _ in range(200):
        joints = ARM.ik_near(target, joints, posture=HOME).joints
    assert distance(ARM.fk(joints), target)[0] < 1e-6
    assert np.linalg.norm(joints - HOME) < np.linalg.norm(turned - HOME)


small = st.floats(-0.08, 0.08)
angle = st.floats(-0.4, 0.4)
actions = st.tuples(small, small, small, angle, angle, angle, st.floats(-0.2, 1.2))


def rolled_out(controller: DeltaController, sequence: list[tuple[float, ...]]) -> list[ControlStep]:
    """Return the steps of consecutive actions from rest at home."""
    state, steps = controller.start(HOME), []
    for action in sequence:
        steps.append(controller.step(state, action))
        state = steps[-1].state
    return steps


@settings(max_examples=60, deadline=None)
@given(st.lists(actions, min_size=1, max_size=6))
def test_executed_actions_replay_to_the_same_bits(sequence: list[tuple[float, ...]]) -> None:
    steps = rolled_out(CONTROLLER, sequence)
    again = rolled_out(DeltaController(ARM), [step.action_executed for step in steps])
    assert [s.state for s in again] == [s.state for s in steps]
    assert [s.action_executed for s in again] == [s.action_executed for s in steps]
    assert not any(step.clipped for step in again)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-0.025, 0.025)] * 3), st.tuples(*[st.floats(-0.12, 0.12)] * 3), st.floats(-math.pi, math.pi)
)
def test_delta_between_inverts_a_step(shift: tuple[float, ...], turn: tuple[float, ...], yaw: float) -> None:
    start = CONTROLLER.start([*HOME[:6], HOME[6] + yaw / 2])
    wanted = Pose.from_arrays(
        np.add(start.pose.position, shift), Rotation.from_euler("xyz", turn) * start.pose.rotation
    )
    action = delta_between(start.pose, wanted, 0.5)
    assert np.abs(action[:6]).max() < 0.2  # no jump, although roll of the tool is about pi
    step = CONTROLLER.step(start, action)
    assert not step.clipped
    if not step.unreached:
        assert not _apart(step.state.pose, wanted, 1e-7, 1e-6)


def test_commanded_pose_is_what_the_joints_reach() -> None:
    rng = np.random.default_rng(3)
    state = CONTROLLER.start(HOME)
    for _ in range(60):
        action = rng.normal(scale=[0.012] * 3 + [0.05] * 3 + [0.0]).astype(np.float32)
        state = CONTROLLER.step(state, action).state
        assert not _apart(ARM.fk(state.joints), state.pose, 1e-6, 1e-5)


def test_limits_clip_to_the_norm_and_are_counted() -> None:
    start = CONTROLLER.start(HOME)
    step = CONTROLLER.step(start, [0.06, 0.0, -0.08, 0.0, 0.0, 0.0, 1.0])
    assert step.clipped
    assert step.action_executed[:3] == pytest.approx((0.03, 0.0, -0.04), abs=1e-7)
    step = CONTROLLER.step(start, [0.0, 0.0, 0.0, 0.4, -0.3, 0.2, 1.0])
    assert step.clipped
    assert distance(start.pose, step.state.pose)[1] == pytest.approx(0.25, abs=1e-6)
    step = CONTROLLER.step(start, [0.0] * 6 + [1.3])
    assert step.clipped
    assert step.state.gripper == 1.0


def test_hold_stays_to_the_bit() -> None:
    start = CONTROLLER.step(CONTROLLER.start(HOME), [0.01, 0.0, 0.0, 0.0, 0.1, 0.0, 1.0]).state
    assert CONTROLLER.step(start, hold_action(1.0)).state == start


def test_workspace_clamps_and_says_so_also_for_a_moved_base() -> None:
    base = Pose.from_arrays([0.3, -0.2, 0.1], Rotation.from_euler("z", 0.5))
    box = WorkspaceSpec(lower=(-1.0, -1.0, 0.05), upper=(1.5, 1.0, 1.0))
    controller = DeltaController(ARM, workspace=box, pose_base_in_world=base)
    state = controller.start(HOME)
    left = []
    for _ in range(12):
        step = controller.step(state, [0.0, 0.0, -0.05, 0.0, 0.0, 0.0, 1.0])
        state = step.state
        left.append(step.left_workspace)
    assert left[0] is False
    assert left[-1] is True
    assert (base @ state.pose).position[2] == pytest.approx(0.05, abs=1e-6)


def test_unreachable_pose_is_said_and_the_command_stays_reachable() -> None:
    controller = DeltaController(ARM, workspace=WorkspaceSpec(lower=(-2, -2, -2), upper=(2, 2, 2)))
    state, unreached = controller.start(HOME), False
    for _ in range(20):
        step = controller.step(state, [0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        unreached |= step.unreached
        state = step.state
        assert distance(ARM.fk(state.joints), state.pose)[0] < 1e-6
    assert unreached
    assert state.pose.position[0] < 0.9


def test_joints_never_move_faster_than_their_limits() -> None:
    rng = np.random.default_rng(4)
    state = CONTROLLER.start(HOME)
    for _ in range(40):
        following = CONTROLLER.step(state, [*rng.normal(scale=0.05, size=3), *rng.normal(scale=0.2, size=3), 1.0]).state
        speed = np.abs(np.subtract(following.joints, state.joints)) * ActionSemantics().rate_hz
        assert np.all(speed <= ARM.velocity + 1e-9)
        state = following


@pytest.mark.parametrize("action", [[0.0] * 6, [[0.0] * 7] * 2, [math.nan] + [0.0] * 6, ["a"] * 7])
def test_malformed_action_is_refused(action: object) -> None:
    with pytest.raises(InvalidRequestError) as caught:
        CONTROLLER.step(CONTROLLER.start(HOME), action)
    assert caught.value.code == ErrorCode.INVALID_ACTION


def test_a_continuous_joint_is_refused_and_not_placed_wrongly(tmp_path: Path) -> None:
    """Pinocchio places a continuous joint by its cosine and sine."""
    model = LIBRARY.robot("panda")
    text = model.urdf.read_text()
    changed = re.sub(rf'(<joint name="{model.joint_names[6]}" type=")revolute', r"\1continuous", text)
    assert changed != text
    (tmp_path / "panda.urdf").write_text(changed)
    with pytest.raises(ConfigError, match=f"joint '{model.joint_names[6]}' has 2 numbers, expected 1: a continuous"):
        ArmKinematics(replace(model, urdf=tmp_path / "panda.urdf"))
