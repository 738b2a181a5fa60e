"""What a run's bookkeeping costs an episode: the part of a run that one process does, however many workers there are.

The episodes are made up and their bags have two small files. The headline is the time of one process for 10^6 episodes:
to hand out jobs, log results, read them again, check the bags, and merge shards.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench

from roboxim_core.episode import EpisodeResult
from roboxim_runs.executors import Job, LocalExecutor, Work
from roboxim_runs.storage.folder import RunFolder, require_bags
from roboxim_runs.storage.merging import merge_shards

SHARDS = 2
MILLION = 1_000_000


class Echo:
    """A worker whose jobs take no time."""

    def __init__(self, settings: Any, number: int) -> None:
        """Need nothing."""

    def run(self, job: Any, note: Callable[[Any], None]) -> Any:
        """Return the job."""
        return job

    def close(self) -> None:
        """Free nothing."""


def main() -> None:
    """Measure and print."""
    bench = Bench("bookkeeping", __doc__)
    count = 2_000 if bench.quick else 20_000
    total = 0.0

    def measured(what: str, action: Callable[[], Any]) -> None:
        nonlocal total
        started = time.perf_counter()
        action()
        each_s = (time.perf_counter() - started) / count
        total += each_s
        bench.row(what=what, ms_per_episode=round(1000 * each_s, 3), h_per_million=round(each_s * MILLION / 3600, 2))

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measured("hand out a job to 2 local workers, and take its result", lambda: hand_out(count))
        shards = [folder / str(number) for number in range(SHARDS)]
        for number, shard in enumerate(shards):
            make_bags(shard, range(number, count, SHARDS))
        measured("log a result (fsync)", lambda: [log(shard, n, count) for n, shard in enumerate(shards)])
        measured("read the results again", lambda: [RunFolder(shard).results() for shard in shards])
        measured("check that its bag is there", lambda: [check(shard) for shard in shards])
        measured("merge 2 shards by links", lambda: merge_shards(folder / "out", shards))
    bench.finish("bookkeeping of 10^6 episodes in one process", total * MILLION / 3600, "h", at_most=3.0)


def hand_out(count: int) -> None:
    """Run jobs that take no time."""
    jobs = [Job(key=f"index {index}", data=index) for index in range(count)]
    assert sum(1 for _ in LocalExecutor(2).run(Work(worker="benchmarks.scale.bookkeeping:Echo"), jobs)) == count


def result(index: int) -> EpisodeResult:
    """Return a made-up result."""
    name = f"eval-0-{index:05d}-0"
    return EpisodeResult(episode_id=name, index=index, outcome="success", bag=f"episodes/{name}", steps=40)


def make_bags(run: Path, indices: range) -> None:
    """Make small bags."""
    for index in indices:
        bag = run / result(index).bag
        bag.mkdir(parents=True)
        for name in ("x_0.mcap", "metadata.yaml"):
            (bag / name).write_text(f"{name} {index}")


def log(run: Path, number: int, count: int) -> None:
    """Log a shard's results."""
    (run / "run.json").write_text("{}")
    config = {"purpose": "eval", "episodes": count, "run_seed": 0, "shard": f"{number + 1}/{SHARDS}"}
    with RunFolder(run).opened(config) as folder:
        for index in range(number, count, SHARDS):
            folder.append(result(index))


def check(run: Path) -> None:
    """Check a shard's bags, as a run does that continues."""
    require_bags(RunFolder(run), RunFolder(run).results())


if __name__ == "__main__":
    main()
