"""Approach, grasp, lift, carry, lower as one request, compared with the same motions planned one after the other.

Random scenes have a cube among 4 to 8 boxes on a table, to be carried to another place. "One after the other" requests
each motion as soon as the previous one is planned, and cannot go back to another goal configuration. Every motion is
checked again, sampled at 1 ms, with the held cube. Scenes that neither variant solves may have no solution.
"""

from __future__ import annotations

import itertools
import math
import time
from statistics import median

import numpy as np
from benchmarks._harness import Bench
from scipy.spatial.transform import Rotation

from roboxim_core.errors import PlannerError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import AllowedContact, PlanningScene, box
from roboxim_planner.sequence import Stage, StageGoal, plan_sequence

DOWN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
SIZE_M = 0.045


def down(x: float, y: float, z: float, yaw: float) -> Pose:
    """Return a tcp pose that looks straight down."""
    return Pose.from_arrays([x, y, z], Rotation.from_euler("z", yaw) * DOWN)


def shift(name: str, z: float, **changes: object) -> Stage:
    """Return a straight line along the world's z [m]."""
    goal = StageGoal(pose=Pose(position=(0.0, 0.0, z)), relative=True)
    return Stage(kind="cartesian", name=name, goals=(goal,), **changes)


def problem(seed: int) -> tuple[PlanningScene, tuple[Stage, ...]]:
    """Return a scene and the stages of carrying its cube elsewhere."""
    rng = np.random.default_rng(seed)
    bodies = [box("table", (0.9, 1.4, 0.05), Pose(position=(0.5, 0.0, -0.027)))]
    taken: list[tuple[float, float, float]] = []

    def place(radius: float, x: tuple[float, float], y: tuple[float, float]) -> tuple[float, float]:
        while True:
            at = rng.uniform(*x), rng.uniform(*y)
            if all(math.dist(at, other[:2]) > radius + other[2] for other in taken):
                taken.append((*at, radius))
                return at

    x, y = place(0.1, (0.35, 0.65), (-0.45, 0.45))
    there = place(0.1, (0.35, 0.65), (-0.45, 0.45))
    for k in range(rng.integers(4, 9)):
        wide, deep, high = rng.uniform(0.04, 0.14), rng.uniform(0.04, 0.14), rng.uniform(0.1, 0.45)
        at = place(0.5 * math.hypot(wide, deep), (0.3, 0.75), (-0.55, 0.55))
        bodies.append(box(f"box{k}", (wide, deep, high), Pose(position=(*at, high / 2))))
    yaw = rng.uniform(-math.pi, math.pi)
    turn = Rotation.from_euler("z", yaw)
    bodies.append(box("cube", (SIZE_M,) * 3, Pose.from_arrays([x, y, SIZE_M / 2], turn)))
    above = tuple(StageGoal(pose=down(x, y, 0.12, yaw + k * math.pi / 2)) for k in range(4))
    held = (AllowedContact(body_a="cube", body_b="table"),)
    stages = (
        Stage(kind="pose", name="approach", goals=above),
        shift("grasp", -0.095, allowed=(AllowedContact(body_a="cube", body_b="gripper"),)),
        shift("lift", 0.12, attach=("cube",), gripper_opening=SIZE_M / 0.08, allowed=held),
        Stage(
            kind="pose",
            name="carry",
            goals=tuple(StageGoal(pose=down(*there, 0.15, k * math.pi / 4)) for k in range(8)),
        ),
        shift("lower", -0.12, allowed=held),
    )
    return PlanningScene(bodies=tuple(bodies)), stages


def one_after_the_other(planner: Planner, scene: PlanningScene, stages: tuple[Stage, ...]) -> list:
    """Return the plans of the stages, each requested separately."""
    at, plans = planner.named_state("home"), []
    for stage in stages:
        found = plan_sequence(planner, scene, at, (stage,))
        plans += found.plans
        _, scene = stage.enter(scene, planner.robot.fk(at))
        at = plans[-1].end
    return plans


def wrong(planner: Planner, scene: PlanningScene, stages: tuple[Stage, ...], plans: list) -> int:
    """Return the number of plans that a second check rejects."""
    count = 0
    for stage, plan in zip(stages, plans, strict=True):
        samples = plan.sample(0.001)
        here, scene = stage.enter(scene, planner.robot.fk(samples.positions[0]))
        count += not planner.check_trajectory(here, samples.positions, samples.times, samples.velocities).valid
    return count


def main() -> None:
    """Measure and print."""
    bench = Bench("planner_sequence", __doc__)
    problems = 12 if bench.quick else 100
    planner = Planner(ModelLibrary().robot("panda"))
    ways = {
        "one after the other": lambda scene, stages: one_after_the_other(planner, scene, stages),
        "as one request": lambda scene, stages: list(
            plan_sequence(planner, scene, planner.named_state("home"), stages).plans
        ),
    }
    solved: dict[str, set[int]] = {name: set() for name in ways}
    times: dict[str, list[float]] = {name: [] for name in ways}
    refused = dict.fromkeys(ways, 0)
    home = planner.named_state("home")
    drawn = ((seed, *problem(seed)) for seed in itertools.count())
    fit = (each for each in drawn if planner.check_state(each[1], home).valid)
    for seed, scene, stages in itertools.islice(fit, problems):
        for name, way in ways.items():
            begun = time.perf_counter()
            try:
                plans = way(scene, stages)
            except PlannerError:
                continue
            times[name].append(1e3 * (time.perf_counter() - begun))
            solved[name].add(seed)
            refused[name] += wrong(planner, scene, stages, plans)
    any_way = set.union(*solved.values())
    for name in ways:
        spent = sorted(times[name])
        bench.row(
            way=name, problems=problems, solved=len(solved[name]), refused=refused[name],
            median_ms=round(median(spent), 1), p95_ms=round(spent[int(0.95 * (len(spent) - 1))], 1),
        )  # fmt: skip
    share = len(solved["as one request"]) / max(1, len(any_way))
    bench.finish("solved as one request, of those that either way solves", 100.0 * share, "%", at_least=99.0)


if __name__ == "__main__":
    main()
