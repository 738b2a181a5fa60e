import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_core.poses import Pose, distance
from roboxim_planner.pipeline import Planner

FRACTIONS = st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7)


@given(FRACTIONS)
@settings(max_examples=60, deadline=None)
def test_fk_of_ik_is_the_pose(planner: Planner, fractions: list[float]) -> None:
    robot = planner.robot
    target = robot.fk(robot.lower + np.array(fractions) * (robot.upper - robot.lower))
    for joints in planner.ik.solve(target, planner.named_state("home"), seed=1):
        assert not robot.limit_violations(joints)
        assert distance(robot.fk(joints), target) == pytest.approx((0.0, 0.0), abs=2e-5)


def test_solutions_are_distinct_sorted_and_repeatable(planner: Planner) -> None:
    home = planner.named_state("home")
    target = planner.robot.fk(home + 0.3)
    found = planner.ik.solve(target, home, seed=3, rounds=2)
    gaps = np.abs(found - home).max(axis=1)
    assert len(found) >= 3
    assert (np.diff(gaps) >= 0).all()
    assert min(np.abs(a - b).max() for i, a in enumerate(found) for b in found[:i]) > 0.05
    assert np.array_equal(found, planner.ik.solve(target, home, seed=3, rounds=2))


def test_batched_kinematics_agree_with_pinocchio(planner: Planner) -> None:
    joints = np.random.default_rng(0).uniform(planner.robot.lower, planner.robot.upper, (20, 7))
    _, positions, jacobians = planner.ik._forward(joints)
    for q, position, jacobian in zip(joints, positions, jacobians, strict=True):
        assert position == pytest.approx(planner.robot.fk(q).position, abs=1e-12)
        assert jacobian == pytest.approx(planner.robot.kinematics.jacobian(q), abs=1e-12)


def test_out_of_reach_says_how_far(planner: Planner) -> None:
    with pytest.raises(PlannerError, match=r"within \d+\.\d mm") as caught:
        planner.ik.solve(Pose(position=(1.5, 0.0, 0.5)), planner.named_state("home"), seed=0)
    assert caught.value.code == ErrorCode.GOAL_UNREACHABLE
