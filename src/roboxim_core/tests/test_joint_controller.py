"""The joint controller: targets, limits, exact repetition, workspace."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.kinematics import ArmKinematics, JointController
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import WorkspaceSpec

ARM = ArmKinematics(ModelLibrary().robot("panda"))
UR5 = ArmKinematics(ModelLibrary().robot("ur5"))
HOME = np.array(ARM.model.home)
WIDE = WorkspaceSpec(lower=(-2.0, -2.0, -2.0), upper=(2.0, 2.0, 2.0))
POSITION = ActionSemantics(control="joint_position", rate_hz=15.0)
VELOCITY = ActionSemantics(control="joint_velocity", rate_hz=15.0)
MEASURED = replace(VELOCITY, delta_base="measured")
DELTA = ActionSemantics(control="joint_delta", rate_hz=15.0)


def controller(semantics, workspace=WIDE, arm=ARM):
    return JointController(arm, semantics=semantics, workspace=workspace)


def moved(joint, by):
    return [by if index == joint else 0.0 for index in range(7)]


@pytest.mark.parametrize(
    ("semantics", "action"),
    [
        (POSITION, [*(HOME + moved(0, 0.1)), 1.0]),
        (VELOCITY, [*moved(0, 1.5), 1.0]),
        (DELTA, [*moved(0, 0.1), 1.0]),
    ],
)
def test_each_control_mode_reaches_the_same_joints(semantics, action):
    made = controller(semantics)
    step = made.step(made.start(HOME), action)
    np.testing.assert_allclose(step.state.joints, HOME + moved(0, 0.1), atol=1e-6)
    assert (step.clipped, step.left_workspace, step.state.gripper) == (False, False, 1.0)
    assert step.state.pose == ARM.fk(step.state.joints)


def test_the_measured_base_is_where_the_arm_is_not_where_it_was_sent():
    made = controller(MEASURED)
    step = made.step(made.start(HOME), [*moved(0, 1.5), 0.0], tuple(HOME - moved(0, 0.02)))
    np.testing.assert_allclose(step.state.joints, HOME + moved(0, 0.08), atol=1e-6)


def test_a_motion_beyond_the_speed_limit_keeps_its_direction_and_counts_as_clipped():
    made = controller(DELTA)
    wanted = np.array(moved(0, 0.4)) + moved(1, 0.1)
    step = made.step(made.start(HOME), [*wanted, 1.0])
    done = np.array(step.state.joints) - HOME
    assert step.clipped
    assert done[0] == pytest.approx(ARM.velocity[0] / 15.0, abs=1e-6)
    assert done[1] == pytest.approx(done[0] / 4, abs=1e-6)


def test_joints_and_opening_stay_within_their_limits():
    made = controller(POSITION)
    high = ARM.upper - moved(6, 0.05)
    step = made.step(made.start(high), [*(high + moved(6, 0.1)), 1.4])
    assert step.clipped
    assert ARM.within_limits(step.state.joints)
    assert (step.state.joints[6], step.state.gripper) == (pytest.approx(ARM.upper[6]), 1.0)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([POSITION, VELOCITY, MEASURED, DELTA, replace(DELTA, delta_base="measured")]),
    st.lists(st.floats(-4.0, 4.0), min_size=8, max_size=8),
    st.integers(0, 100),
)
def test_the_executed_action_gives_the_same_bits_again(semantics, action, seed):
    rng = np.random.default_rng(seed)
    start = rng.uniform(ARM.lower, ARM.upper)
    made = controller(semantics, WorkspaceSpec())
    state, measured = made.start(start), tuple(start + rng.normal(0, 0.01, 7))
    first = made.step(state, action, measured)
    again = made.step(state, np.array(first.action_executed, np.float32), measured)
    assert (again.state, again.action_executed) == (first.state, first.action_executed)
    assert not again.clipped
    assert ARM.within_limits(first.state.joints)
    assert np.all(np.abs(np.subtract(first.state.joints, start)) <= ARM.velocity / 15.0 + 1e-5)


def test_the_tool_stops_at_the_workspaces_border():
    floor = ARM.fk(HOME).position[2] - 0.01
    made = controller(DELTA, WorkspaceSpec(lower=(-2.0, -2.0, floor), upper=(2.0, 2.0, 2.0)))
    state = made.start(HOME)
    for _ in range(4):
        step = made.step(state, [*moved(1, 0.05), 1.0])
        state = step.state
    assert step.left_workspace
    assert state.pose.position[2] == pytest.approx(floor, abs=1e-6)


def test_a_wrong_number_of_joints_is_refused_by_name():
    made = controller(replace(VELOCITY, rate_hz=10.0), arm=UR5)
    with pytest.raises(
        InvalidRequestError, match=r"is 7 numbers \(ur5_shoulder_pan_joint.velocity.*gripper\), got"
    ) as error:
        made.step(made.start(UR5.model.home), np.zeros(8))
    assert error.value.code == ErrorCode.INVALID_ACTION


def test_a_measured_base_needs_the_measurement():
    made = controller(MEASURED)
    with pytest.raises(InvalidRequestError, match="joints_measured"):
        made.step(made.start(HOME), np.zeros(8))
