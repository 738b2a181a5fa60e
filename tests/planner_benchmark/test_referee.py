"""The referee detects planted faults and accepts clean motions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from benchmark_values import END, START


def quintic(start: np.ndarray, end: np.ndarray, duration: float = 2.0) -> np.ndarray:
    """A smooth motion along the joint line, a sample per millisecond."""
    s = np.arange(round(duration * 1000) + 1) / (duration * 1000)
    return start + (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None] * (end - start)


def judge(positions, solids=(), held=None, goal=END, start=START):
    from benchmarks.planner._referee import Referee

    return Referee(solids, held).judge(positions, (len(positions) - 1) * 1e-3, start, goal)


def test_a_smooth_free_motion_is_valid() -> None:
    from benchmarks.planner._referee import Referee

    assert judge(quintic(START, END)).clean
    assert judge(quintic(START, END), goal=Referee([]).tcp(END)).clean


def test_a_thin_pole_on_the_way_is_hit() -> None:
    from benchmarks.planner._referee import Referee, Solid

    middle = Referee([]).tcp(0.5 * (START + END)).translation
    pole = Solid(kind="cylinder", size=(0.002, 0.05), position=tuple(middle))
    assert judge(quintic(START, END)).clean
    [fault] = judge(quintic(START, END, 0.9), [pole]).faults
    assert "collision" in fault
    assert "#0" in fault


def test_what_is_held_collides_with_obstacles_and_with_the_arm_but_not_with_the_fingers() -> None:
    from benchmarks.planner._referee import Referee, Solid

    tip = Referee([]).tcp(START)
    stick = Solid(kind="box", size=(0.02, 0.02, 0.3), position=(0.0, 0.0, 0.12))
    below = tip.act(np.array([0.0, 0.0, 0.2]))
    ball = Solid(kind="sphere", size=(0.03,), position=tuple(below))
    assert not Referee([ball]).collides(START)
    assert Referee([ball], stick).collides(START)
    assert not Referee([], stick).collides(START)
    long = Solid(kind="box", size=(0.02, 0.02, 0.9), position=(0.0, 0.0, -0.3))
    assert Referee([], long).collides(START)


def test_a_self_collision_is_found() -> None:
    folded = np.array([0.0, 1.7, 0.0, -3.05, 0.0, 0.0, 0.0])
    assert any("collision" in fault for fault in judge(quintic(START, folded, 4.0), goal=folded).faults)


def test_too_fast_is_a_violation() -> None:
    verdict = judge(quintic(START, END, 0.75))
    assert not verdict.faults
    assert any("velocity of joint 1" in line for line in verdict.violations)


def test_a_step_of_acceleration_within_its_limit_breaks_only_the_jerk_limit() -> None:
    times = np.arange(601) * 1e-3
    way = np.where(times < 0.3, times**2, 0.18 - (0.6 - times) ** 2) / 0.18
    for turn, broken in ((0.3, []), (0.4, ["jerk"])):  # at the switch the acceleration steps by turn / 0.09 in 1 ms
        end = START.copy()
        end[1] += turn
        verdict = judge(START + way[:, None] * (end - START), goal=end)
        assert not verdict.faults
        assert [line.split()[0] for line in verdict.violations] == broken


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda q: q + 2e-4, "start"),
        (lambda q: q[:-200], "goal"),
        (lambda q: q[:-200], "rest"),
        (lambda q: np.vstack([q[:500], np.full((1, 7), np.nan), q[501:]]), "not finite"),
    ],
)
def test_a_corrupted_motion_is_detected(spoil, said: str) -> None:
    assert any(said in fault for fault in judge(spoil(quintic(START, END))).faults)


def test_a_goal_missed_by_a_hair_is_caught() -> None:
    from benchmarks.planner._referee import Referee

    goal = Referee([]).tcp(END)
    for off in (pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.0012])), pin.SE3(pin.utils.rotate("x", 0.012), np.zeros(3))):
        assert any("goal" in fault for fault in judge(quintic(START, END), goal=goal * off).faults)


def test_joints_beyond_their_range_and_missing_samples_are_caught() -> None:
    from benchmarks.planner._machines import machine
    from benchmarks.planner._referee import Referee

    end = END.copy()
    end[6] = machine("panda").upper[6] + 0.01
    assert "joint range left by 0.01 rad" in judge(quintic(START, end), goal=end).faults
    thin = quintic(START, END)[::10]
    assert any("per millisecond" in fault for fault in Referee([]).judge(thin, 2.0, START, END).faults)


@pytest.mark.thorough
@pytest.mark.parametrize("robot", ["panda", "ur5", "xarm7"])
def test_skipping_what_cannot_collide_misses_nothing(robot: str) -> None:
    from benchmarks.planner._problems import tabletop

    rng = np.random.default_rng(3)
    referee = tabletop(0, robot=robot).referee()
    arm = referee.machine
    for _ in range(6):
        ends = rng.uniform(arm.lower, arm.upper, (2, arm.dof))
        path = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
        expected = next((i for i, q in enumerate(path) if referee.collides(q)), -1)
        assert referee.first_collision(path) == expected


@pytest.mark.parametrize("robot", ["panda", "ur5", pytest.param("xarm7", marks=pytest.mark.thorough)])
def test_the_makers_description_and_ours_agree_on_the_tool(robot: str) -> None:
    from benchmarks.planner._problems import arm
    from benchmarks.planner._referee import Referee

    referee = Referee([], robot=robot)
    machine = referee.machine
    for joints in np.random.default_rng(5).uniform(machine.lower, machine.upper, (20, machine.dof)):
        ours = arm(robot).fk(joints)
        theirs = referee.tcp(joints)
        np.testing.assert_allclose(ours.matrix, theirs.homogeneous, atol=1e-6)


@pytest.mark.parametrize("robot", ["ur5", pytest.param("xarm7", marks=pytest.mark.thorough)])
def test_mounted_parts_may_touch_and_a_hand_in_the_arm_may_not(robot: str) -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._referee import Referee

    assert not Referee([], robot=robot).collides(np.array(tabletop(1, robot=robot).start))
    folded = {"ur5": [0.0, -1.57, 3.0, 0.0, -1.57, 0.0], "xarm7": [2.45, 1.36, -0.13, 0.77, 1.9, 2.77, -1.47]}[robot]
    assert Referee([], robot=robot).collides(np.array(folded))


def test_an_arm_without_a_referee_is_refused_by_name() -> None:
    from benchmarks.planner._referee import Referee

    with pytest.raises(ValueError, match="no referee for the robot 'gen3'; there is one for panda, ur5, xarm7"):
        Referee([], robot="gen3")
