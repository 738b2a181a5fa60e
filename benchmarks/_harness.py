"""Common parts of all benchmarks: options, a table, a JSON file, and a headline figure as the last line.

A benchmark is a file ``benchmarks/SUBJECT/NAME.py``, run by ``make bench-NAME``::

    def main() -> None:
        bench = Bench("render", __doc__)
        bench.row(renderer="raster", ms=round(measure(quick=bench.quick), 2))
        bench.finish("256x256 pair", 18.2, "ms", at_most=20)

Its options include ``--quick`` (ends within 45 s) and ``--json FILE``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median

import click

VERSIONS_OF = ("numpy", "pybullet", "moderngl", "pin", "ompl", "ruckig", "mcap", "jax", "ros-jazzy-rclpy")
"""Distributions whose versions influence the measurements."""


class Bench:
    """The rows and the headline of one benchmark."""

    def __init__(
        self,
        name: str,
        description: str | None = None,
        add_options: Callable[[argparse.ArgumentParser], object] | None = None,
    ) -> None:
        """Read the command line.

        Args:
            name: Name of the benchmark's file, without ``.py``.
            description: Text for ``--help``; its first line is printed above the table.
            add_options: Adds the benchmark's own options; ``options`` then contains them.
        """
        parser = argparse.ArgumentParser(
            prog=f"make bench-{name}", description=description, formatter_class=argparse.RawTextHelpFormatter
        )
        parser.add_argument("--quick", action="store_true", help="fewer repetitions: end within 45 s")
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the result to FILE")
        if add_options is not None:
            add_options(parser)
        options = parser.parse_args()
        self.name = name
        self.options = options
        self.quick: bool = options.quick
        self.rows: list[dict[str, str | float]] = []
        self._json: Path | None = options.json
        self._title = (description or name).strip().splitlines()[0]

    def row(self, **values: str | float) -> None:
        """Add a row to the table; name values with their unit, e.g. ``ms_per_pair=18.2``."""
        self.rows.append(values)

    def finish(
        self, name: str, value: float, unit: str, *, at_most: float | None = None, at_least: float | None = None
    ) -> None:
        """Print the table and the headline; write the JSON file if requested.

        Args:
            name: Description of the headline figure.
            value: The figure.
            unit: Its unit; empty for a ratio.
            at_most: The goal, if less is better.
            at_least: The goal, if more is better.
        """
        if (at_most is None) == (at_least is None):
            raise ValueError("a headline has exactly one goal: set at_most or at_least")
        goal = f"<= {at_most:g}" if at_most is not None else f">= {at_least:g}"
        holds = bool(value <= at_most if at_most is not None else value >= (at_least or 0.0))
        headline = {"name": name, "value": round(value, 4), "unit": unit, "goal": goal, "holds": holds}
        machine = describe_machine()
        if self._json:
            result = {"machine": machine, "versions": _versions(), "rows": self.rows, "headline": headline}
            self._json.write_text(json.dumps(result, indent=2) + "\n")
        click.echo(f"{self._title}\n{_table(self.rows)}\n")
        click.echo("machine: " + ", ".join(f"{key} {value}" for key, value in machine.items()))
        verdict = "holds" if holds else "DOES NOT HOLD"
        click.echo(f"{self.name}: {name} {value:.4g} {unit}".rstrip() + f" (goal {goal}: {verdict})")


def time_ms(call: Callable[[], object], repeats: int, warm_up: int = 3) -> float:
    """Return the median wall time of a call [ms] over several repetitions after a warm-up."""
    for _ in range(warm_up):
        call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * median(times)


def rss_mib() -> float:
    """Return this process's resident memory [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def describe_machine() -> dict[str, str | float]:
    """Describe the machine; ``calibration_ms`` is the time of a fixed one-core job, to compare machines and loads."""
    cpu = platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.split(":", 1)[1].strip()
            break
    return {
        "cpu": cpu,
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 1),
        "calibration_ms": round(time_ms(lambda: sum(i * i for i in range(200_000)), 7), 2),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in VERSIONS_OF:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _table(rows: list[dict[str, str | float]]) -> str:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [columns, *([str(row.get(column, "")) for column in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)
