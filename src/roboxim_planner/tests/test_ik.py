import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_core.poses import Pose, distance
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import PlanningScene

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
    found = planner.ik.solve(target, home, seed=3, thorough=True)
    gaps = np.abs(found - home).max(axis=1)
    assert len(found) >= 3
    assert (np.diff(gaps) >= 0).all()
    assert min(np.abs(a - b).max() for i, a in enumerate(found) for b in found[:i]) > 0.05
    assert np.array_equal(found, planner.ik.solve(target, home, seed=3, thorough=True))


def test_a_thorough_search_for_free_solutions_loses_no_nearer_one(planner: Planner) -> None:
    reference = np.array([2.0, -0.6, -2.3, -0.9, 1.7, 2.6, -1.9])
    target = planner.robot.fk([1.1, -0.5, -2.8973, -1.3, 1.7, 2.1, -1.0])
    world = CollisionWorld(planner.robot, PlanningScene())
    quick = world.free_states(planner.ik.solve(target, reference, seed=0))[0]
    found = planner.inverse_kinematics(target, reference, scene=PlanningScene(), count=1000)
    gaps = np.abs(found - reference).max(axis=1)
    assert gaps[0] <= np.abs(quick - reference).max()
    assert (np.diff(gaps) >= 0).all()


def test_native_kinematics_agree_with_pinocchio(planner: Planner) -> None:
    rng = np.random.default_rng(0)
    robot = planner.robot
    joints, rates = rng.uniform(robot.lower, robot.upper, (20, 7)), rng.normal(size=(20, 7))
    poses, speeds = robot.arm.tcp_poses(joints), robot.arm.tcp_speeds(joints, rates)
    for q, v, pose, speed in zip(joints, rates, poses, speeds, strict=True):
        assert pose == pytest.approx(robot.fk(q).matrix, abs=1e-12)
        moved = robot.kinematics.jacobian(q) @ v
        assert speed == pytest.approx([np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])], abs=1e-12)


def test_every_reachable_pose_is_solved(planner: Planner) -> None:
    robot, home = planner.robot, planner.named_state("home")
    joints = np.random.default_rng(1).uniform(robot.lower, robot.upper, (2000, 7))
    for target in robot.tcp_poses(joints):
        assert distance(robot.fk(planner.ik.any(target, home)), target) == pytest.approx((0.0, 0.0), abs=2e-5)


def test_out_of_reach_says_how_far(planner: Planner) -> None:
    with pytest.raises(PlannerError, match=r"within \d+\.\d mm") as caught:
        planner.ik.solve(Pose(position=(1.5, 0.0, 0.5)), planner.named_state("home"), seed=0)
    assert caught.value.code == ErrorCode.GOAL_UNREACHABLE
