"""The page of one episode: its film in step with commands, measures and verdict, and the reason of its outcome."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from roboxim_core.plain_data.tables import aligned
from roboxim_eval.report.charts.course import Curve, course_chart, value_text
from roboxim_eval.report.course import ConditionCourse, shown
from roboxim_eval.report.films import Film
from roboxim_eval.report.page import render
from roboxim_eval.report.reasons import explained


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """Curves that belong together, e.g. the components of the action."""

    name: str
    """Name of the group."""
    curves: Sequence[Curve]
    """The curves, each in its own chart."""
    about: str = ""
    """Meaning of their lines; empty: one line each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherWay:
    """Episode of another actor in the same scene."""

    name: str
    """The actor."""
    outcome: str
    """How its episode ended."""
    text: str
    """Description of the episode."""
    film: Film | None = None
    """Its film; none: without cameras."""
    link: str = ""
    """Link to its own page; empty: none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodePage:
    """Content of a page."""

    episode_id: str
    """The episode."""
    actor: str
    """Policy that acted."""
    instruction: str
    """The instruction that it received."""
    outcome: str
    """``success``, ``failure`` or ``error``."""
    reason: str
    """Reason why it did not succeed."""
    explanation: str
    """Description of the episode, a sentence with numbers."""
    message: str
    """Details for a person."""
    steps: int
    """Number of actions."""
    ticks: int
    """Number of ticks, tick 0 and those of settling included."""
    tick_s: float
    """Time between two ticks [s]."""
    conditions: Sequence[ConditionCourse]
    """Conditions of the verdict; empty: unknown."""
    signals: Sequence[Signals]
    """Actions, gripper, joints."""
    held: Sequence[Mapping[str, str]]
    """Objects of the scene, a row each."""
    facts: Mapping[str, str]
    """Further facts."""
    commands: str
    """Commands that show and execute it again."""
    film: Film | None = None
    """All its frames; none: it has no cameras."""
    others: Sequence[OtherWay] = ()
    """Episodes of others in the same scene."""
    nobody: str = ""
    """Why there are no others, and how to add some; empty: there are others."""
    log: str = ""
    """Printed output of the policy."""
    log_note: str = ""
    """Why its output is missing; empty: it is available."""
    notes: Sequence[str] = field(default=())
    """Remarks for the reader, e.g. that conditions are unknown."""


def cause_of(conditions: Sequence[ConditionCourse], reason: str) -> ConditionCourse | None:
    """Return the deciding condition: the one that gives the reason, else the first that is broken at the end."""
    broken = [one for one in conditions if one.broken_at_end or (one.fatal and not one.holds.all())]
    named = [one for one in broken if reason in (one.reason, f"not_{one.name}")]
    return next(iter([*named, *broken]), None)


def lost_at(one: ConditionCourse) -> int | None:
    """Return the tick at which a condition was lost, or a fatal one broken; None: it never held, or never broke."""
    if one.fatal and not one.holds.all():
        return int(np.argmin(one.holds))
    return one.lost_at


def state_of(one: ConditionCourse) -> str:
    """Return the history of a condition, in words."""
    lost = lost_at(one)
    if lost is not None:
        return f"lost at tick {lost}"
    if one.holds.all():
        return "held throughout"
    if not one.holds.any():
        return "never held"
    return f"held from tick {int(np.argmin(one.holds[::-1]) * -1 + len(one.holds))} on"


def episode_page(page: EpisodePage) -> str:
    """Return the page as HTML; it needs no other file."""
    cause = cause_of(page.conditions, page.reason) if page.outcome != "success" else None
    order = sorted(page.conditions, key=lambda one: (one is not cause, one.holds.all()))
    return render(
        "episode.html",
        title=f"{page.instruction}: {page.outcome}",
        page=page,
        meaning=explained(page.reason) if page.reason else "",
        conditions=[_condition(one, page, one is cause) for one in order],
        jump=None if cause is None else lost_at(cause) if lost_at(cause) is not None else cause.best_at,
        signals=[
            {"name": one.name, "about": one.about, "charts": [_chart(curve) for curve in one.curves]}
            for one in page.signals
        ],
        data=_data(page),
    )


def _condition(one: ConditionCourse, page: EpisodePage, cause: bool) -> dict[str, Any]:
    curve = Curve(
        name=one.words, lines=(one.values,), measure=one.measure, limits=(one.least, one.most), broken=~one.holds,
        mark=lost_at(one),
    )  # fmt: skip
    return {
        "name": one.name.replace("_", " "), "limit": f"{one.words} {one.limit_text}", "state": state_of(one),
        "cause": cause, "passed": bool(one.holds[-1]) and not (one.fatal and not one.holds.all()),
        "always": bool(one.holds.all()), "meaning": explained(one.reason or f"not_{one.name}"),
        "chart": _chart(curve), "tick": lost_at(one),
    }  # fmt: skip


def _chart(curve: Curve) -> dict[str, Any]:
    return {"name": curve.name, "picture": course_chart(curve)}


def _data(page: EpisodePage) -> Markup:
    text = json.dumps({"ticks": page.ticks, "tick_s": page.tick_s, "steps": page.steps})
    return Markup(text.replace("<", "\\u003c"))


# ------------------------------------------------------------------ in a terminal

SPARKS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 48
FLAT = 1e-4
"""Relative ranges of values up to this size are drawn as constant."""


def sparkline(values: npt.ArrayLike, width: int = SPARK_WIDTH) -> str:
    """Return a line of blocks: the mean of each part of the values, scaled from their smallest to their largest."""
    numbers = np.asarray(values, float)
    numbers = numbers[np.isfinite(numbers)]
    if not len(numbers):
        return ""
    parts = np.array_split(numbers, min(width, len(numbers)))
    means = np.array([part.mean() for part in parts])
    low, high = float(numbers.min()), float(numbers.max())
    share = (means - low) / (high - low) if high - low > FLAT * max(1.0, abs(low), abs(high)) else np.zeros(len(means))
    return "".join(SPARKS[int(round(float(x) * (len(SPARKS) - 1)))] for x in share)


def episode_text(page: EpisodePage) -> str:
    """Return the page in words, with a line of blocks for each measure, for a terminal."""
    reason = f" ({page.reason})" if page.reason else ""
    seconds = page.tick_s * page.steps
    lines = [
        f"{page.instruction}: {page.outcome}{reason}",
        f"{page.actor}, episode {page.episode_id}, {page.steps} actions, {seconds:.1f} s",
    ]
    lines += [text for text in (page.explanation, explained(page.reason) if page.reason else "", page.message) if text]
    if page.conditions:
        cause = cause_of(page.conditions, page.reason) if page.outcome != "success" else None
        decided = " (> decided the outcome)" if cause else ""
        lines += ["", f"conditions{decided}, from the first tick to the last:"]
        rows = [
            (
                f"{'>' if one is cause else ' '} {one.name}", f"{one.words} {one.limit_text}", state_of(one),
                f"{shown(one.measure, float(one.values[-1]))} at the end", sparkline(one.values, 32),
            )
            for one in page.conditions
            if one is cause or not one.holds.all()
        ]  # fmt: skip
        lines += aligned(rows)
        kept = [one.name for one in page.conditions if one.holds.all() and one is not cause]
        lines += [f"  held throughout: {', '.join(kept)}"] if kept else []
    for signals in page.signals:
        lines += ["", f"{signals.name}:"]
        lines += aligned([
            (f"  {curve.name}", " to ".join(value_text(curve, end) for end in _ends(curve)), sparkline(curve.lines[0]))
            for curve in signals.curves
        ])  # fmt: skip
    lines += ["", "the scene held:"]
    lines += aligned(
        [tuple(f"  {value}" if n == 0 else value for n, value in enumerate(row.values())) for row in page.held]
    )
    lines += ["", "the same scene by others:"]
    lines += [f"  {one.name}: {one.outcome}{'. ' + one.text if one.text else ''}" for one in page.others]
    lines += [f"  {page.nobody}"] if page.nobody else []
    if page.log or page.log_note:
        lines += ["", "what the policy printed:", *(f"  {line}" for line in _folded(page.log or page.log_note))]
    return "\n".join([*lines, *(f"note: {note}" for note in page.notes), "", page.commands])


def _folded(text: str) -> Iterator[str]:
    """Yield lines, and equal ones that follow each other once, with their number."""
    for line, equal in itertools.groupby(text.splitlines()):
        count = sum(1 for _ in equal)
        yield line if count == 1 else f"{line}  ({count} times)"


def _ends(curve: Curve) -> tuple[float, float]:
    """Return the smallest and the largest value of a curve's first line."""
    return float(np.nanmin(curve.lines[0])), float(np.nanmax(curve.lines[0]))
