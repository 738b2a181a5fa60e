"""How often the expert succeeds at its first try, and whether its recorded actions do so again, open loop.

Through the cores, without cameras, with the noise that demonstrations have. A replay rebuilds the episode's scene
in a fresh world and executes the recorded actions; it counts when all state hashes agree and the judge says success
again.
"""

import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from _harness import Bench
from roboxim_bringup.core_graph import CoreGraph, CoreTasks
from roboxim_bringup.jobs import task_text
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_eval.statistics import success_rate
from roboxim_recorder.bag import BagReader
from roboxim_sim.world import World

TASKS = ("pick_cube", "pick_cube_distractors")


@dataclass(kw_only=True)
class Tally:
    """What happened in one task's episodes."""

    first_try: int = 0
    """Episodes that succeeded."""
    replayed: int = 0
    """Successful episodes whose replay succeeded with the same hashes."""
    ticks: list[int] = field(default_factory=list)
    """Actions of each successful episode."""
    reasons: Counter[str] = field(default_factory=Counter)
    """Reasons of the others."""


def main() -> None:
    """Measure and print."""
    bench = Bench("expert", __doc__)
    resets = 10 if bench.quick else 100
    total = Tally()
    for task in TASKS:
        tally = measure(task, resets)
        rate = success_rate(tally.first_try, resets)
        bench.row(
            task=task, resets=resets, first_try=tally.first_try, low_95=round(rate.low, 3), replayed=tally.replayed,
            median_ticks=float(np.median(tally.ticks)),
            failures=", ".join(f"{reason} {count}" for reason, count in tally.reasons.items()) or "-",
        )  # fmt: skip
        total.first_try += tally.first_try
        total.replayed += tally.replayed
    if total.replayed != total.first_try:
        raise SystemExit(f"only {total.replayed} of {total.first_try} successful episodes succeeded again")
    bench.finish("first-try success", total.first_try / (resets * len(TASKS)), "", at_least=0.99)


def measure(task: str, resets: int) -> Tally:
    """Run and replay episodes of a task."""
    data = yaml.safe_load(task_text(task))
    data["reset"]["cameras"] = {"names": []}
    tally = Tally()
    library = ModelLibrary()
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder)) as cores, World(library) as world:
        config = RunConfig(
            purpose="test", output_dir=folder, task_config=yaml.safe_dump(data), noise_translation_m=0.003,
            noise_rotation_rad=0.01,
        )  # fmt: skip
        runner = EpisodeRunner(cores.ports, config)
        for index in range(resets):
            result = runner.run_index(index)
            if result.outcome != "success":
                tally.reasons[result.reason] += 1
                continue
            tally.first_try += 1
            tally.ticks.append(result.steps)
            tally.replayed += replay_succeeds(world, CoreTasks(library), BagReader(Path(folder, result.bag)))
    return tally


def replay_succeeds(world: World, judge: CoreTasks, bag: BagReader) -> bool:
    """Execute a bag's actions again, open loop."""
    info = bag.info
    for tick in bag.ticks(cameras=()):
        if tick.seq == 0:
            state = world.load(info.scene, info.episode_id)
            verdict = judge.start(info.episode_id, info.task, state)
        else:
            action = np.array(tick.step.action_executed, np.float32)
            state = world.tick(tick.seq, action, episode_id=info.episode_id)
            verdict = judge.judge(state)
        if state.state_hash != tick.state.state_hash:
            return False
    return verdict.success


if __name__ == "__main__":
    main()
