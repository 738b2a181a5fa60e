"""Conditions that choose episodes: ``skill=pick_up``, ``target.color!=red``, ``steps<100``.

A condition is KEY, an operator, and a value. `=` and `!=` take several values, separated by commas: one of them, or
none of them; ``*`` and ``?`` in a value stand for any characters. ``<``, ``<=``, ``>`` and ``>=`` compare numbers.
Several conditions hold together. There is no other syntax.
"""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.plain_data.documents import read_text
from roboxim_core.seeds import CELL

Fact = tuple[str, ...]
"""Values of a key, as text; several if the episode has several, e.g. of ``object``."""
_CONDITION = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(!=|<=|>=|=|<|>)\s*(.*?)\s*")
_ORDER: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One condition."""

    key: str
    """Key of a fact."""
    sign: str
    """The operator."""
    values: tuple[str, ...]
    """Values to compare with; one for an order comparison."""

    @staticmethod
    def parse(text: str) -> Condition:
        """Read a condition.

        Raises:
            InvalidRequestError: When the text is not a condition.
        """
        found = _CONDITION.fullmatch(text)
        if not found or not found[3]:
            raise InvalidRequestError(
                f"a condition is KEY=VALUE, e.g. skill=pick_up, target.color!=red,blue or steps<100; got '{text}'"
            )
        key, sign, value = found.groups()
        values = tuple(part.strip() for part in value.split(",")) if sign in ("=", "!=") else (value,)
        if sign in _ORDER and _number(value) is None:
            raise InvalidRequestError(f"condition '{text}': '{sign}' compares numbers, got '{value}'")
        return Condition(key=key, sign=sign, values=values)

    def holds(self, facts: Mapping[str, Fact]) -> bool:
        """Return whether an episode meets the condition; an episode without the key meets only ``!=``."""
        found = facts.get(self.key, ())
        if self.sign in _ORDER:
            wanted = float(self.values[0])
            numbers = [number for value in found if (number := _number(value)) is not None]
            return any(_ORDER[self.sign](number, wanted) for number in numbers)
        matches = any(_matches(value, pattern) for value in found for pattern in self.values)
        return matches if self.sign == "=" else not matches


def with_files(texts: Iterable[str]) -> tuple[str, ...]:
    """Return conditions, those of the form ``@FILE`` replaced by the file's lines; empty lines and ``#`` are comments.

    Raises:
        ConfigError: When a file cannot be read.
        InvalidRequestError: When a line is not a condition; names the line.
    """
    found: list[str] = []
    for text in texts:
        if not text.startswith("@"):
            found.append(text)
            continue
        for number, line in enumerate(read_text(text[1:]).splitlines(), start=1):
            if not (condition := line.strip()) or condition.startswith("#"):
                continue
            try:
                Condition.parse(condition)
            except InvalidRequestError as error:
                raise InvalidRequestError(f"{text[1:]} line {number}: {error}") from None
            found.append(condition)
    return tuple(found)


def require_known(conditions: Sequence[Condition], episodes: Iterable[Mapping[str, Fact]]) -> None:
    """Refuse conditions with a key, or a value of ``=``, that occurs in no episode: most likely a misspelling.

    Raises:
        InvalidRequestError: Naming the keys or values that occur.
    """
    occurring: dict[str, set[str]] = {}
    for facts in episodes:
        for key, values in facts.items():
            occurring.setdefault(key, set()).update(values)
    for condition in conditions:
        if condition.key not in occurring:
            raise InvalidRequestError(f"no episode has '{condition.key}'; {one_of(occurring, condition.key)}")
        if condition.sign != "=":
            continue
        known = occurring[condition.key]
        for pattern in condition.values:
            if not any(_matches(value, pattern) for value in known):
                raise InvalidRequestError(f"no episode has {condition.key}={pattern}; {one_of(known, pattern)}")


def _matches(value: str, pattern: str) -> bool:
    if any(sign in pattern for sign in "*?"):
        return fnmatch.fnmatchcase(value, pattern.replace("[", "[[]"))
    numbers = _number(value), _number(pattern)
    return value == pattern or (None not in numbers and numbers[0] == numbers[1])


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def facts_of(info: EpisodeInfo, result: EpisodeResult) -> dict[str, Fact]:
    """Return the facts of an episode that conditions can use; all are known before its ticks are read.

    ``object`` has the models of the task's objects. A role (``target``) has its model, ``target.color`` a modifier of
    it. ``camera`` has the names of the cameras, ``drawn.<name>`` a drawn parameter, ``argument.<name>`` an argument.
    """
    task, scene = info.task, info.scene
    facts: dict[str, Fact] = {
        "episode": (info.episode_id,),
        "skill": (task.skill,),
        "cell": (cell_of(info),),
        "instruction": (task.instruction,),
        "outcome": (result.outcome,),
        "reason": (result.reason,) if result.reason else (),
        "recovered": (str(result.recovered).lower(),),
        "steps": (str(result.steps),),
        "robot": (scene.robot.model,),
        "actor": (info.actor,),
        "renderer": (info.renderer,),
        "purpose": (info.purpose,),
        "run_seed": (str(info.run_seed),),
        "index": (str(info.index),),
        "attempt": (str(info.attempt),),
        "rate_hz": (f"{info.semantics.rate_hz:g}",),
        "camera": tuple(camera.name for camera in scene.cameras),
        "object": tuple(dict.fromkeys(thing.model for thing in task.objects.values())),
        "entity": tuple(dict.fromkeys(entity.model for entity in scene.entities)),
    }
    for role, thing in task.objects.items():
        facts[role] = (thing.model,)
        facts |= {f"{role}.{name}": (_text(value),) for name, value in thing.modifiers.items()}
    facts |= {f"argument.{name}": (_text(value),) for name, value in task.arguments.items()}
    facts |= {f"drawn.{name}": (value,) for name, value in task.drawn.items()}
    return facts


def cell_of(info: EpisodeInfo) -> str:
    """Return the cell of an episode: that of its mix if it has one, else its skill."""
    return info.task.drawn.get(CELL, info.task.skill)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
