"""Recorded demonstrations per hour: ``roboxim generate`` with 2 workers and two 256 x 256 raster cameras.

Measures the steady state, from the first finished episode to the last one; start-up is reported separately.
"""

import tempfile
import time

from benchmarks._harness import Bench

from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.events import EpisodeFinished, Event

WORKERS = 2


def main() -> None:
    """Measure and print."""
    bench = Bench("generate", __doc__)
    episodes = 10 if bench.quick else 60
    finished: list[float] = []

    def note(event: Event) -> None:
        if isinstance(event, EpisodeFinished):
            finished.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        config = GenerationConfig(task="pick_cube", out=folder, episodes=episodes, workers=WORKERS, size=256)
        started = time.perf_counter()
        results = generate(config, on_event=note).results
    steady = finished[-1] - finished[WORKERS - 1]
    kept = sum(result.outcome == "success" for result in results)
    bench.row(
        episodes=episodes, kept=kept, workers=WORKERS, ticks=sum(result.last_seq + 1 for result in results),
        start_s=round(finished[0] - started, 1), s_per_episode=round(steady / (episodes - WORKERS), 2),
    )  # fmt: skip
    bench.finish(
        "recorded demonstrations per hour", kept / episodes * 3600 * (episodes - WORKERS) / steady, "/h", at_least=4000
    )


if __name__ == "__main__":
    main()
