"""The expert's first-try success rate for every skill and object, with distractors.

Episodes run through the cores, with the noise of demonstrations, and without cameras except for one image at each
reset. Success is judged after a second of rest; an episode that needed a second grasp is not a success. A replay
rebuilds the episode's scene in a fresh world and executes its actions open loop. It succeeds if every state hash agrees
and the verdict is success again. With ``--out`` each finished episode is stored, and the same command continues an
interrupted run, provided that code and configuration are unchanged.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks._harness import Bench
from benchmarks.expert._cells import Cell, cells, long_cells
from benchmarks.expert._kept import Kept
from tqdm import tqdm

from roboxim_core.models.library import ModelLibrary
from roboxim_eval.statistics.rates import success_rate
from roboxim_runs.executors import Job, LocalExecutor, Lost, Note, Work
from roboxim_tasks.task_config import VisibleConfig

CHUNK = 10
PERIOD_S = 5.0
"""Period of the progress bar, which is written to files too [s]."""
QUICK_CELLS = (
    "pick_up/knife/3", "place_on/apple/3", "place_left_of/cucumber/3", "rotate/cube/3", "push_button/button/3",
    "open_drawer/middle/3",
)  # fmt: skip


def main() -> None:
    """Measure and print."""
    bench = Bench("expert", __doc__, add_options)
    options = bench.options
    chosen = long_cells() if options.long else [cell for clutter in options.clutter for cell in cells(clutter)]
    if bench.quick and not options.long:
        chosen = [cell for cell in chosen if cell.label in QUICK_CELLS]
    if options.cells:
        chosen = [cell for cell in chosen if any(text in cell.name for text in options.cells.split(","))]
    chosen = [cell for cell in chosen if cell.core or not options.core]
    if options.robot:
        robots = ModelLibrary().robot_ids if options.robot == "all" else options.robot.split(",")
        chosen = [replace(cell, robot=robot) for robot in robots for cell in chosen]
    if not chosen:
        raise SystemExit(f"no cell's name contains any of '{options.cells}'; see --list")
    if options.list:
        raise SystemExit("\n".join(cell.name for cell in chosen))
    start = time.perf_counter()
    wanted = {cell.name: options.resets or (2 if bench.quick else 200 if cell.core else 40) for cell in chosen}
    outcomes = measure({cell.name: cell for cell in chosen}, wanted, options)
    for cell in chosen:
        bench.row(**row(cell, outcomes[cell.name]))
    for robot in dict.fromkeys(cell.robot for cell in chosen if cell.robot):
        found = [outcome for cell in chosen if cell.robot == robot for outcome in outcomes[cell.name]]
        if found:
            bench.row(**summary(robot, found, reasons=None))
    core = [outcome for cell in chosen if cell.core for outcome in outcomes[cell.name]]
    others = [outcome for cell in chosen if not cell.core for outcome in outcomes[cell.name]]
    together = core + others
    if not together:
        raise SystemExit("no episode has ended")
    for name, group in (("core", core), ("others", others), ("all", together)):
        if group:
            bench.row(**summary(name, group, reasons=None))
    for line in floors(core, others, outcomes):
        sys.stdout.write(f"{line}\n")
    sys.stdout.write(f"{len(together)} episodes, {time.perf_counter() - start:.0f} s\n")
    bench.finish("first-try success", float(np.mean([o["first_try"] for o in together])), "", at_least=0.999)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store episodes here and continue from them")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default: 1)")
    parser.add_argument("--cells", default="", metavar="TEXT[,TEXT]", help="only cells whose name contains a text")
    parser.add_argument(
        "--robot", default="", metavar="NAME[,NAME]", help="arms that act, or all (default: each task's own)"
    )
    parser.add_argument("--resets", type=int, default=0, metavar="N", help="per cell (default: 200; 40 for rarer ones)")
    parser.add_argument("--long", action="store_true", help="the tasks of several steps instead of the cells")
    parser.add_argument("--core", action="store_true", help="only the cells with the most episodes")
    parser.add_argument("--clutter", type=int, nargs="+", default=[3], metavar="N", help="distractors (default: 3)")
    parser.add_argument("--replays", type=float, default=0.1, metavar="SHARE", help="replayed fraction (default: 0.1)")
    parser.add_argument("--list", action="store_true", help="print the cells' names and exit")


def measure(
    by_name: dict[str, Cell], wanted: dict[str, int], options: argparse.Namespace
) -> dict[str, list[dict[str, Any]]]:
    """Run the missing episodes; return every cell's episodes."""
    kept = Kept(options.out, {name: cell.config() for name, cell in by_name.items()}) if options.out else None
    outcomes = kept.load() if kept else {}
    total = sum(wanted.values())
    known = {name: [o for o in outcomes.get(name, []) if o["index"] < n] for name, n in wanted.items()}
    with tqdm(total=total, initial=sum(map(len, known.values())), unit="episode", mininterval=PERIOD_S) as bar:
        for done in run(missing(by_name, wanted, known), options):
            for outcome in done:
                known[outcome["cell"]].append(outcome)
            if kept:
                kept.add(done)
            bar.update(len(done))
    return {name: sorted(found, key=lambda o: o["index"]) for name, found in known.items()}


def missing(
    by_name: dict[str, Cell], wanted: dict[str, int], known: dict[str, list[dict[str, Any]]]
) -> Iterator[tuple[Cell, list[int]]]:
    """Yield chunks of the indices that are still to run, all cells in turns."""
    chunks = []
    for name, count in wanted.items():
        done = {outcome["index"] for outcome in known[name]}
        rest = [index for index in range(count) if index not in done]
        chunks += [(start, name, rest[start : start + CHUNK]) for start in range(0, len(rest), CHUNK)]
    for _, name, indices in sorted(chunks, key=lambda chunk: chunk[0]):
        yield by_name[name], indices


def run(chunks: Iterable[tuple[Cell, list[int]]], options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Run chunks in worker processes; yield each when it ends."""
    every = round(1 / options.replays) if options.replays > 0 else 0
    jobs = []
    for cell, indices in chunks:
        replayed = [index for index in indices if every and index % every == 0]
        data = {"cell": cell.name, "config": cell.config(), "indices": indices, "replayed": replayed}
        jobs.append(Job(key=f"{cell.name} {indices[0]}", data=data))
    executor = LocalExecutor(options.workers, log_dir=options.out / "logs" if options.out else None)
    work = Work(worker="benchmarks.expert._expert_run:ChunkWorker", python_path=(str(Path(__file__).parents[2]),))
    try:
        for outcome in executor.run(work, jobs, on_note=_tell):
            if isinstance(outcome, Lost):
                raise SystemExit(f"{outcome.key}: {outcome.message}")
            yield outcome.value
    except KeyboardInterrupt:
        raise SystemExit("stopped; the same command with --out continues") from None


def _tell(note: Note) -> None:
    if note.text:
        sys.stderr.write(f"{note.text}\n")


def row(cell: Cell, outcomes: list[dict[str, Any]]) -> dict[str, str | float]:
    """Return a cell's row."""
    return summary(cell.name, outcomes) if outcomes else {"cell": cell.name, "resets": 0}


def summary(name: str, outcomes: list[dict[str, Any]], reasons: int | None = 3) -> dict[str, str | float]:
    """Return a row of the table with the n constraints that rejected the most scenes; none: all constraints."""
    first = sum(o["first_try"] for o in outcomes)
    rate = success_rate(first, len(outcomes))
    reset = [o["reset_ms"] for o in outcomes]
    ticks = [o["ticks"] for o in outcomes if o["first_try"]]
    rejections = sum((Counter(o["rejections"]) for o in outcomes), Counter())
    failures = Counter(o["reason"].split(":")[0] for o in outcomes if o["reason"])
    replays = [o["replayed"] for o in outcomes if o["replayed"] is not None]
    return {
        "cell": name,
        "resets": len(outcomes),
        "first_try": first,
        "low_95": round(rate.low, 3),
        "high_95": round(rate.high, 3),
        "recovered": sum(o["recovered"] for o in outcomes),
        "ticks": float(np.median(ticks)) if ticks else "-",
        "reset_ms": round(float(np.median(reset))),
        "reset_p95": round(float(np.percentile(reset, 95))),
        "draws": float(np.median([o["draws"] for o in outcomes])),
        "near": round(float(np.mean([o["near"] for o in outcomes])), 2),
        "unseen": sum(not visible(o) for o in outcomes),
        "disturbed": sum(o["disturbed"] > 0 for o in outcomes),
        "replayed": f"{sum(replays)}/{len(replays)}",
        "failures": _counted(failures),
        "rejections": _counted(Counter(dict(rejections.most_common(reasons)))),
    }


def floors(
    core: list[dict[str, Any]], others: list[dict[str, Any]], by_cell: dict[str, list[dict[str, Any]]]
) -> Iterator[str]:
    """Yield a line for each requirement on the whole table: the figure, the goal, and whether it is met."""

    def line(what: str, value: float, goal: float, *, at_least: bool, unit: str = "%") -> str:
        holds = value >= goal if at_least else value <= goal
        sign = ">=" if at_least else "<="
        return f"{what}: {value:.4g} {unit} (goal {sign} {goal:g}: {'holds' if holds else 'DOES NOT HOLD'})"

    def share(outcomes: list[dict[str, Any]], key: str) -> float:
        return 100.0 * float(np.mean([o[key] > 0 for o in outcomes]))

    for name, group, overall, each in (("core", core, 99.9, 99.0), ("other", others, 99.9, 99.0)):
        if group:
            names = {o["cell"] for o in group}
            yield line(f"first try, {name} cells", share(group, "first_try"), overall, at_least=True)
            worst = min(names, key=lambda name: share(by_cell[name], "first_try"))
            yield line(f"worst cell ({worst})", share(by_cell[worst], "first_try"), each, at_least=True)
    together = core + others
    yield line("episodes in which a distractor was disturbed", share(together, "disturbed"), 1.0, at_least=False)
    replays = [o for o in together if o["replayed"] is not None]
    if replays:
        yield line("replays with every hash and verdict equal", share(replays, "replayed"), 100.0, at_least=True)
    abandoned = sum(o["reason"].lower().startswith("reset_infeasible") for o in together)
    yield line("resets abandoned", abandoned, 0, at_least=False, unit="")
    draws = {name: float(np.median([o["draws"] for o in found])) for name, found in by_cell.items() if found}
    most = max(draws, key=lambda name: draws[name])
    yield line(f"most draws of a cell, median ({most})", draws[most], 4, at_least=False, unit="")
    reset_ms = [o["reset_ms"] for o in together if o["index"] > 0]  # the first one also reads the cell's configuration
    if reset_ms:
        what = "reset, but for the first of each cell, on a free machine"
        yield line(f"{what}, median", float(np.median(reset_ms)), 80, at_least=False, unit="ms")
        yield line(f"{what}, 95 %", float(np.percentile(reset_ms, 95)), 400, at_least=False, unit="ms")


def visible(outcome: dict[str, Any]) -> bool:
    """Return whether the settled scene shows the objects of the instruction, by the tasks' default thresholds."""
    least = VisibleConfig()
    return bool(outcome["seen_share"] >= least.share and outcome["seen_px"] >= least.pixels)


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common()) or "-"


if __name__ == "__main__":
    main()
