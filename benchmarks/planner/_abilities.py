"""Further planner benchmarks, judged by the referee: inverse kinematics, straight retreats, memory, load."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from benchmarks.peers._serve import pack, unpack
from benchmarks.planner._contenders import OURS, Contender
from benchmarks.planner._problems import Problem, arm, configuration_at, tabletop
from benchmarks.planner._referee import PERIOD_S, Referee

from roboxim_core.poses import Pose

Array = npt.NDArray[np.float64]
Row = dict[str, str | float]
IK_M, IK_RAD = 1e-4, 1e-3
RETREAT_M = 0.12
CANDIDATES = 120
"""Number of goal configurations that the brute-force search tries."""
STEPS = 48
"""Number of steps in which the search follows the line."""


def ik_row(ours: Contender, count: int, salt: int, robot: str = "panda") -> Row:
    """Solve for the tcp poses of random configurations within the limits; the referee checks the solutions."""
    referee = Referee([], robot=robot)
    drawn = np.random.default_rng([20262, salt]).uniform(
        referee.machine.lower, referee.machine.upper, (count, referee.machine.dof)
    )
    targets = [referee.tcp(q) for q in drawn]
    poses = np.array([pin.SE3ToXYZQUAT(target) for target in targets])
    answer = ours.ask({"op": "ik", "poses": pack(poses)}, 300.0)
    joints, times = unpack(answer["joints"]), unpack(answer["ms"])
    solved = sum(_reaches(referee, q, target) for q, target in zip(joints, targets, strict=True))
    return {
        "problems": "inverse kinematics, reachable poses",
        "contender": ours.name,
        "count": count,
        "valid": solved,
        "valid_share": round(solved / count, 5),
        "median_ms": round(float(np.median(times)), 4),
        "p95_ms": round(float(np.percentile(times, 95)), 4),
        "max_ms": round(float(times.max()), 3),
    }


def load_row(make: Callable[[], Contender], count: int, salt: int) -> Row:
    """Compute the same plans in a fresh process, and in another one under a load of four processes per core."""
    problems = [tabletop(seed, salt).plain() for seed in range(count)]
    request = {"op": "digests", "problems": problems, "seed": 0}
    with make() as alone:
        expected = alone.ask(request, 300.0)["digests"]
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4 * (os.cpu_count() or 1))]
    try:
        with make() as loaded:
            found = loaded.ask(request, 600.0)["digests"]
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()
    same = sum(a == b for a, b in zip(expected, found, strict=True))
    return {
        "problems": "the same plans under 4 x CPU load",
        "contender": OURS,
        "count": count,
        "valid": same,
        "valid_share": round(same / count, 4),
    }


def _reaches(referee: Referee, joints: Array, target: pin.SE3) -> bool:
    lower, upper = referee.machine.lower, referee.machine.upper
    if not np.isfinite(joints).all() or (joints < lower - 1e-9).any() or (joints > upper + 1e-9).any():
        return False
    off = referee.tcp(joints).actInv(target)
    return float(np.linalg.norm(off.translation)) <= IK_M and float(np.linalg.norm(pin.log3(off.rotation))) <= IK_RAD


def retreat_row(ours: Contender, count: int, salt: int, robot: str = "panda") -> Row:
    """Reach tabletop poses and retreat 12 cm straight back, where a brute-force search finds this feasible.

    The search tries many goal configurations and follows the line from each. It thus finds a configuration at the pose
    from which the line is free. The planner gets both motions as one request and must choose such a configuration.
    """
    times, valid, feasible, seed, faults = [], 0, 0, 0, []
    while feasible < count:
        problem = tabletop(100_000 + seed, salt, robot)
        seed += 1
        if not is_retreat_feasible(problem):
            continue
        feasible += 1
        answer = ours.ask({"op": "retreat", "problem": problem.plain(), "distance_m": RETREAT_M}, 60.0)
        times.append(answer["ms"])
        fault = answer["error"] or "; ".join(_retreat_faults(problem, answer["motions"]))
        valid += not fault
        if fault:
            faults.append(f"{problem.name}: {fault[:160]}")
    for line in faults:
        print(f"  retreat from {line}")
    return {
        "problems": f"pose and straight retreat of {100 * RETREAT_M:.0f} cm",
        "contender": ours.name,
        "count": count,
        "valid": valid,
        "valid_share": round(valid / count, 4),
        "median_ms": round(float(np.median(times)), 2),
        "p95_ms": round(float(np.percentile(times, 95)), 2),
        "max_ms": round(max(times), 1),
    }


def is_retreat_feasible(problem: Problem) -> bool:
    """Return whether any of many free configurations at the goal allows a straight retreat by `RETREAT_M`."""
    goal, referee = problem.goal_value, problem.referee()
    assert isinstance(goal, pin.SE3)
    rng = np.random.default_rng(7)
    return any(_line_is_free(referee, goal, q) for q in _configurations(rng, problem) if not referee.collides(q))


def _configurations(rng: np.random.Generator, problem: Problem) -> Iterator[Array]:
    goal = problem.goal_value
    assert isinstance(goal, pin.SE3)
    for _ in range(CANDIDATES):
        joints = configuration_at(rng, goal, problem.robot)
        if joints is not None:
            yield joints


def _line_is_free(referee: Referee, goal: pin.SE3, joints: Array) -> bool:
    path = [joints]
    for part in np.linspace(0.0, RETREAT_M, STEPS + 1)[1:]:
        pose = goal * pin.SE3(np.eye(3), np.array([0.0, 0.0, -part]))
        found = arm(referee.machine.name).ik_near(Pose.from_matrix(pose.homogeneous), path[-1])
        inside = ((found.joints >= referee.machine.lower) & (found.joints <= referee.machine.upper)).all()
        if not found.converged or not inside or np.abs(found.joints - path[-1]).max() > 0.2:
            return False
        path.append(found.joints)
    return not any(referee.edge_collides(a, b) for a, b in zip(path[:-1], path[1:], strict=True))


def _retreat_faults(problem: Problem, motions: list[tuple[dict[str, Any], float]]) -> list[str]:
    """Judge both motions, and the straightness of the second."""
    referee, goal = problem.referee(), problem.goal_value
    assert isinstance(goal, pin.SE3)
    away = goal * pin.SE3(np.eye(3), np.array([0.0, 0.0, -RETREAT_M]))
    (first, first_s), (second, second_s) = ((unpack(packed), duration) for packed, duration in motions)
    verdicts = [
        referee.judge(first, first_s, np.array(problem.start), goal),
        referee.judge(second, second_s, first[-1], away),
    ]
    faults = [str(verdict) for verdict in verdicts if not verdict.clean]
    along = [goal.actInv(referee.tcp(q)) for q in second[:: round(0.01 / PERIOD_S)]]
    aside = max(float(np.hypot(*off.translation[:2])) for off in along)
    turned = max(float(np.linalg.norm(pin.log3(off.rotation))) for off in along)
    if aside > 1e-3 or turned > 1e-2:
        faults.append(f"the retreat leaves its line by {1e3 * aside:.2g} mm, {turned:.2g} rad")
    return faults


def memory_row(ours: Contender, plans: int, salt: int) -> Row:
    """Plan repeatedly and report the growth of the process; a tenth as many plans first serve as warm-up."""
    problems = [tabletop(seed, salt).plain() for seed in range(100)]
    sizes = []
    warm_up = max(1, plans // 1000)
    for batch in range(warm_up + plans // 100):
        answer = ours.ask({"op": "repeat", "problems": problems, "seed": 100 * batch}, 300.0)
        sizes.append(answer["rss_mib"])
    return {
        "problems": f"memory over {plans} plans",
        "contender": ours.name,
        "count": plans,
        "grown_mib": round(sizes[-1] - sizes[warm_up - 1], 2),
        "rss_mib": round(sizes[-1], 1),
    }
