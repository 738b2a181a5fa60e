"""Success rates in scenes with a blocked path: of the expert, and of an actor that moves straight from stage to stage.

Both act in the same scenes, through the cores, with the noise of demonstrations. An episode succeeds if, as the tasks
demand, the skill's own conditions hold at the first try after a second of rest, and no distractor moved by more than
1 cm. Failures are counted by cause: not solved, or a distractor disturbed. To measure both causes in every episode, the
benchmark judges episodes by the skill alone and continues after a disturbance.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from benchmarks._harness import Bench
from benchmarks.expert._expert_run import DISTURBED_M, NOISE_M, NOISE_RAD
from tqdm import tqdm

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_bringup.cores import CorePlanner
from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode import ActorPort, EpisodeRunner, Ports, RunConfig, SimPort
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_eval.statistics.rates import success_rate
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.config import merged
from roboxim_tasks.demonstration.expert import Expert
from roboxim_tasks.roles import DISTRACTOR

TASKS = ("pick_up_blocked", "place_on_blocked")


@dataclass(frozen=True, kw_only=True)
class Ended:
    """The result of an episode."""

    solved: bool
    """Whether the skill's own conditions held at the first try."""
    shift_m: float
    """Largest distance that a distractor was moved at any tick [m]."""
    reason: str
    """Reason why it was not solved."""
    draws: int
    """Number of placements drawn for the scene."""

    @property
    def succeeded(self) -> bool:
        """Whether it is a success by the conditions of the shipped task."""
        return self.solved and self.shift_m <= DISTURBED_M


class Watch:
    """A proxy of the sim that omits the cameras and records how far distractors move."""

    def __init__(self, sim: SimPort) -> None:
        """Watch a sim."""
        self._sim = sim
        self._first: StateRecord | None = None
        self.shift_m = 0.0

    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics) -> StateRecord:
        """Rebuild the world."""
        self._first, self.shift_m = self._sim.load(episode_id, replace(scene, cameras=()), semantics), 0.0
        return self._first

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action."""
        assert self._first is not None
        state = self._sim.tick(episode_id, seq, action)
        shifts = [
            float(np.linalg.norm(np.subtract(now.pose.position, then.pose.position)))
            for now, then in zip(state.entities, self._first.entities, strict=True)
            if now.name.startswith(DISTRACTOR)
        ]
        self.shift_m = max(self.shift_m, *shifts)
        return state

    def __getattr__(self, name: str) -> Any:
        """Delegate everything else to the sim."""
        return getattr(self._sim, name)


def main() -> None:
    """Measure and print."""
    bench = Bench("blocked", __doc__, add_options)
    scenes = bench.options.scenes or (4 if bench.quick else 40)
    start, together = time.perf_counter(), []
    library = ModelLibrary()
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder), renderer="tiny") as cores:
        actors: dict[str, ActorPort] = {
            "expert": cores.ports.actor,
            "straight lines": CoreActor(Expert(library, CorePlanner(library), direct=True)),
        }
        for task in TASKS:
            ended = {name: run(cores, actor, task, scenes, folder) for name, actor in actors.items()}
            for name, episodes in ended.items():
                bench.row(task=task, actor=name, **row(episodes))
            ours, straight = ended.values()
            together.append(
                float(np.mean([a.succeeded and not b.succeeded for a, b in zip(ours, straight, strict=True)]))
            )
    sys.stdout.write(f"{len(TASKS) * scenes} scenes, {time.perf_counter() - start:.0f} s\n")
    bench.finish(
        "scenes that the expert solves and straight lines do not, lowest of the tasks", min(together), "", at_least=0.95
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--scenes", type=int, default=0, metavar="N", help="per task (default: 40)")


def run(cores: CoreGraph, actor: ActorPort, task: str, scenes: int, folder: str) -> list[Ended]:
    """Run an actor in the scenes of a task and return its results."""
    text = yaml.safe_dump(merged(yaml.safe_load(task_text(task)), {"distractors": {"stay_m": 0.0}}))
    watch = Watch(cores.ports.sim)
    ports: Ports = replace(cores.ports, actor=actor, sim=watch)
    config = RunConfig(
        purpose="test", task_config=text, keep="none", output_dir=folder, noise_translation_m=NOISE_M,
        noise_rotation_rad=NOISE_RAD,
    )  # fmt: skip
    runner, ended = EpisodeRunner(ports, config), []
    for index in tqdm(range(scenes), unit="episode", disable=None):
        result = runner.run_index(index)
        reset = cores.tasks.generator.last_reset
        solved = result.outcome == "success" and not result.recovered
        reason = "" if solved else result.reason or "recovered"
        ended.append(Ended(solved=solved, shift_m=watch.shift_m, reason=reason, draws=reset.draws if reset else 0))
    return ended


def row(episodes: list[Ended]) -> dict[str, str | float]:
    """Return an actor's row."""
    rate = success_rate(sum(e.succeeded for e in episodes), len(episodes))
    reasons = Counter(e.reason for e in episodes if e.reason)
    return {
        "scenes": len(episodes),
        "success": round(rate.rate, 3),
        "low_95": round(rate.low, 3),
        "high_95": round(rate.high, 3),
        "not_solved": sum(not e.solved for e in episodes),
        "disturbed": sum(e.shift_m > DISTURBED_M for e in episodes),
        "not_solved_because": ", ".join(f"{name} {count}" for name, count in reasons.most_common()) or "-",
        "draws": float(np.median([e.draws for e in episodes])),
    }


if __name__ == "__main__":
    main()
