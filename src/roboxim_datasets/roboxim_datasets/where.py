"""Conditions that choose episodes: ``skill=pick_up``, ``target.color!=red``, ``steps<100``.

A condition is KEY, an operator, and a value. `=` and `!=` take several values, separated by commas: one of them, or
none of them; ``*`` and ``?`` in a value stand for any characters. ``<``, ``<=``, ``>`` and ``>=`` compare numbers.
Several conditions hold together.

A selection file (``@FILE``) may also edit episodes, the source untouched: ``trim EPISODE FIRST..LAST`` keeps these
steps, both included and counted from 0; ``relabel EPISODE WORDS`` gives it another instruction. There is no other
syntax.
"""

from __future__ import annotations

import fnmatch
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from roboxim_core.errors import InvalidRequestError, one_of, printable
from roboxim_core.plain_data.documents import read_text
from roboxim_core.seeds import CELL
from roboxim_core.specs import TaskSpec

Fact = tuple[str, ...]
"""Values of a key, as text; several if the episode has several, e.g. of ``object``."""
_CONDITION = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(!=|<=|>=|=|<|>)\s*(.*?)\s*")
_EDIT = re.compile(r"\s*(trim|relabel)\s+([\w.:/-]+)\s+([^=].*?)\s*")
_STEPS = re.compile(r"(\d{1,9})\.\.(\d{1,9})")
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

    @property
    def text(self) -> str:
        """The condition as `parse` reads it."""
        return f"{self.key}{self.sign}{','.join(self.values)}"

    def holds(self, facts: Mapping[str, Fact]) -> bool:
        """Return whether an episode meets the condition; an episode without the key meets only ``!=``."""
        found = facts.get(self.key, ())
        if self.sign in _ORDER:
            wanted = float(self.values[0])
            numbers = [number for value in found if (number := _number(value)) is not None]
            return any(_ORDER[self.sign](number, wanted) for number in numbers)
        matches = any(_matches(value, pattern) for value in found for pattern in self.values)
        return matches if self.sign == "=" else not matches


@dataclass(frozen=True, kw_only=True)
class Edit:
    """A change of one episode."""

    episode: str
    """Id of the episode."""
    steps: tuple[int, int] | None = None
    """First and last step to keep; None: all."""
    instruction: str = ""
    """New instruction; empty: as recorded."""

    @staticmethod
    def parse(text: str) -> Edit | None:
        """Read an edit; None when the text is not an edit, so that it must be a condition.

        Raises:
            InvalidRequestError: When it begins like an edit and is none.
        """
        found = _EDIT.fullmatch(text)
        if not found:
            return None
        kind, episode, rest = found.groups()
        if kind == "relabel":
            if not rest.isprintable():
                raise InvalidRequestError(f"'{printable(text, 120)}': an instruction has printable characters only")
            return Edit(episode=episode, instruction=rest)
        steps = _STEPS.fullmatch(rest)
        if not steps or int(steps[1]) > int(steps[2]):
            raise InvalidRequestError(f"an edit is 'trim EPISODE FIRST..LAST', e.g. trim {episode} 5..40; got '{text}'")
        return Edit(episode=episode, steps=(int(steps[1]), int(steps[2])))

    @property
    def texts(self) -> tuple[str, ...]:
        """The edit as `parse` reads it, a text for each kind of change."""
        trim = f"trim {self.episode} {self.steps[0]}..{self.steps[1]}" if self.steps else ""
        return tuple(filter(None, (trim, self.instruction and f"relabel {self.episode} {self.instruction}")))

    def require_within(self, length: int) -> tuple[int, int]:
        """Return the steps to keep of an episode with a number of steps.

        Raises:
            InvalidRequestError: When it has fewer steps.
        """
        first, last = self.steps or (0, length - 1)
        if last >= length:
            raise InvalidRequestError(f"{self.texts[0]}: the episode has the steps 0..{length - 1}")
        return first, last


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Conditions and edits together."""

    conditions: tuple[tuple[str, Condition], ...] = ()
    """Each condition with its text."""
    given: tuple[Edit, ...] = ()
    """Edits in the order of their texts."""

    @staticmethod
    def parse(texts: Iterable[str]) -> Choice:
        """Read conditions and edits.

        Raises:
            InvalidRequestError: On a text that is neither.
        """
        conditions: list[tuple[str, Condition]] = []
        edits: list[Edit] = []
        for text in texts:
            edit = Edit.parse(text)
            if edit is None:
                conditions.append((text, Condition.parse(text)))
            else:
                edits.append(edit)
        return Choice(conditions=tuple(conditions), given=tuple(edits))

    @property
    def edits(self) -> Mapping[str, Edit]:
        """Name of an episode to all that is done to it by this name."""
        names = dict.fromkeys(edit.episode for edit in self.given)
        return {name: edit for name in names if (edit := self.edit_of((name,)))}

    def edit_of(self, names: Fact) -> Edit | None:
        """Return all that is done to an episode, by any of its names; None: nothing.

        Of two edits of one kind the later one counts.
        """
        found: Edit | None = None
        for edit in self.given:
            if edit.episode in names:
                before = found or edit
                words = edit.instruction or before.instruction
                found = replace(edit, steps=edit.steps or before.steps, instruction=words)
        return found

    def require_known(self, episodes: Sequence[Mapping[str, Fact]]) -> None:
        """Refuse conditions and edits that no episode can be meant by.

        Raises:
            InvalidRequestError: Naming the keys, values or episodes that occur.
        """
        require_known([condition for _, condition in self.conditions], episodes)
        names = {name for facts in episodes for name in facts.get("episode", ())}
        for name in (edit.episode for edit in self.given):
            if name not in names:
                raise InvalidRequestError(f"no episode '{name}' to edit; {one_of(names, name)}")

    def refusal(self, facts: Mapping[str, Fact]) -> str:
        """Return the text of the first condition that an episode does not meet; empty: it meets all."""
        return next((text for text, condition in self.conditions if not condition.holds(facts)), "")


def with_files(texts: Iterable[str]) -> tuple[str, ...]:
    """Return conditions and edits, ``@FILE`` replaced by the file's lines; empty lines and ``#`` are comments.

    Raises:
        ConfigError: When a file cannot be read.
        InvalidRequestError: When a line is neither; names the line.
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
                Choice.parse([condition])
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


def cell_of(task: TaskSpec) -> str:
    """Return the cell of a task: that of its mix if it has one, else its skill."""
    return task.drawn.get(CELL, task.skill)


def facts_of_task(task: TaskSpec) -> dict[str, Fact]:
    """Return the facts of an episode that its task holds.

    ``object`` has the models of the task's objects. A role (``target``) has its model, ``target.color`` a modifier of
    it. ``drawn.<name>`` has a drawn parameter, ``argument.<name>`` an argument.
    """
    facts: dict[str, Fact] = {
        "skill": (task.skill,),
        "cell": (cell_of(task),),
        "object": tuple(dict.fromkeys(thing.model for thing in task.objects.values())),
    }
    for role, thing in task.objects.items():
        facts[role] = (thing.model,)
        facts |= {f"{role}.{name}": (_text(value),) for name, value in thing.modifiers.items()}
    facts |= {f"argument.{name}": (_text(value),) for name, value in task.arguments.items()}
    return facts | {f"drawn.{name}": (value,) for name, value in task.drawn.items()}


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _matches(value: str, pattern: str) -> bool:
    if any(sign in pattern for sign in "*?"):
        return fnmatch.fnmatchcase(value, pattern.replace("[", "[[]"))
    numbers = _number(value), _number(pattern)
    return value == pattern or (None not in numbers and numbers[0] == numbers[1])


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
