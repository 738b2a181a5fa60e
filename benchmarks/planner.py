"""Share of random tabletop problems that the planner solves with a valid motion, and how long it takes.

A problem: 3 to 10 boxes on a table, every third with a stick in the hand, from a random configuration to a random tcp
pose; in every second one the direct joint line collides. Valid: the referee (``_referee.py``), which shares no code
with the planner, finds no fault in the motion at a kilohertz. A problem without an answer counts as not valid.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from _harness import Bench
from _referee import LOWER, UPPER, Box, Referee
from roboxim_core.errors import RoboximError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import Attached, Body, PlanningScene
from roboxim_planner.scene import box as make_body

Array = npt.NDArray[np.float64]
TABLE = Box((0.9, 1.4, 0.05), (0.5, 0.0, -0.025))


@dataclass
class Problem:
    """One planning problem and who judges it."""

    seed: int
    boxes: list[Box]
    held: Box | None
    start: Array
    goal: pin.SE3
    direct_collides: bool
    referee: Referee


def make_problem(seed: int, arm: ArmKinematics) -> Problem:
    """Draw a problem; its goal is the tcp of a free configuration, so an answer exists unless the way is shut."""
    rng = np.random.default_rng([20260, seed])
    wants_detour = seed % 2 == 0
    while True:
        boxes = [TABLE]
        for _ in range(rng.integers(3, 11)):
            x, y, z = rng.uniform(0.03, 0.15), rng.uniform(0.03, 0.15), rng.uniform(0.05, 0.4)
            place = (rng.uniform(0.3, 0.8), rng.uniform(-0.5, 0.5), z / 2 + 0.001)
            boxes.append(Box((x, y, z), place, rng.uniform(0.0, np.pi)))
        held = Box((0.02, 0.02, 0.12), (0.0, 0.0, 0.03)) if seed % 3 == 0 else None
        referee = Referee(boxes, held)
        for _ in range(10):
            start, end = (_free(rng, referee, arm) for _ in range(2))
            if start is None or end is None:
                break
            if referee.edge_collides(start, end) == wants_detour:
                return Problem(seed, boxes, held, start, referee.tcp(end), wants_detour, referee)


def _free(rng: np.random.Generator, referee: Referee, arm: ArmKinematics) -> Array | None:
    for _ in range(60):
        tilt = pin.rpy.rpyToMatrix(rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-np.pi, np.pi))
        rotation = tilt @ np.diag([1.0, -1.0, -1.0])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = rng.uniform([0.3, -0.45, 0.05], [0.75, 0.45, 0.45])
        found = arm.ik_near(Pose.from_matrix(matrix), rng.uniform(0.8 * LOWER + 0.2 * UPPER, 0.2 * LOWER + 0.8 * UPPER))
        if found.converged and not referee.collides(found.joints):
            return found.joints
    return None


def scene_of(problem: Problem) -> PlanningScene:
    """Return the planner's view of a problem."""

    def body(name: str, box: Box) -> Body:
        return make_body(name, box.size, Pose.from_matrix(box.placement.homogeneous))

    held = () if problem.held is None else (Attached(body=body("held", problem.held)),)
    return PlanningScene(bodies=tuple(body(f"box{i}", box) for i, box in enumerate(problem.boxes)), attached=held)


def main() -> None:
    """Run the benchmark."""
    bench = Bench("planner", __doc__)
    library = ModelLibrary()
    arm = ArmKinematics(library.robot("panda"))
    planner = Planner(library.robot("panda"))
    count = 60 if bench.quick else 1000
    results: list[tuple[bool, bool, float, str]] = []
    planner.plan_to_joints(PlanningScene(), planner.named_state("home"), planner.named_state("ready"))
    failed = []
    for seed in range(count):
        problem = make_problem(seed, arm)
        scene, goal = scene_of(problem), Pose.from_matrix(problem.goal.homogeneous)
        begun = time.perf_counter()
        try:
            plan = planner.plan_to_pose(scene, problem.start, [goal], MotionOptions(seed=seed))
            ms = 1e3 * (time.perf_counter() - begun)
            samples = plan.sample(0.001)
            faults = problem.referee.faults(samples.times, samples.positions, problem.start, problem.goal)
            route = plan.route
        except RoboximError as error:
            ms, faults, route = 1e3 * (time.perf_counter() - begun), [f"{error.code.name}: {error}"], "none"
        results.append((problem.direct_collides, not faults, ms, route))
        if faults:
            failed.append(f"seed {seed}: {'; '.join(faults)}")
    for name, chosen in (
        ("all", results),
        ("direct line free", [r for r in results if not r[0]]),
        ("direct line collides", [r for r in results if r[0]]),
    ):
        times = [r[2] for r in chosen]
        bench.row(
            problems=name,
            count=len(chosen),
            valid=sum(r[1] for r in chosen),
            searched=sum(r[3] == "sampled" for r in chosen),
            median_ms=round(float(np.median(times)), 1),
            p95_ms=round(float(np.percentile(times, 95)), 1),
            max_ms=round(max(times), 1),
        )
    for line in failed:
        print(line)
    bench.finish("valid share of tabletop problems", sum(r[1] for r in results) / count, "", at_least=0.999)


if __name__ == "__main__":
    main()
