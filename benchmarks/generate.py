"""How many demonstrations an hour: ``roboxim generate`` with 2 workers, two 256 x 256 raster cameras, recorded.

Counts the steady state: from the first finished episode to the last one, and start-up apart.
"""

import tempfile
import time

from _harness import Bench
from roboxim_bringup.jobs import Job, registered_run, run_job, task_text
from roboxim_core.episode import EpisodeResult, RunConfig

WORKERS = 2


def main() -> None:
    """Measure and print."""
    bench = Bench("generate", __doc__)
    episodes = 10 if bench.quick else 60
    finished: list[float] = []
    with tempfile.TemporaryDirectory() as folder, registered_run("benchmark"):
        config = RunConfig(
            purpose="demo", keep="successful", max_attempts=5, task_config=task_text("pick_cube"), output_dir=folder,
            image_width=256, image_height=256, noise_translation_m=0.003, noise_rotation_rad=0.01,
        )  # fmt: skip

        def note(_: EpisodeResult, __: object) -> None:
            finished.append(time.perf_counter())

        started = time.perf_counter()
        results = run_job(Job(config=config, episodes=episodes, workers=WORKERS), "demonstrations", on_result=note)
    steady = finished[-1] - finished[WORKERS - 1]
    kept = sum(result.outcome == "success" for result in results)
    bench.row(
        episodes=episodes, kept=kept, workers=WORKERS, ticks=sum(result.last_seq + 1 for result in results),
        start_s=round(finished[0] - started, 1), s_per_episode=round(steady / (episodes - WORKERS), 2),
    )  # fmt: skip
    bench.finish(
        "recorded demonstrations per hour", kept / episodes * 3600 * (episodes - WORKERS) / steady, "/h", at_least=1500
    )


if __name__ == "__main__":
    main()
