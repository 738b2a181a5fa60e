"""The time that `roboxim experiment plan` states, against the time that the experiment then takes.

The machine's rates are measured by the plan's own probe, in a cache folder of the benchmark's own. Then the experiment
runs at its smallest scale. Both must have the machine for themselves. There is no shorter version (`--quick`).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks._harness import Bench


def main() -> None:
    """Plan, run and compare."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--experiment", default="skill_object", help="experiment of config/experiments")
        parser.add_argument("--scale", default="smoke", help="its scale")
        parser.add_argument("--trainings", type=int, default=1, help="trainings at a time")

    bench = Bench("plan_accuracy", __doc__, options)
    chosen = [bench.options.experiment, "--trainings", str(bench.options.trainings), "--scale", bench.options.scale]
    with tempfile.TemporaryDirectory(prefix="roboxim-plan-") as name:
        folder = Path(name)
        environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
        planned, probe_s = _timed([*_ROBOXIM, "plan", *chosen, "--json"], environment)
        hours = json.loads(planned)[0]["hours"]
        _, run_s = _timed([*_ROBOXIM, "run", *chosen, "--out", str(folder / "run")], environment)
        stages = [json.loads(line) for line in (folder / "run/stages.jsonl").read_text().splitlines()]
    by_kind: dict[str, float] = {}
    for stage in stages:
        kind = stage["stage"].split("/")[0]
        by_kind[kind] = by_kind.get(kind, 0.0) + stage["wall_s"]
    for kind, seconds in by_kind.items():
        bench.row(stage=kind, seconds=round(seconds, 1))
    bench.row(stage="whole run", seconds=round(run_s, 1))
    bench.row(stage="plan", seconds=round(3600 * hours, 1))
    bench.row(stage="probe", seconds=round(probe_s, 1))
    error = abs(3600 * hours / run_s - 1)
    bench.finish(f"{chosen[0]} at scale {chosen[-1]}: relative error of the planned time", error, "", at_most=0.3)


_ROBOXIM = (str(Path(sys.executable).with_name("roboxim")), "experiment")


def _timed(command: list[str], environment: dict[str, str]) -> tuple[str, float]:
    started = time.monotonic()
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout, time.monotonic() - started


if __name__ == "__main__":
    main()
