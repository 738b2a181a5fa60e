"""The model of docs/results/scale.md, checked here: the time of an episode with 1 and 2 workers and 1 to 4 Ray nodes.

The model says that a run is limited by processor time: an episode takes its core-seconds, divided by the cores that its
workers can use. One local worker gives both figures: core-seconds per episode, and the cores that a worker uses at a
time. It is measured anew before each other row, since the speed of a virtual machine changes within minutes; the row is
predicted from it and then measured. The start of workers and of the cluster is not counted. Needs ``make scale``, and
a machine without other work.
"""

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
from benchmarks._harness import Bench
from planted_runs import ray_cluster

from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.events import EpisodeFinished, Event
from roboxim_runs.executors.ray_cluster import RayExecutor

SIZE = 128
NODES = (1, 2, 3, 4)


def main() -> None:
    """Measure and print."""
    bench = Bench("scale_model", __doc__)
    episodes, alone = (16, 8) if bench.quick else (50, 20)
    cores = os.cpu_count() or 1
    errors: list[float] = []

    def check(name: str, workers: int, executor: Any) -> None:
        alone_s, core_s = measured(1, alone, None)
        predicted_s = core_s / min(workers * core_s / alone_s, cores)
        found_s, _ = measured(workers, episodes, executor)
        errors.append(found_s / predicted_s - 1)
        bench.row(
            executor=name, workers=workers, core_s=round(core_s, 2), used_by_one=round(core_s / alone_s, 2),
            predicted_s=round(predicted_s, 3), s_per_episode=round(found_s, 3), error=f"{100 * errors[-1]:+.0f} %",
        )  # fmt: skip

    check("local", 2, None)
    for nodes in NODES[:2] if bench.quick else NODES:
        cluster = ray_cluster(nodes)
        try:
            with RayExecutor(nodes, address=cluster.address) as executor:
                check(f"Ray, nodes: {nodes}", nodes, executor)
        finally:
            cluster.shutdown()
    worst = max(abs(error) for error in errors)
    bench.finish("largest relative error of the model", round(worst, 3), "", at_most=0.2)


def measured(workers: int, episodes: int, executor: Any) -> tuple[float, float]:
    """Return wall time and processor time of an episode in the steady state [s].

    Processor time is that of this process and its children, so it says nothing about a Ray cluster.
    """
    finished: list[tuple[float, float]] = []

    def note(event: Event) -> None:
        if isinstance(event, EpisodeFinished):
            finished.append((time.perf_counter(), _cpu_s()))

    with tempfile.TemporaryDirectory() as folder:
        config = GenerationConfig(out=Path(folder) / "run", episodes=episodes, workers=workers, size=SIZE)
        generate(config, on_event=note, executor=executor)
    first, last = finished[workers - 1], finished[-workers]  # in between, all workers are busy
    each = 1 / (episodes - 2 * workers + 1)
    return each * (last[0] - first[0]), each * (last[1] - first[1])


def _cpu_s() -> float:
    me = psutil.Process()
    times = [process.cpu_times() for process in [me, *me.children(recursive=True)]]
    return float(sum(found.user + found.system for found in times))


if __name__ == "__main__":
    main()
