"""Verdicts of comparisons: one of four, with its sentence.

``lower`` and ``higher``: p is at most alpha (0.05), and the 95 % interval excludes 0. ``as_good``: the p value of two
one-sided tests of a difference within the margin is at most alpha. ``cannot_tell``: none of these; the sentence says
what is compatible with the data, and how many more trainings would decide the margin. An absence of evidence is never
called "no difference".

For several comparisons, callers adjust both kinds of p values. Then the probability of any false "lower" or "higher" is
at most alpha, and so is that of any false "as good".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.replicates import MIN_REPLICATES, ConditionDifference, Interval, more_trainings

Kind = Literal["lower", "higher", "as_good", "cannot_tell"]
Question = Literal["checkpoint", "condition"]
MARGIN = 0.10
"""Default for the largest difference that counts as equally good."""


ONE_TRAINING = "One training says nothing about the way to train."
"""Warning against a wrong conclusion from a checkpoint's result."""


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
    p_as_good: float
    """p value of two one-sided tests of a difference within the margin; adjusted where several comparisons are made."""
    sentence: str
    """The verdict in one sentence."""


def condition_verdict(
    first: str,
    second: str,
    difference: ConditionDifference,
    *,
    margin: float = MARGIN,
    p_value: float | None = None,
    p_as_good: float | None = None,
    comparisons: int = 1,
    alpha: float = 0.05,
) -> Verdict:
    """Compare two training conditions (Q2).

    Args:
        first: Name of the first condition, for the sentence.
        second: Name of the second condition.
        difference: Difference over at least three replicates.
        margin: Largest difference that counts as equally good, 0..1.
        p_value: Adjusted p value, where several comparisons are made; none: the difference's own.
        p_as_good: Adjusted p value of a difference within the margin, likewise.
        comparisons: Number of comparisons that the p values are adjusted for.
        alpha: Largest p value that shows a difference, or one within the margin; at most 0.05.
    """
    interval = difference.interval()
    own = difference.p_value if p_value is None else p_value
    one = difference.replicates == 1
    many = f"{difference.replicates} training{'' if one else 's'} each"
    if difference.replicates < MIN_REPLICATES:
        sentence = (
            f"Cannot tell whether {first} is better or worse than {second} as a way to train: {many} do{'es' * one} "
            f"not show how much trainings differ; at least {MIN_REPLICATES} are needed."
        )
        return Verdict(
            kind="cannot_tell", question="condition", difference=interval, p_value=1.0, p_as_good=1.0, sentence=sentence
        )  # fmt: skip
    alone = difference.p_as_good(margin)
    equal = alone if p_as_good is None else p_as_good
    narrow = difference.interval(confidence=1 - 2 * alpha)
    if own <= alpha and (interval.low > 0 or interval.high < 0):
        kind: Kind = "lower" if interval.high < 0 else "higher"
        sentence = f"{first} is {kind} than {second} by {_points(interval)}, over {many}"
        sentence += f"; the difference is within the margin of {100 * margin:.0f} points." if equal <= alpha else "."
    elif equal <= alpha:
        kind = "as_good"
        adjusted = _adjusted(equal, comparisons)
        sentence = (
            f"{first} is as good as {second} within {100 * margin:.0f} points: the difference is "
            f"{_signed(narrow, alpha)}, over {many}{adjusted}."
        )
    else:
        kind = "cannot_tell"
        sentence = _undecided(
            first, second, difference, margin=margin, own=own, equal=equal, comparisons=comparisons, alpha=alpha
        )
    return Verdict(
        kind=kind, question="condition", difference=interval, p_value=own, p_as_good=equal, sentence=sentence
    )  # fmt: skip


def _undecided(
    first: str,
    second: str,
    difference: ConditionDifference,
    *,
    margin: float,
    own: float,
    equal: float,
    comparisons: int,
    alpha: float,
) -> str:
    """Return the sentence of two conditions between which nothing is decided: why, and what would decide."""
    interval, alone, points = difference.interval(), difference.p_as_good(margin), f"{100 * margin:.0f} points"
    many, limit = f"{difference.replicates} trainings each", "" if alpha == 0.05 else f" (limit {alpha:g})"
    asked, adjustment = f"differs from {second}", _raised(own, difference.p_value)
    if alone <= alpha:  # adjustment for several comparisons decides
        asked, adjustment = f"is as good as {second} within {points}", _raised(equal, alone)
        narrow = _signed(difference.interval(confidence=1 - 2 * alpha), alpha)
        adjusted = f"{_p(equal, 'is ')}{limit} after adjustment for {comparisons} comparisons"
        unclear = f"the difference is {narrow}, but {adjusted}, over {many}"
    elif interval.low > 0 or interval.high < 0:  # likewise
        adjusted = f"p is {own:.2g}{limit}"
        if own > difference.p_value:
            adjusted += " after adjustment for several comparisons"
        unclear = f"the difference is {_number(interval.value)} points, but {adjusted}, over {many}"
    else:
        unclear = f"{_number(interval.low)} to {_number(interval.high)} points are compatible with {many}"
    more = more_trainings(difference, margin, alpha=alpha / adjustment)
    needed = {None: "", 0: "; more scenes for each training would decide"}.get(
        more, f"; about {more} more training{'' if more == 1 else 's'} each would decide {points}"
    )
    return f"Cannot tell whether {first} {asked}: {unclear}{needed}."


def checkpoint_verdict(
    first: str,
    second: str,
    pairs: Pairs,
    *,
    margin: float = MARGIN,
    p_value: float | None = None,
    p_as_good: float | None = None,
    comparisons: int = 1,
    alpha: float = 0.05,
    trained: tuple[bool, bool] = (True, True),
    score: bool = True,
) -> Verdict:
    """Compare two checkpoints, or untrained policies, on the same scenes (Q1).

    Args:
        first: Name of the first checkpoint, for the sentence.
        second: Name of the second checkpoint.
        pairs: Outcomes of both on each scene.
        margin: Largest difference that counts as equally good, 0..1.
        p_value: Adjusted p value, where several comparisons are made; none: that of the exact McNemar test.
        p_as_good: Adjusted p value of a difference within the margin; none: the difference's own.
        comparisons: Number of comparisons that the p values are adjusted for.
        alpha: Largest p value that shows a difference, or one within the margin; at most 0.05.
        trained: Whether each is a checkpoint; sentences name others, e.g. ``random``, without that word.
        score: Method of the interval, see `paired_difference`.

    Raises:
        InvalidRequestError: If there are no scenes.
    """
    found = paired_difference(pairs, score=score)
    own = found.p_value if p_value is None else p_value
    interval = Interval(value=found.value, low=found.low, high=found.high)
    alone = found.p_as_good(margin)
    equal = alone if p_as_good is None else p_as_good
    low, high = found.narrowed(alpha)
    narrow = Interval(value=found.value, low=low, high=high)
    where = "on the one scene that both met" if pairs.scenes == 1 else f"on {pairs.scenes} scenes that both met"
    one, other = checkpoint_names(first, second, trained)
    starting = f"T{one[1:]}" if trained[0] else one
    kind: Kind
    if own <= alpha:
        kind = "lower" if found.value < 0 else "higher"
        verb = (
            f"is {kind} than"
            if all(trained)
            else {"lower": "succeeds less often than", "higher": "succeeds more often than"}[kind]
        )
        sentence = f"{starting} {verb} {other} by {_points(interval)}, {where}."
    elif equal <= alpha:
        kind = "as_good"
        adjusted = _adjusted(equal, comparisons)
        sentence = (
            f"{starting} is as good as {other} within {100 * margin:.0f} points: the "
            f"difference is {_signed(narrow, alpha)}, {where}{adjusted}."
        )
    else:
        kind = "cannot_tell"
        asked = f"differs from {other}"
        unclear = f"{_number(interval.low)} to {_number(interval.high)} points are compatible"
        if alone <= alpha:  # adjustment for several comparisons decides
            asked = f"is as good as {other} within {100 * margin:.0f} points"
            adjusted = f"{_p(equal, 'is ')} after adjustment for {comparisons} comparisons"
            unclear = f"the difference is {_signed(narrow, alpha)}, but {adjusted}"
        elif interval.low > 0 or interval.high < 0:  # the exact test is stricter, or the adjustment decides
            adjusted = " after adjustment for several comparisons" if own > found.p_value else ""
            unclear = f"the difference is {_number(interval.value)} points, but p is {own:.2g}{adjusted}"
        sentence = f"Cannot tell whether {one} {asked}: {unclear}, {where}."
    return Verdict(
        kind=kind, question="checkpoint", difference=interval, p_value=own, p_as_good=equal,
        sentence=f"{sentence} {ONE_TRAINING}" if any(trained) else sentence,
    )  # fmt: skip


def checkpoint_names(first: str, second: str, trained: tuple[bool, bool]) -> tuple[str, str]:
    """Return how a sentence names two policies: as checkpoints, if they are some."""
    one = f"this checkpoint of {first}" if trained[0] else first
    return one, f"this {'one' if trained[0] else 'checkpoint'} of {second}" if trained[1] else second


def _raised(adjusted: float, alone: float) -> float:
    """Return by how much an adjustment raised a p value."""
    return max(1.0, adjusted / alone) if alone else 1.0


def _adjusted(p: float, comparisons: int) -> str:
    """Return the addition to a sentence whose p value is adjusted."""
    return f" ({_p(p)} after adjustment for {comparisons} comparisons)" if comparisons > 1 else ""


def _p(p: float, verb: str = "") -> str:
    """Format a p value, e.g. ``p 0.012``, or with a verb ``p is 0.012``."""
    return f"p {verb}{p:.2g}" if p >= 0.001 else f"p {verb}below 0.001"


def _points(interval: Interval) -> str:
    ends = sorted((abs(interval.low), abs(interval.high)))
    return f"{100 * abs(interval.value):.0f} points ({100 * ends[0]:.0f} to {100 * ends[1]:.0f})"


def _signed(narrow: Interval, alpha: float) -> str:
    """Format a difference with the interval of two one-sided tests, which lies within the margin."""
    confidence = f"{100 * (1 - 2 * alpha):g} % interval"
    return f"{_number(narrow.value)} points ({confidence} {_number(narrow.low)} to {_number(narrow.high)})"


def _number(difference: float) -> str:
    """Format a difference in points with its sign, e.g. ``-7``; never ``-0``."""
    return f"{round(100 * difference) + 0:+d}"
