"""Episodes per second of exports: LeRobot with videos, RLDS with JPEG 95, HDF5; two 256 x 256 cameras.

The bags are generated first and do not count. RLDS is also exported by a process for each core, from copies of the
bags, since that pays when there are many episodes; the start of the processes counts. ``cpu_ms`` is the processor time
of an episode, of the exporting process (reading bags included) and of its workers; unlike the rate it hardly depends on
what else the machine does.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench
from benchmarks.data._demonstrations import copy

from roboxim_core.errors import RecorderError
from roboxim_recorder.export import EXPORTERS, export_bags

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "LeRobot 3.0, h264": ("lerobot", {}),
    "LeRobot 2.1, h264": ("lerobot", {"version": "2.1"}),
    "LeRobot 3.0, PNG": ("lerobot", {"images": True}),
    "RLDS, JPEG 95": ("rlds", {}),
    "HDF5, lzf": ("hdf5", {}),
    "RLDS, JPEG 95, a process a core": ("rlds", {}),
}
*_, MANY = CASES
COPIES = 6
"""Times that a bag is exported by several processes."""
HEADLINE = "LeRobot 3.0, h264"


def main() -> None:
    """Measure and print."""
    bench = Bench("export", __doc__, add_options)
    rates = {}
    with tempfile.TemporaryDirectory() as folder:
        bags = bench.options.bags or generated(Path(folder) / "run", 6 if bench.quick else 40)
        for name in CASES:
            if name == MANY:
                bags = copied(bags, Path(folder) / "copies", 2 if bench.quick else COPIES)
            episodes, steps, seconds, own_ms, workers_ms = measure(name, bags, Path(folder) / "out")
            rates[name] = episodes / seconds
            size = sum(file.stat().st_size for file in (Path(folder) / "out").rglob("*") if file.is_file())
            subprocess.run(["rm", "-r", str(Path(folder) / "out")], check=True)
            bench.row(
                format=name,
                episodes_per_s=round(rates[name], 2),
                cpu_ms=round(own_ms),
                cpu_ms_workers=round(workers_ms),
                steps=round(steps / episodes, 1),
                kib_per_step=round(size / steps / 1024, 1),
            )
    bench.finish(f"{HEADLINE}, two cameras", rates[HEADLINE], "episodes/s", at_least=6)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the benchmark's own options."""
    parser.add_argument("--bags", type=Path, metavar="RUN", help="export this run instead of generating one")


def generated(run: Path, episodes: int) -> Path:
    """Generate demonstrations and return their folder."""
    command = [sys.executable, "-m", "roboxim_cli", "generate", "--out", str(run), "--episodes", str(episodes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"generating the bags failed: {done.stderr.strip()[-500:]}")
    return run


def copied(bags: Path, out: Path, times: int) -> Path:
    """Return a folder with copies of the bags of a run under other ids."""
    for index, bag in enumerate(times * sorted((bags / "episodes").iterdir())):
        copy(bag, out, f"demo-1-{index:05d}-0", index)
    return out


def measure(name: str, bags: Path, target: Path) -> tuple[int, int, float, float, float]:
    """Export once; return episodes, steps, wall time [s], and processor time of an episode here and in workers [ms]."""
    exporter, options = CASES[name]
    config = EXPORTERS[exporter]().config(**options)
    before = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    start = time.perf_counter()
    try:
        report = export_bags(exporter, bags, target, config, workers=0 if name == MANY else 1)
    except RecorderError as error:
        raise SystemExit(f"the export failed: {error}") from None
    took = time.perf_counter() - start
    after = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    own, workers = ((b.ru_utime + b.ru_stime) - (a.ru_utime + a.ru_stime) for a, b in zip(before, after, strict=True))
    episodes = sum(report.splits.values())
    return episodes, report.steps, took, 1e3 * own / episodes, 1e3 * workers / episodes


if __name__ == "__main__":
    main()
