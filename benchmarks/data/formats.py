"""RLDS, LeRobot 3.0 and 2.1, and HDF5 of the same bags: whether they are equal, and whether their actions replay.

Demonstrations of all skills are exported to each format with its defaults. Every dataset is compared with the HDF5
dataset, which stores images without loss, and its executed actions are executed again from each episode's scene. With
``--out`` bags, datasets and finished measurements are stored there, and the same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench
from benchmarks.data._demonstrations import QUICK, demonstrations

from roboxim_core.whole_files import write_whole
from roboxim_datasets.compare import compare, comparison_text
from roboxim_datasets.dataset import EXPORT_FILE
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.export import EXPORTERS
from roboxim_runs.datasets.export import export_dataset
from roboxim_runs.datasets.replay_gate import replay_dataset

REFERENCE = "HDF5"
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE: ("hdf5", {}),
    "RLDS": ("rlds", {}),
    "LeRobot 3.0": ("lerobot", {}),
    "LeRobot 2.1": ("lerobot", {"version": "2.1"}),
}


def main() -> None:
    """Measure and print."""
    bench = Bench("formats", __doc__, add_options)
    options = bench.options
    episodes, skills = (4, QUICK) if bench.quick else (options.episodes, ())
    with tempfile.TemporaryDirectory() as scratch:
        out = (options.out or Path(scratch)).absolute()
        runs = demonstrations(out / "bags", episodes, skills=skills, seed=options.seed, workers=options.workers)
        held = 0
        for name in CASES:
            row = measure(name, list(runs.values()), out, options.workers)
            bench.row(format=name, **row)
            held += int(row["equal"] == "yes" and row["retained"] == row["successes"])
    bench.finish(f"formats of {episodes} episodes that are equal and replay whole", held, "", at_least=len(CASES))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store bags and datasets here and continue from them")
    parser.add_argument("--episodes", type=int, default=100, metavar="N", help="episodes of all skills (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the demonstrations (default: 0)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: 2)")


def measure(name: str, runs: list[Path], out: Path, workers: int) -> dict[str, str | float]:
    """Export, compare and replay; a measurement of the same dataset is not repeated."""
    exporter, options = CASES[name]
    config = EXPORTERS[exporter]().config(uneven=True, **options)
    place = out / name.lower().replace(" ", "-")
    path = export_dataset(exporter, runs, place, config).path
    identity = json.loads((path / EXPORT_FILE).read_text())["identity"]
    stored = out / f"{place.name}.json"
    if stored.is_file() and (known := json.loads(stored.read_text()))["identity"] == identity:
        return dict(known["row"])
    dataset, reference = open_dataset(path), open_dataset(out / REFERENCE.lower())
    found = compare(reference, dataset)
    if not found.equal:
        (out / f"{place.name}.diff.txt").write_text(comparison_text(found, {"a": REFERENCE, "b": name}))
    replayed = replay_dataset(path, runs, labels=False, workers=workers)
    retained, error = replayed.retained("executed"), replayed.tcp_error_m("executed")
    row: dict[str, str | float] = {
        "episodes": found.episodes,
        "steps": found.steps,
        "equal": "yes" if found.equal else f"{found.count} differences",
        "lowest_psnr_db": round(min(camera.lowest_db for camera in found.images.values()), 1),
        "successes": retained.of,
        "retained": retained.successes,
        "exact": sum(replay.executed is not None and replay.executed.exact for replay in replayed.episodes),
        "worst_tcp_error_mm": round(1e3 * error.get("max", 0.0), 4),
    }
    write_whole(stored, json.dumps({"identity": identity, "row": row}, indent=2) + "\n")
    return row


if __name__ == "__main__":
    main()
