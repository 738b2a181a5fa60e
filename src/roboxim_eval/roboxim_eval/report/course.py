"""The course of an episode: each condition's measure against its bounds, tick by tick, and a sentence about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_eval.report.reasons import explained

Floats = npt.NDArray[np.float64]

UNITS = {
    "_m_s": (100.0, " cm/s"), "_rad_s": (180.0 / math.pi, "°/s"), "_m": (100.0, " cm"), "_rad": (180.0 / math.pi, "°"),
    "_deg": (1.0, "°"), "_n": (1.0, " N"), "_s": (1.0, " s"),
}  # fmt: skip
"""Ending of a measure's name to the factor and unit in which sentences state it; longer endings first."""
LOST = {"grasped": "slipped", "lifted": "sank", "on_support": "left its support", "inside": "left the container"}
"""Condition to the verb for its loss; for others: "no longer <name>"."""
PHRASES = {
    "pressing_links": "{} fingers pressed it", "lift_m": "lifted {}", "turned_deg": "turned by {}",
    "turned_rad": "turned by {}", "along_m": "moved {} along the direction", "finger_travel_m": "pressed down {}",
    "support_force_n": "its support carried {}",
}  # fmt: skip
"""Measure to a sentence's words for its largest value; for others: "<name> reached"."""
WORDS = {"pressing_links": "fingers pressing it", "table_force_n": "force on the table",
         "sideways_share": "distance from the container's middle (1: its edge)",
         "surface_share": "distance from the support's middle (1: its edge)"}  # fmt: skip
"""Measure to its name for people, where the name itself does not say it."""
MISSING = {"support_force_n": "nothing rested on its support"}
"""Measure to the sentence for a value of 0 where any larger value would have sufficed; others "stayed 0"."""
NOTHING = 0.02
"""Share of a bound below which a value is shown as 0."""
TINY = 1e-6
"""Bounds below this mean "more than 0"."""
MAX_EVENTS = 2
"""Number of conditions that a sentence names."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ConditionCourse:
    """A condition over an episode."""

    name: str
    """Its name, e.g. ``lifted``."""
    measure: str
    """Name of the measure, with its unit, e.g. ``lift_m``."""
    values: Floats
    """The measure at each tick, shape (T,)."""
    holds: npt.NDArray[np.bool_]
    """Whether the condition holds at each tick, shape (T,)."""
    least: float = -math.inf
    """Smallest value at which it holds."""
    most: float = math.inf
    """Largest value at which it holds."""
    reason: str = ""
    """Reason of a failure while it does not hold."""
    fatal: bool = False
    """Whether the task is lost once it has not held."""

    @property
    def words(self) -> str:
        """The measure's name for people, without its unit."""
        return WORDS.get(self.measure) or self.measure.removesuffix(_ending(self.measure)).replace("_", " ")

    @property
    def bound(self) -> float:
        """The bound that counts: the lower one, if there is one."""
        return self.least if math.isfinite(self.least) else self.most

    @property
    def limit_text(self) -> str:
        """The bounds in words, e.g. ``at least 5 cm``."""
        if 0 < self.least < TINY and not math.isfinite(self.most):
            return f"more than {shown(self.measure, 0.0)}"
        ends = [
            f"{word} {shown(self.measure, value)}"
            for word, value in (("at least", self.least), ("at most", self.most))
            if math.isfinite(value)
        ]
        return " and ".join(ends)

    @property
    def broken_at_end(self) -> bool:
        """Whether it does not hold at the last tick."""
        return not self.holds[-1]

    @property
    def lost_at(self) -> int | None:
        """The tick at which it was lost and not regained; None: it holds at the end, or never held."""
        if self.holds[-1] or not self.holds.any():
            return None
        return int(np.flatnonzero(self.holds)[-1]) + 1

    @property
    def peak_at(self) -> int:
        """The tick of the measure's largest value if it must be large, else of the value nearest to its bounds."""
        one_sided = math.isfinite(self.least) and not math.isfinite(self.most)
        return int(np.nanargmax(self.values)) if one_sided and np.isfinite(self.values).any() else self.best_at

    @property
    def best_at(self) -> int:
        """The first tick at which the measure came nearest to its bounds."""
        short = np.maximum(np.maximum(self.least - self.values, self.values - self.most), 0.0)
        return int(np.argmin(np.where(np.isfinite(short), short, np.inf)))


def shown(measure: str, value: float) -> str:
    """Return a measure's value in the unit in which people read it, e.g. ``3.1 cm``."""
    factor, unit = UNITS.get(_ending(measure), (1.0, ""))
    return f"{_number(value * factor)}{unit}"


def _ending(measure: str) -> str:
    return next((ending for ending in UNITS if measure.endswith(ending)), "")


def _number(value: float) -> str:
    """Format a number with two significant digits, or one after the point."""
    text = f"{value:.1f}" if abs(value) >= 0.95 or abs(value) < 1e-9 else f"{value:.2g}"
    text = "0" if abs(value) < 0.005 else text
    return text.removesuffix(".0")


def what_happened(
    conditions: Sequence[ConditionCourse], *, solved: bool, reason: str, hold_s: float = 0.0, held_s: float = 0.0
) -> str:  # fmt: skip
    """Return a description of an unsuccessful episode, with numbers; empty if no condition explains it.

    Args:
        conditions: Its conditions, in the order of their precedence.
        solved: Whether it succeeded.
        reason: Reason of the verdict.
        hold_s: Time that all conditions had to hold [s].
        held_s: Longest time that all of them held [s].
    """
    if solved or not conditions:
        return ""
    broken = [one for one in conditions if one.broken_at_end]
    fatal = [one for one in conditions if one.fatal and not one.holds.all()]
    if fatal:
        first = min(fatal, key=lambda one: int(np.argmin(one.holds)))
        tick = int(np.argmin(first.holds))
        return _sentence(f"{_named(first.reason or 'not_' + first.name)} at tick {tick} ({_value(first, tick)})")
    if not broken:
        kept = f"all conditions held, but for {held_s:.1f} s of {hold_s:g} s" if held_s < hold_s else ""
        return _sentence(kept)
    cause = [one for one in broken if one.reason == reason or f"not_{one.name}" == reason]
    selected = [*cause, *(one for one in broken if one not in cause and _adds_information(one))][:MAX_EVENTS]
    events = sorted((_event(one, one in cause) for one in selected), key=lambda event: event[0])
    joint = ", then " if any(" at tick " in text for _, text in events) else ", "
    return _sentence(joint.join(text for _, text in events))


def explain_steps(words: Sequence[str], done_at: Sequence[int | None], number: int, rest: str) -> str:
    """Return which steps of a longer task were done, and why the next one failed.

    Args:
        words: Sentence of each step.
        done_at: First tick at which each step was done, as it stayed until the end; None: it was not.
        number: Number, from 1, of the step that failed; 0: none did.
        rest: What happened in that step, in a sentence.
    """
    done = [f"step {k} at tick {tick}" for k, tick in enumerate(done_at, start=1) if tick is not None]
    text = f"{len(done)} of {len(words)} steps were done" + (f" ({', '.join(done)})." if done else ".")
    if number:
        text += f" Step {number}, '{words[number - 1]}', was not" + (f": {rest[:1].lower()}{rest[1:]}" if rest else ".")
    return text


def _else(one: ConditionCourse) -> bool:
    """Return whether a broken condition describes another event, e.g. that another object was moved."""
    return bool(one.reason) and not one.reason.startswith("not_")


def _adds_information(one: ConditionCourse) -> bool:
    """Return whether a broken condition adds to the deciding one: how far the episode came, or another event."""
    return math.isfinite(one.least) or (_else(one) and bool(one.holds.any()))


def _event(one: ConditionCourse, cause: bool) -> tuple[int, str]:
    """Return the tick at which the deciding condition was lost, or came nearest to its bounds, and a description."""
    lost = one.lost_at
    if lost is not None and (cause or not math.isfinite(one.least)):
        verb = LOST.get(one.name) or (_named(one.reason) if _else(one) else f"no longer {one.name.replace('_', ' ')}")
        return lost, f"{verb} at tick {lost} ({_value(one, lost)})"
    best = one.peak_at
    if not math.isfinite(one.least):
        return best, f"{one.words} was never below {_of_limit(one, best)}"
    if 0 < one.least < TINY and one.values[best] < one.least:
        return best, MISSING.get(one.measure, f"{one.words} stayed 0")
    text = PHRASES.get(one.measure, f"{one.words} reached {{}}").format(_of_limit(one, best))
    first = one.values[int(np.argmax(np.isfinite(one.values)))]  # a step's conditions are judged from its turn on
    return best, text if abs(one.values[best] - first) <= NOTHING * abs(one.bound) else f"{text} at tick {best}"


def _value(one: ConditionCourse, tick: int) -> str:
    """Return the measure's name and value at a tick, with its bound."""
    return f"{one.words} {_of_limit(one, tick)}"


def _of_limit(one: ConditionCourse, tick: int) -> str:
    value, limit = float(one.values[tick]), shown(one.measure, one.bound)
    text = shown(one.measure, 0.0 if abs(value) < NOTHING * abs(one.bound) else value)
    if not 0 < one.least < math.inf:
        return f"{text}, allowed {limit}"
    if one.bound < TINY:
        return f"{text}, needed more than 0"
    return (
        text if value >= one.least else f"{text} of {limit.removesuffix(UNITS.get(_ending(one.measure), (1.0, ''))[1])}"
    )


def _named(reason: str) -> str:
    """Return the meaning of a reason, as a part of a sentence."""
    text = explained(reason).removesuffix(".")
    return text[0].lower() + text[1:]


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}." if text else ""
