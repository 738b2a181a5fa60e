"""Runs of contenders over problems: storage of the outcomes, so that a long run can be resumed, and statistics."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import click
import numpy as np
from benchmarks.peers._serve import pack
from benchmarks.planner._contenders import OURS, Contender, Outcome
from benchmarks.planner._exhaustive import is_solvable, why_infeasible
from benchmarks.planner._problems import Problem, tabletop
from benchmarks.planner._problems_hard import FAMILIES, hard

Draw = tuple[str, int, Callable[[], Problem]]
"""Name, seed, and a function that creates the problem."""


class Store:
    """Outcomes by problem and contender, optionally appended to a file."""

    def __init__(self, path: Path | None) -> None:
        """Read the outcomes that the file already has."""
        self._path = path
        self._known: dict[tuple[str, str], Outcome] = {}
        for line in path.read_text().splitlines() if path is not None and path.exists() else ():
            outcome = Outcome(**json.loads(line))
            self._known[outcome.problem, outcome.contender] = outcome

    def get(self, problem: str, contender: str) -> Outcome | None:
        """Return an outcome, or none."""
        return self._known.get((problem, contender))

    def put(self, outcome: Outcome) -> None:
        """Keep an outcome."""
        self._known[outcome.problem, outcome.contender] = outcome
        if self._path is not None:
            plain = {f.name: getattr(outcome, f.name) for f in dataclasses.fields(outcome) if f.name != "positions"}
            with self._path.open("a") as file:
                file.write(json.dumps(plain) + "\n")


def tabletop_draws(count: int, salt: int, robot: str = "panda") -> list[Draw]:
    """Return draws of tabletop problems of an arm."""
    return [(f"tabletop-{seed}", seed, lambda seed=seed: tabletop(seed, salt, robot)) for seed in range(count)]


def hard_draws(count: int, salt: int) -> list[Draw]:
    """Return draws of hard problems, ``count`` of each family, alternating between families."""
    return [
        (f"{family}-{seed}", seed, lambda family=family, seed=seed: hard(family, seed, salt))
        for seed in range(count)
        for family in FAMILIES
    ]


def file_draws(problems: list[Problem]) -> list[Draw]:
    """Return draws of given problems."""
    return [(problem.name, seed, lambda problem=problem: problem) for seed, problem in enumerate(problems)]


def run_problems(
    draws: Iterable[Draw],
    contenders: list[Contender],
    store: Store,
    *,
    measure: Contender | None = None,
    peers_every: int = 1,
    until: float = np.inf,
) -> tuple[list[Outcome], bool]:
    """Let every contender solve every problem, one after the other, in rotating order.

    Args:
        draws: The problems.
        contenders: The contenders.
        store: Contains the known outcomes; receives the new ones.
        measure: Toppra, which times the paths of RoboXim's motions; none: no comparison.
        peers_every: n, so that peers get every n-th problem.
        until: Time of `time.monotonic` at which to stop.

    Returns:
        The outcomes, and whether all problems were tried.
    """
    found: list[Outcome] = []
    for k, (name, seed, make) in enumerate(draws):
        asked = [c for c in contenders if c.name == OURS or k % peers_every == 0]
        known = {c.name: store.get(name, c.name) for c in asked}
        if any(outcome is None for outcome in known.values()):
            if time.monotonic() > until:
                return found, False
            problem = make()
            for contender in asked[k % len(asked) :] + asked[: k % len(asked)]:
                if known[contender.name] is None:
                    outcome = _solve(contender, problem, seed, measure)
                    known[contender.name] = outcome
                    store.put(outcome)
        found += [outcome for outcome in known.values() if outcome is not None]
    return found, True


def _solve(contender: Contender, problem: Problem, seed: int, measure: Contender | None) -> Outcome:
    outcome = contender.solve(problem, seed)
    if contender.name != OURS:
        return outcome
    if measure is not None and outcome.valid and outcome.duration_s > 0.05 and outcome.positions is not None:
        answer = measure.ask({"positions": pack(outcome.positions)})
        outcome = dataclasses.replace(outcome, toppra_s=answer["duration_s"])
    return outcome


INFEASIBLE = "infeasible: "
"""Prefix of the search's result for a problem that is proved infeasible."""


def infeasible(outcomes: list[Outcome], draws: Iterable[Draw], store: Store, *, search_s: float) -> set[str]:
    """Return the problems that are proved infeasible; print every failure of RoboXim and what is known about it.

    Args:
        outcomes: Outcomes of the contenders.
        draws: The problems.
        store: Stores the search's results.
        search_s: Duration of the search for a problem that no contender solves [s]; 0: no search.
    """
    solved = {outcome.problem for outcome in outcomes if outcome.valid}
    makers = {name: make for name, _, make in draws}
    proved = set()
    for outcome in outcomes:
        if outcome.contender != OURS or outcome.clean:
            continue
        said = outcome.error or outcome.faults or outcome.violations
        note = "another contender solves it"
        if outcome.problem not in solved:
            note = _known_of(makers[outcome.problem], outcome.problem, store, search_s)
            if note.startswith(INFEASIBLE):
                proved.add(outcome.problem)
        click.echo(f"  {outcome.problem}: {said[:160]} ({note})")
    return proved


def _known_of(make: Callable[[], Problem], name: str, store: Store, search_s: float) -> str:
    """Return the status of a problem that no contender solved: proved infeasible, solved by a search, or neither."""
    known = store.get(name, "search")
    if known is None or (known.error and not known.error.startswith(INFEASIBLE)):
        problem = make()
        why = why_infeasible(problem)
        if not why and search_s == 0.0:
            return "unsolved, not searched"
        error = f"{INFEASIBLE}{why}" if why else "" if is_solvable(problem, search_s) else "unsolved"
        known = Outcome(problem=name, contender="search", ms=0.0, error=error)
        store.put(known)
    if known.error.startswith(INFEASIBLE):
        return known.error
    return f"unsolved: a search of {search_s:g} s fails too" if known.error else "a search solves it"


def summary(outcomes: list[Outcome], contender: str, without: set[str]) -> dict[str, str | float]:
    """Return a contender's row of the table; the problems in ``without``, proved infeasible, do not count."""
    everything = [o for o in outcomes if o.contender == contender]
    mine = [o for o in everything if o.problem not in without]
    if not mine:
        return {}
    times = [o.ms for o in mine]
    ratios = [o.duration_s / o.toppra_s for o in mine if o.toppra_s > 0.0]
    row: dict[str, str | float] = {
        "count": len(mine),
        "detours": sum(o.detour for o in mine),
        "answered": sum(not o.error for o in mine),
        "valid": sum(o.valid for o in mine),
        "unsolved": sum(not o.valid for o in mine),
        "infeasible": len(everything) - len(mine),
        "valid_share": round(sum(o.valid for o in mine) / len(mine), 4),
        "collisions": sum("collision" in o.faults for o in mine),
        "limits_broken": sum(bool(o.violations) for o in mine),
        "median_ms": round(float(np.median(times)), 2),
        "p95_ms": round(float(np.percentile(times, 95)), 2),
        "max_ms": round(max(times), 1),
    }
    if contender != OURS:
        theirs = {o.problem for o in mine}
        ours = [o.ms for o in outcomes if o.contender == OURS and o.problem in theirs]
        row["our_p95_by_theirs"] = round(float(np.percentile(ours, 95) / np.percentile(times, 95)), 3)
        whole = [o.ms + o.scene_ms for o in mine]
        row["with_scene"] = round(float(np.percentile(ours, 95) / np.percentile(whole, 95)), 3)
    if ratios:
        row["duration_vs_toppra"] = round(float(np.median(ratios)), 3)
    return row
