"""Planner benchmark: valid share of random problems and planning time, compared with mplib and RoboPlan.

A motion is valid if the referee (``_referee.py``) finds no collision at a kilohertz on the original collision meshes
and the goal is reached. The referee shares no code with the planner. Violated limits of velocity, acceleration and jerk
are counted separately for all contenders; for RoboXim a violated limit is a failure too.

An unsolved problem is a failure unless it is proved infeasible: start or goal collides, or no free configuration
reaches the goal's pose. A search of 60 s with the referee's own collision checks tests whether the others can be
solved. All failures are listed by seed.

RoboXim's time begins with a scene of plain values. ``our_p95_by_theirs`` compares it with a peer's time without scene
set-up, ``with_scene`` with a peer's total time. Contenders are separate processes that receive the same problems in
turn; ``make planner-peers`` installs the peers. Rows:

tabletop   3 to 10 obstacles on a table, every third with a stick in the hand, more than half detours
hard       shelves, a crate, a cage, cluttered tables, in the style of MotionBenchMaker
ik         10,000 reachable poses
retreat    a pose and 12 cm straight back from it as one request, where a brute-force search finds it feasible
memory     growth of the process over 10,000 plans
load       200 plans twice, the second time under four busy processes per core: identical bit for bit

``benchmarks/planner/planner_service.py`` measures the overhead of the services.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import click
from benchmarks._harness import Bench
from benchmarks.planner._abilities import ik_row, load_row, memory_row, retreat_row
from benchmarks.planner._contenders import OURS, Contender, contenders, our_planner, toppra_measure
from benchmarks.planner._machines import MACHINES
from benchmarks.planner._motions import (
    Draw,
    Store,
    file_draws,
    hard_draws,
    infeasible,
    run_problems,
    summary,
    tabletop_draws,
)
from benchmarks.planner._problem_files import ProblemFileError, load_problems

SECTIONS = ("tabletop", "hard", "ik", "retreat", "memory", "load")
ANY_ARM = ("tabletop", "ik", "retreat")
"""Sections for every arm that the referee knows; the others, and the peers, have the Panda's."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add this benchmark's options."""
    parser.add_argument("--robot", default="panda", choices=sorted(MACHINES), help="the arm; default: panda")
    parser.add_argument("--rows", help=f"of {','.join(SECTIONS)}; default: all (quick: all but load)")
    parser.add_argument("--seed", type=int, default=0, help="selects a set of problems; default: 0")
    parser.add_argument("--count", type=int, help="tabletop problems; default: 1000 (quick: 30)")
    parser.add_argument("--hard-count", type=int, help="problems of each hard family; default: 100 (quick: 1)")
    parser.add_argument("--peers", default="mplib,roboplan", help="peers to compare with; empty: none")
    parser.add_argument("--peers-every", type=int, default=5, help="peers get every N-th hard problem; default: 5")
    parser.add_argument("--search", type=float, default=60.0, help="duration of the search for unsolved problems [s]")
    parser.add_argument("--problems", type=Path, metavar="FILE", help="read the problems from a file or folder instead")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="store outcomes in FILE and continue from there")
    parser.add_argument(
        "--stop-after", type=float, default=float("inf"), help="with --resume: stop after this time [s]"
    )


def main() -> None:
    """Run the benchmark."""
    bench = Bench("planner", __doc__, add_options)
    options = bench.options
    panda = options.robot == "panda"
    sections = SECTIONS if panda else ANY_ARM
    rows = options.rows.split(",") if options.rows else list(sections[: -1 if bench.quick and panda else None])
    if set(rows) - set(sections):
        sys.exit(f"--rows: {options.robot} has no {set(rows) - set(sections)}; it has {', '.join(sections)}")
    if not panda and options.problems is not None:
        sys.exit("--problems: files have problems for the Panda; omit --robot")
    store = Store(options.resume)
    until = time.monotonic() + options.stop_after
    headlines: list[tuple[str, float, str, float]] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        peers = filter(None, options.peers.split(",")) if panda else ()
        asked, missing = contenders([OURS, *peers], folder, options.robot)
        for name in missing:
            click.echo(f"{name} is not installed: `make planner-peers`")
        measure = toppra_measure() if panda else None
        for process in (*asked, *([measure] if measure else [])):
            stack.enter_context(process).start()
        sets = Sets(bench, asked, measure, store, until)
        if options.problems is not None:
            share = sets.run(options.problems.stem, read_problems(options.problems))
            headlines.append((f"valid share of the problems of {options.problems.name}", share, "", 0.999))
            rows = []
        if "tabletop" in rows:
            draws = tabletop_draws(options.count or (30 if bench.quick else 1000), options.seed, options.robot)
            headlines.append(("valid share of tabletop problems", sets.run("tabletop", draws, detours=0.5), "", 0.999))
        if "hard" in rows:
            draws = hard_draws(options.hard_count or (1 if bench.quick else 100), options.seed)
            share = sets.run("hard", draws, peers_every=options.peers_every)
            headlines.append(("valid share of hard problems", share, "", 0.995))
        ours = asked[0]
        if "ik" in rows:
            row = ik_row(ours, 1000 if bench.quick else 10_000, options.seed, options.robot)
            headlines.append(("share of reachable poses solved", float(row["valid_share"]), "", 1.0))
            bench.row(**row)
        if "retreat" in rows:
            row = retreat_row(ours, 6 if bench.quick else 200, options.seed, options.robot)
            headlines.append(("share of feasible retreats", float(row["valid_share"]), "", 0.95))
            bench.row(**row)
        if "memory" in rows:
            row = memory_row(ours, 500 if bench.quick else 10_000, options.seed)
            bench.row(**row)
            headlines.append(("memory left of 1 MB", 1.0 - float(row["grown_mib"]), "MiB", 0.0))
        if "load" in rows:
            row = load_row(our_planner, 20 if bench.quick else 200, options.seed)
            headlines.append(("share of plans that do not change under load", float(row["valid_share"]), "", 1.0))
            bench.row(**row)
    name, value, unit, goal = headlines[0]
    bench.finish(name, value, unit, at_least=goal)


class Sets:
    """Runs sets of problems and adds their rows to the table."""

    def __init__(
        self, bench: Bench, asked: list[Contender], measure: Contender | None, store: Store, until: float
    ) -> None:
        """Set the contenders, RoboXim first."""
        self._bench, self._asked, self._measure, self._store, self._until = bench, asked, measure, store, until

    def run(self, name: str, draws: list[Draw], *, peers_every: int = 1, detours: float = 0.0) -> float:
        """Run a set and return RoboXim's share of motions without any fault.

        Args:
            name: Name of the set in the table.
            draws: The problems.
            peers_every: n, so that peers get every n-th problem.
            detours: Minimum share of problems whose direct line collides.
        """
        outcomes, done = run_problems(
            draws, self._asked, self._store, measure=self._measure, peers_every=peers_every, until=self._until
        )
        if not done:
            click.echo(f"{name}: stopped after {len(outcomes)} outcomes; the same command continues")
        proved = infeasible(
            outcomes, draws, self._store, search_s=0.0 if self._bench.quick else self._bench.options.search
        )
        mine = [o for o in outcomes if o.contender == OURS and o.problem not in proved]
        if sum(o.detour for o in mine) < detours * len(mine):
            raise AssertionError(f"only {sum(o.detour for o in mine)} of {len(mine)} {name} problems need a detour")
        families = dict.fromkeys(o.problem.rsplit("-", 1)[0] for o in mine)
        for family in families if len(families) > 1 else []:
            chosen = [o for o in mine if o.problem.rsplit("-", 1)[0] == family]
            self._bench.row(problems=family, contender=OURS, **summary(chosen, OURS, proved))
        for contender in self._asked:
            row = summary(outcomes, contender.name, proved)
            if row:
                self._bench.row(problems=name, contender=contender.name, **row)
        click.echo(
            f"{name}: {sum(not o.clean for o in mine)} of {len(mine)} problems unsolved or not clean, "
            f"{len(proved)} more proved infeasible and not counted"
        )
        return sum(o.clean for o in mine) / max(1, len(mine))


def read_problems(path: Path) -> list[Draw]:
    """Return the problems of a file; print which ones are omitted."""
    try:
        problems, left_out = load_problems(path)
    except ProblemFileError as error:
        sys.exit(str(error))
    for line in left_out:
        click.echo(f"  left out: {line}")
    return file_draws(problems)


if __name__ == "__main__":
    main()
