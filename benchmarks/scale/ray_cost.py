"""The cost of Ray: wall time of a demonstration on a Ray cluster of this machine, over that on local workers.

Both sides run the same episodes with 2 workers, in turns. The start of workers and of the cluster is shown, but not
counted. Needs ``make scale``, and a machine without other work: at a load, other programs decide the ratio.
"""

import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks._harness import Bench

from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.events import EpisodeFinished, Event
from roboxim_runs.executors.ray_cluster import RayExecutor

WORKERS = 2
SIZE = 128


def main() -> None:
    """Measure and print."""
    bench = Bench("ray_cost", __doc__)
    rounds, episodes = (1, 12) if bench.quick else (3, 60)
    times: dict[str, list[float]] = {"local": [], "ray": []}
    for turn in range(rounds):
        for name in ("local", "ray"):
            start_s, episode_s = measured(RayExecutor(WORKERS) if name == "ray" else None, episodes)
            times[name].append(episode_s)
            bench.row(round=turn, executor=name, start_s=round(start_s, 1), s_per_episode=round(episode_s, 3))
    cost = median(ray / local for ray, local in zip(times["ray"], times["local"], strict=True))
    bench.finish("a demonstration on Ray over one on local workers, 2 workers", round(cost, 3), "", at_most=1.1)


def measured(executor: Any, episodes: int) -> tuple[float, float]:
    """Return the time until the first episode ended, and the time of an episode in the steady state [s]."""
    finished: list[float] = []

    def note(event: Event) -> None:
        if isinstance(event, EpisodeFinished):
            finished.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        with executor or nullcontext():
            config = GenerationConfig(out=Path(folder) / "run", episodes=episodes, workers=WORKERS, size=SIZE)
            generate(config, on_event=note, executor=executor)
    return finished[0] - started, (finished[-1] - finished[WORKERS - 1]) / (episodes - WORKERS)


if __name__ == "__main__":
    main()
