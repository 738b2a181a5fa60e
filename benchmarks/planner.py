"""Valid share of random planning problems, how long plans take, and how mplib and RoboPlan do on the same problems.

A motion is valid when the referee (``_referee.py``), which shares no code with the planner, finds neither a collision
at a kilohertz on the original collision meshes nor a goal missed; limits of velocity, acceleration and jerk are counted
apart for everybody, and for ours a broken limit is a failure too. An unsolved problem is a failure unless a search of
60 s with the referee's own collision checks fails as well; all are listed by seed. Contenders are processes of their
own, asked in turn with the same problem; peers come with ``make planner-peers``. Rows:

tabletop   3 to 10 obstacles on a table, every third with a stick in the hand, more than half detours
hard       shelves, a crate, a cage, cluttered tables, in the manner of MotionBenchMaker
ik         10,000 reachable poses
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import click

sys.path.insert(0, str(Path(__file__).parent))
from _contenders import contenders, toppra_measure
from _harness import Bench
from _motions import OURS, Draw, Store, file_draws, hard_draws, run_problems, summary, tabletop_draws, unsolved
from _problem_files import ProblemFileError, load_problems

SECTIONS = ("tabletop", "hard")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add this benchmark's options."""
    parser.add_argument("--rows", default=",".join(SECTIONS), help=f"of {','.join(SECTIONS)}; default: all")
    parser.add_argument("--seed", type=int, default=0, help="another set of problems for each; default: 0")
    parser.add_argument("--count", type=int, help="tabletop problems; default: 1000 (quick: 40)")
    parser.add_argument("--hard-count", type=int, help="problems of each hard family; default: 100 (quick: 2)")
    parser.add_argument("--peers", default="mplib,roboplan", help="peers to compare with; empty: none")
    parser.add_argument("--peers-every", type=int, default=5, help="peers get every N-th hard problem; default: 5")
    parser.add_argument("--search", type=float, default=60.0, help="time of the search for unsolved problems [s]")
    parser.add_argument("--problems", type=Path, metavar="FILE", help="problems of a file or folder instead")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="keep outcomes in FILE and go on from there")
    parser.add_argument("--stop-after", type=float, default=float("inf"), help="with --resume: stop after so many [s]")


def main() -> None:
    """Run the benchmark."""
    bench = Bench("planner", __doc__, add_options)
    options = bench.options
    rows = options.rows.split(",")
    if set(rows) - set(SECTIONS):
        sys.exit(f"--rows: unknown {set(rows) - set(SECTIONS)}; there are {', '.join(SECTIONS)}")
    store = Store(options.resume)
    until = time.monotonic() + options.stop_after
    share = 0.0
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        asked, missing = contenders([OURS, *filter(None, options.peers.split(","))], folder)
        for name in missing:
            click.echo(f"{name} is not installed: `make planner-peers`")
        measure = toppra_measure()
        for process in (*asked, *([measure] if measure else [])):
            stack.enter_context(process).start()
        if options.problems is not None:
            draws, rows = read_problems(options.problems), []
            share = problem_rows(bench, options.problems.stem, draws, asked, measure, store, 1, until)
        if "tabletop" in rows:
            draws = tabletop_draws(options.count or (40 if bench.quick else 1000), options.seed)
            share = problem_rows(bench, "tabletop", draws, asked, measure, store, 1, until)
        if "hard" in rows:
            draws = hard_draws(options.hard_count or (2 if bench.quick else 100), options.seed)
            problem_rows(bench, "hard", draws, asked, measure, store, options.peers_every, until)
    what = "tabletop problems" if options.problems is None else f"the problems of {options.problems.name}"
    bench.finish(f"valid share of {what}", share, "", at_least=0.999)


def read_problems(path: Path) -> list[Draw]:
    """Return the problems of a file; say which are left out."""
    try:
        problems, left_out = load_problems(path)
    except ProblemFileError as error:
        sys.exit(str(error))
    for line in left_out:
        click.echo(f"  left out: {line}")
    return file_draws(problems)


def problem_rows(
    bench: Bench, name: str, draws: list[Draw], asked: list, measure, store: Store, peers_every: int, until: float
) -> float:
    """Run a set of problems, add its rows, and return our valid share."""
    outcomes, done = run_problems(draws, asked, store, measure=measure, peers_every=peers_every, until=until)
    if not done:
        click.echo(f"{name}: stopped after {len(outcomes)} outcomes; the same command goes on")
    hopeless = unsolved(outcomes, draws, store, search_s=0.0 if bench.quick else bench.options.search)
    families = sorted({o.problem.rsplit("-", 1)[0] for o in outcomes})
    for family in families if len(families) > 1 else []:
        chosen = [o for o in outcomes if o.problem.rsplit("-", 1)[0] == family]
        bench.row(problems=family, contender=OURS, **summary(chosen, OURS, hopeless))
    for contender in asked:
        bench.row(problems=name, contender=contender.name, **summary(outcomes, contender.name, hopeless))
    mine = [o for o in outcomes if o.contender == OURS and o.problem not in hopeless]
    return sum(o.clean for o in mine) / max(1, len(mine))


if __name__ == "__main__":
    main()
