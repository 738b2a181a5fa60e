"""What a reset and a control tick cost with every arm, relative to Panda: cores without nodes and cameras, in turns.

- ``reset``: drawing a scene of `pick_up` with three distractors, planning that it can be solved, building, settling;
- ``tick``: the controller's IK, the physics of 100 ms, the state record and its hash, while arm and gripper move;
- ``physics``: the same physics steps with the arm held, which is PyBullet and the reading of its contacts.

All is processor time. Each round measures every arm on the same seed, in rotating order; a ratio is that to Panda in
the same round, and its median is printed.
``dof`` counts what PyBullet moves: the arm's joints, the fingers', and those that follow a finger.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import yaml
from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_runs.episodes.task_choice import task_text

BASE = "panda"
DISTRACTORS = 3
TARGETS = ["cube", "cucumber", "knife", "mug", "spoon"]
"""Objects that every arm's gripper is wide enough for."""
GOAL = 1.3
"""Largest ratio to Panda, except where joints explain more."""


def main() -> None:
    """Measure and print."""
    bench = Bench("arm_cost", __doc__, _options)
    library = ModelLibrary()
    arms = [BASE, *(name for name in bench.options.robots or library.robot_ids if name != BASE)]
    rounds, ticks = (4, 30) if bench.quick else (16, 60)
    spent: dict[str, list[tuple[float, float, float]]] = {arm: [] for arm in arms}
    with tempfile.TemporaryDirectory(prefix="roboxim-") as folder:
        cores = CoreGraph(Path(folder), renderer="tiny")
        for index in range(-1, rounds):
            first = index % len(arms)
            for arm in arms[first:] + arms[:first]:  # so that no arm always follows the same one
                once = _round(cores, arm, max(index, 0), ticks)
                if index >= 0:  # the first round reads files
                    spent[arm].append(once)
    base = spent[BASE]
    worst = 0.0
    for arm in arms:
        model = library.robot(arm)
        times = [median(column) for column in zip(*spent[arm], strict=True)]
        ratios = [
            median(mine[k] / other[k] for mine, other in zip(spent[arm], base, strict=True)) for k in range(len(times))
        ]
        worst = max(worst, ratios[1])
        bench.row(
            arm=arm,
            dof=len(model.joint_names) + len(model.gripper.joint_names) + len(model.gripper.followers),
            reset_ms=round(times[0], 1),
            reset_ratio=round(ratios[0], 2),
            tick_ms=round(times[1], 2),
            tick_ratio=round(ratios[1], 2),
            physics_ms=round(times[2], 2),
            physics_ratio=round(ratios[2], 2),
        )
    bench.finish("largest cost of a control tick, over Panda's", worst, "", at_most=GOAL)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", nargs="*", metavar="NAME", help="arms to compare with Panda; default: all")


def _round(cores: CoreGraph, arm: str, index: int, ticks: int) -> tuple[float, float, float]:
    """Return the milliseconds of a reset, a tick, and a tick's physics with the arm held."""
    task = yaml.safe_load(task_text("pick_up"))
    task |= {"robot": arm, "distractors": task["distractors"] | {"minimum": DISTRACTORS, "maximum": DISTRACTORS}}
    task["objects"]["target"]["models"] = {"values": TARGETS}
    world, start = cores.sim.world, time.process_time()
    drawn = cores.ports.scenes.draw(SeedPath(run_seed=0, purpose="test", index=index), yaml.safe_dump(task))
    world.load(replace(drawn.scene, cameras=()), "cost")
    reset = time.process_time() - start
    start = time.process_time()
    for k in range(ticks):
        turn = 0.3 * k
        action = [0.005 * np.sin(turn), 0.005 * np.cos(turn), 0.0, 0.0, 0.0, 0.01, float(k // 10 % 2)]
        world.tick(k + 1, np.array(action, np.float32), episode_id="cost")
    tick = (time.process_time() - start) / ticks
    start = time.process_time()
    world.physics.begin_tick()
    world.physics.advance(ticks * world.steps_per_tick, world.record.robot.joint_commands)
    physics = (time.process_time() - start) / ticks
    return 1e3 * reset, 1e3 * tick, 1e3 * physics


if __name__ == "__main__":
    main()
