"""Verdicts of comparisons: one of four, with its sentence.

``lower`` and ``higher``: p is at most alpha (0.05), and the 95 % interval excludes 0. ``as_good``: two one-sided tests
at 5 % each show a difference within the margin. ``cannot_tell``: none of these; the sentence says what is compatible
with the data, and how many more trainings would decide the margin. An absence of evidence is never called "no
difference".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.replicates import LEAST_REPLICATES, ConditionDifference, Interval, more_trainings

Kind = Literal["lower", "higher", "as_good", "cannot_tell"]
Question = Literal["checkpoint", "condition"]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Result of a comparison in words."""

    kind: Kind
    """One of the four verdicts."""
    question: Question
    """``checkpoint`` (Q1: these trained policies) or ``condition`` (Q2: the training condition)."""
    difference: Interval
    """Difference of the success rates, first minus second, with its 95 % interval."""
    p_value: float
    """Two-sided probability of such a difference if both were equal; adjusted where several comparisons are made."""
    sentence: str
    """The verdict in one sentence."""


def condition_verdict(
    first: str,
    second: str,
    difference: ConditionDifference,
    *,
    margin: float = 0.10,
    p_value: float | None = None,
    alpha: float = 0.05,
) -> Verdict:
    """Compare two training conditions (Q2).

    Args:
        first: Name of the first condition, for the sentence.
        second: Name of the second condition.
        difference: Difference over at least three replicates.
        margin: Largest difference that counts as equally good, 0..1.
        p_value: Adjusted p value, where several comparisons are made; none: the difference's own.
        alpha: Largest p value that shows a difference, at most 0.05.
    """
    interval = difference.interval()
    own = difference.p_value if p_value is None else p_value
    one = difference.replicates == 1
    many = f"{difference.replicates} training{'' if one else 's'} each"
    if difference.replicates < LEAST_REPLICATES:
        sentence = (
            f"Cannot tell whether {first} is better or worse than {second} as a way to train: {many} do{'es' * one} "
            f"not show how much trainings differ; at least {LEAST_REPLICATES} are needed."
        )
        return Verdict(kind="cannot_tell", question="condition", difference=interval, p_value=1.0, sentence=sentence)
    narrow = difference.interval(confidence=0.90)
    within = -margin < narrow.low and narrow.high < margin
    if own <= alpha and (interval.low > 0 or interval.high < 0):
        kind: Kind = "lower" if interval.high < 0 else "higher"
        points = _points(interval)
        sentence = f"{first} is {kind} than {second} by {points}, over {many}"
        sentence += f"; the difference is within the margin of {100 * margin:.0f} points." if within else "."
    elif within:
        kind = "as_good"
        sentence = (
            f"{first} is as good as {second} within {100 * margin:.0f} points: the difference is "
            f"{_signed(narrow)}, over {many}."
        )
    else:
        kind = "cannot_tell"
        adjustment = max(1.0, own / difference.p_value) if difference.p_value else 1.0
        more = more_trainings(difference, margin, alpha=alpha / adjustment)
        needed = {None: "", 0: "; more scenes for each training would decide"}.get(
            more, f"; about {more} more training{'' if more == 1 else 's'} each would decide {100 * margin:.0f} points"
        )
        unclear = f"{_number(interval.low)} to {_number(interval.high)} points are compatible with {many}"
        if interval.low > 0 or interval.high < 0:  # adjustment for several comparisons decides
            limit = "" if alpha == 0.05 else f" (limit {alpha:g})"
            adjusted = f"p is {own:.2g}{limit} after adjustment for several comparisons"
            unclear = f"the difference is {_number(interval.value)} points, but {adjusted}, over {many}"
        sentence = f"Cannot tell whether {first} differs from {second}: {unclear}{needed}."
    return Verdict(kind=kind, question="condition", difference=interval, p_value=own, sentence=sentence)


def checkpoint_verdict(
    first: str, second: str, pairs: Pairs, *, margin: float = 0.10, p_value: float | None = None, alpha: float = 0.05
) -> Verdict:
    """Compare two checkpoints on the same scenes (Q1).

    Args:
        first: Name of the first checkpoint, for the sentence.
        second: Name of the second checkpoint.
        pairs: Outcomes of both on each scene.
        margin: Largest difference that counts as equally good, 0..1.
        p_value: Adjusted p value, where several comparisons are made; none: that of the exact McNemar test.
        alpha: Largest p value that shows a difference, at most 0.05.

    Raises:
        InvalidRequestError: If there are no scenes.
    """
    found = paired_difference(pairs)
    own = found.p_value if p_value is None else p_value
    interval = Interval(value=found.value, low=found.low, high=found.high)
    scale = 1.6449 / 1.9600  # of the 90 % interval, by which two one-sided tests at 5 % decide
    narrow = Interval(
        value=found.value,
        low=found.value - scale * (found.value - found.low),
        high=found.value + scale * (found.high - found.value),
    )
    within = -margin < narrow.low and narrow.high < margin
    where = "on the one scene that both met" if pairs.scenes == 1 else f"on {pairs.scenes} scenes that both met"
    kind: Kind
    if own <= alpha:
        kind = "lower" if found.value < 0 else "higher"
        sentence = f"This checkpoint of {first} is {kind} than this one of {second} by {_points(interval)}, {where}."
    elif within:
        kind = "as_good"
        sentence = (
            f"This checkpoint of {first} is as good as this one of {second} within {100 * margin:.0f} points: the "
            f"difference is {_signed(narrow)}, {where}."
        )
    else:
        kind = "cannot_tell"
        unclear = f"{_number(interval.low)} to {_number(interval.high)} points are compatible"
        if interval.low > 0 or interval.high < 0:  # the exact test is stricter, or adjustment decides
            adjusted = " after adjustment for several comparisons" if own > found.p_value else ""
            unclear = f"the difference is {_number(interval.value)} points, but p is {own:.2g}{adjusted}"
        sentence = (
            f"Cannot tell whether this checkpoint of {first} differs from this one of {second}: {unclear}, {where}."
        )
    return Verdict(
        kind=kind, question="checkpoint", difference=interval, p_value=own,
        sentence=f"{sentence} One training says nothing about the way to train.",
    )  # fmt: skip


def _points(interval: Interval) -> str:
    ends = sorted((abs(interval.low), abs(interval.high)))
    return f"{100 * abs(interval.value):.0f} points ({100 * ends[0]:.0f} to {100 * ends[1]:.0f})"


def _signed(narrow: Interval) -> str:
    """Format a difference with its 90 % interval, which lies within the margin."""
    return f"{_number(narrow.value)} points (90 % interval {_number(narrow.low)} to {_number(narrow.high)})"


def _number(difference: float) -> str:
    """Format a difference in points with its sign, e.g. ``-7``; never ``-0``."""
    return f"{round(100 * difference) + 0:+d}"
