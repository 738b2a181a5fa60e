"""Whether the audit finds every planted fault in 1, 10 and 100 % of the episodes of bags of all skills.

The two small shares are of all bags, the whole one of the first two bags of each skill.

Every fault that can be planted in bags is planted in copies, at each rate, and the copy is audited by the check that
must find it. Faults that only datasets can have are planted in an RLDS export.

Then faults that no check knows by name are composed at random (`roboxim_datasets.audit.faults.composed`) and planted in
memory, in an HDF5 export of episodes of their own (64 pixels, seeds from 1000 on): without bags at least 95 % of
those that change an action by more than 2 mm or 2 degrees, or a text label, should be found, with the bags all, and
nothing in the clean episodes. ``--fault composed`` measures these alone.

With ``--out`` bags and finished measurements are stored there, and the same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from pathlib import Path

from benchmarks._harness import Bench
from benchmarks.data._composed import SHARE
from benchmarks.data._composed import measure as measure_composed
from benchmarks.data._demonstrations import QUICK, demonstrations

from roboxim_core.errors import InvalidRequestError
from roboxim_recorder.export.hdf5 import Hdf5Config
from roboxim_runs.datasets.audit import AuditConfig, audit_dataset
from roboxim_runs.datasets.corruption import FaultKind, corrupt, fault_kinds
from roboxim_runs.datasets.export import ExportConfig, export_dataset

RATES = (0.01, 0.1, 1.0)
EACH = 2
"""Bags of each skill in which every episode gets a fault."""
COMPOSED = "composed"
HELD_OUT = 1000
"""Added to the seed of episodes for composed faults: the checks' thresholds were set on seeds below."""
NEEDS_RENDERER = ("hidden_object", "indistinguishable")


def main() -> None:
    """Measure and print."""
    bench = Bench("planted", __doc__, add_options)
    options = bench.options
    kinds = {name: kind for name, kind in fault_kinds().items() if not options.fault or name in options.fault}
    if bench.quick:
        kinds = {name: kind for name, kind in kinds.items() if name in ("rotation_jump", "split_leak")}
    with tempfile.TemporaryDirectory() as scratch:
        out = (options.out or Path(scratch)).absolute()
        planted = found = 0
        if kinds:
            planted, found = named(bench, kinds, out)
        if options.composed and (not options.fault or COMPOSED in options.fault):
            more = composed(bench, out / COMPOSED)
            planted, found = planted + more[0], found + more[1]
    bench.finish(f"share of {planted} planted faults that are found", found / max(planted, 1), "", at_least=1.0)


def named(bench: Bench, kinds: dict[str, FaultKind], out: Path) -> tuple[int, int]:
    """Plant faults that checks look for; return how many were planted and found."""
    options = bench.options
    episodes, skills = (4, QUICK) if bench.quick else (options.episodes, ())
    runs = demonstrations(out / "bags", episodes, skills=skills, seed=options.seed, workers=options.workers)
    sources = {rate: sources_of(list(runs.values()), out, EACH if rate == 1 else 0) for rate in RATES}
    planted = found = 0
    for name, kind in kinds.items():
        for rate in RATES:
            row = measure(kind, rate, sources[rate][not kind.bags], out, options.seed)
            bench.row(fault=name, rate=rate, **row)
            planted, found = planted + int(row["planted"]), found + int(row["found"])
    return planted, found


def composed(bench: Bench, out: Path) -> tuple[int, int]:
    """Plant faults composed at random; return how many were planted, and found with the bags."""
    options = bench.options
    episodes, skills = (8, QUICK) if bench.quick else (options.clean, ())
    seed = options.seed + HELD_OUT
    runs = demonstrations(out / "bags", episodes, skills=skills, seed=seed, workers=options.workers, size=64)
    bags, dataset = gathered(list(runs.values()), out / "all", 0), out / "hdf5"
    if not dataset.is_dir():
        export_dataset("hdf5", bags, dataset, Hdf5Config(uneven=True))
    counts = measure_composed(dataset, bags, 8 if bench.quick else options.composed, seed, out / "results")
    for what in counts.planted:
        bench.row(fault=f"composed, {what}", rate=SHARE, planted=counts.planted[what], found=counts.found[what])
    bench.row(fault="composed, with bags", rate=SHARE, planted=counts.planted["all"], found=counts.found["with bags"])
    bench.row(fault=f"none, in {counts.episodes} episodes", rate=0, planted=0, found=len(counts.clean))
    bench.row(fault="composed, elsewhere", rate=SHARE, planted=0, found=len(counts.elsewhere))
    return counts.planted["all"], counts.found["with bags"]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store bags and results here and continue from them")
    parser.add_argument("--episodes", type=int, default=100, metavar="N", help="episodes of all skills (default: 100)")
    parser.add_argument(
        "--fault", action="append", metavar="NAME", help="this fault only, or composed; may be repeated"
    )
    parser.add_argument(
        "--clean", type=int, default=504, metavar="N", help="episodes for composed faults (default: 504)"
    )
    parser.add_argument(
        "--composed", type=int, default=500, metavar="N", help="composed faults; 0: none (default: 500)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of demonstrations and plants (default: 0)")
    parser.add_argument("--workers", type=int, default=2, help="processes that demonstrate (default: 2)")


def sources_of(runs: list[Path], out: Path, each: int) -> tuple[Path, Path]:
    """Return what faults are planted in: a folder of bags, and the dataset of it.

    Args:
        runs: A run for each skill.
        out: Folder of both.
        each: Bags of each run; 0: all.
    """
    bags = gathered(runs, out / (f"each-{each}" if each else "all"), each)
    target = out / (f"rlds-each-{each}" if each else "rlds")
    return bags, export_dataset("rlds", bags, target, ExportConfig(uneven=True)).path


def gathered(runs: list[Path], out: Path, each: int) -> Path:
    """Return a folder of the bags of the runs; the files are linked."""
    for run in runs:
        for bag in sorted((run / "episodes").iterdir())[: each or None]:
            if not (out / "episodes" / bag.name).is_dir():
                shutil.copytree(bag, out / "episodes" / bag.name, copy_function=os.link)
    return out


def measure(kind: FaultKind, rate: float, source: Path, out: Path, seed: int) -> dict[str, str | float]:
    """Plant a fault and audit the copy; a finished measurement is not repeated."""
    stored = out / "results" / f"{kind.name}-{rate:g}.json"
    if stored.is_file():
        return dict(json.loads(stored.read_text()))
    copy, report = out / "copy", out / "report"
    for folder in (copy, report):
        shutil.rmtree(folder, ignore_errors=True)
    try:
        made = corrupt(source, copy, kind.name, rate, seed=seed)
    except InvalidRequestError as error:
        return {"planted": 0, "found": 0, "check": kind.found_by, "problem": str(error)}
    config = AuditConfig(
        checks=(kind.found_by,),
        replay=kind.found_by == "replay",
        render=kind.found_by in NEEDS_RENDERER,
        bags=() if kind.bags else (out / "all",),
    )
    result = audit_dataset(made.path, report, config).result
    faulty = set(result.check(kind.found_by).faulty_episodes)
    row: dict[str, str | float] = {
        "planted": len(made.planted),
        "found": len(faulty & set(made.planted)),
        "elsewhere": len(faulty - set(made.planted)),
        "refused": len(made.refused),
        "check": kind.found_by,
    }
    stored.parent.mkdir(parents=True, exist_ok=True)
    stored.write_text(json.dumps(row) + "\n")
    return row


if __name__ == "__main__":
    main()
