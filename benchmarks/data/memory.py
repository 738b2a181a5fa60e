"""Memory of an export of thousands of episodes: whether it grows with their number.

One demonstration with small images is copied under other ids, so that its bags are read like any others. What counts is
the exporting process together with its video workers, and how much more it takes at the end than at a tenth of the
episodes.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench
from benchmarks.data._demonstrations import copy

from roboxim_recorder.export import EXPORTERS, export_bags
from roboxim_runs.episodes.generation import GenerationConfig, generate

FORMATS: dict[str, tuple[str, dict[str, Any]]] = {
    "LeRobot 3.0": ("lerobot", {}),
    "RLDS": ("rlds", {}),
    "HDF5": ("hdf5", {}),
}
AT_MOST_MIB = 100


def main() -> None:
    """Measure and print."""
    bench = Bench("memory", __doc__, add_options)
    count = 40 if bench.quick else bench.options.episodes
    worst = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        out = (bench.options.out or Path(scratch)).absolute()
        bags = copies(out, count)
        for name, (exporter, options) in FORMATS.items():
            early, late = measure(exporter, options, bags, out / "export")
            bench.row(format=name, episodes=count, mib_at_a_tenth=round(early), mib_at_the_end=round(late))
            worst = max(worst, late - early)
    bench.finish(f"growth over {count} episodes, the worst format", worst, "MiB", at_most=AT_MOST_MIB)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store the bags here and continue from them")
    parser.add_argument("--episodes", type=int, default=2000, metavar="N", help="number of episodes (default: 2000)")


def copies(out: Path, count: int) -> Path:
    """Return a folder with copies of one demonstration; those that are there already stay."""
    [original] = (
        out / "original" / result.bag
        for result in generate(GenerationConfig(out=out / "original", episodes=1, size=64)).kept
    )
    there = {path.name for path in (out / "bags" / "episodes").glob("*")}
    for index in range(count):
        name = f"demo-1-{index:05d}-0"
        if name not in there:
            copy(original, out / "bags", name, index)
    return out / "bags"


def measure(exporter: str, options: dict[str, Any], bags: Path, target: Path) -> tuple[float, float]:
    """Export; return the memory at a tenth of the episodes and the largest one after that [MiB]."""
    seen: list[float] = []
    shutil.rmtree(target, ignore_errors=True)

    def progress(done: int, total: int) -> None:
        if done >= total // 10 and done % max(1, total // 40) == 0:
            seen.append(memory_mib())

    export_bags(exporter, bags, target, EXPORTERS[exporter]().config(**options), progress=progress)
    shutil.rmtree(target)
    return seen[0], max(seen)


def memory_mib() -> float:
    """Return the resident memory of this process and its children [MiB]."""
    own = os.getpid()
    processes = [own, *map(int, Path(f"/proc/{own}/task/{own}/children").read_text().split())]
    pages = sum(int(Path(f"/proc/{process}/statm").read_text().split()[1]) for process in processes)
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


if __name__ == "__main__":
    main()
