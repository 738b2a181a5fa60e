"""How an episode is judged, condition by condition; also with other thresholds than the recorded ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.specs import Scalar, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_tasks.judging import Judge
from roboxim_tasks.measures import Condition
from roboxim_tasks.sequences.skill import skill_of


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A condition at a tick."""

    name: str
    """The condition."""
    measure: str
    """What it bounds, with the unit in the name."""
    value: float
    """The measure's value."""
    bounds: str
    """Where the value must be, e.g. ``>= 0.05``."""
    holds: bool
    """Whether it is there."""
    fatal: bool
    """Whether the task has failed for good when it is not."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The verdicts of an episode's ticks, and the conditions that they follow from."""

    task: TaskSpec
    """The task, with the thresholds that were used."""
    verdicts: tuple[Verdict, ...]
    """Verdict of every tick."""
    conditions: tuple[Condition, ...]
    """The conditions."""
    hold_s: float
    """Time for which all must hold [s]."""

    def lamps(self, seq: int) -> tuple[Lamp, ...]:
        """Return every condition at a tick."""
        predicates = self.verdicts[seq].predicates
        return tuple(
            Lamp(
                name=condition.name,
                measure=condition.measure.name,
                value=predicates.get(condition.measure.name, math.nan),
                bounds=bounds_text(condition),
                holds=bool(predicates.get(condition.name, 0.0)),
                fatal=condition.fatal,
            )
            for condition in self.conditions
        )


def bounds_text(condition: Condition) -> str:
    """Return a condition's bounds, e.g. ``> 0.05``, ``0.1 .. 0.2``.

    A bound just above a number (`roboxim_tasks.measures.above`) is that number, exclusive.
    """
    low, high = condition.least, condition.most
    if math.isinf(low):
        return f"<= {high:.4g}"
    rounded = float(f"{low:.6g}")
    sign = ">" if low == math.nextafter(rounded, math.inf) else ">="
    return f"{sign} {rounded:.4g}" if math.isinf(high) else f"{low:.4g} .. {high:.4g}"


def judge(task: TaskSpec, states: tuple[StateRecord, ...]) -> Judgement:
    """Judge recorded states.

    Raises:
        RoboximError: When the task or its thresholds are not valid, or the states are not those of a complete episode.
    """
    fold = Judge(task)
    verdicts = [fold.start(states[0]), *(fold.step(state) for state in states[1:])]
    return Judgement(task=task, verdicts=tuple(verdicts), conditions=fold.conditions, hold_s=fold.hold_s)


def thresholds(task: TaskSpec) -> dict[str, float]:
    """Return the numbers that a task's judge depends on, with their values; a task of several steps has none.

    Raises:
        TaskError: With code ``UNKNOWN_SKILL`` when the task's skill is not registered.
    """
    defaults = skill_of(task).Parameters()
    values = {item.name: task.arguments.get(item.name, getattr(defaults, item.name)) for item in fields(defaults)}
    return {name: float(value) for name, value in values.items() if isinstance(value, float)}


def with_thresholds(task: TaskSpec, changed: Mapping[str, float]) -> TaskSpec:
    """Return a task with other thresholds.

    Raises:
        ConfigError: When a threshold is unknown.
    """
    known = thresholds(task)
    for name in changed:
        if name not in known:
            raise ConfigError(f"skill '{task.skill}' has no threshold '{name}'; {one_of(known, name)}")
    arguments: dict[str, Scalar] = {**task.arguments, **changed}
    return replace(task, arguments=arguments)
