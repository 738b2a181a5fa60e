"""Scores of a rotated design: each part has its own held-out set, see `roboxim_eval.experiments.rotation`.

Two intervals answer two questions:

- **cells as a sample**: how good are the conditions in all cells that could have been held out? Each set of cells is
  one observation, regardless of its number of trainings: Student's t over the sets.
- **these cells**: how good are they in the cells of this design? With several trainings of each set, their spread
  within the sets is the error; with one, the spread between sets, which is too wide for this question, but never too
  narrow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.components import student_limit
from roboxim_eval.statistics.equivalence import NORMAL
from roboxim_eval.statistics.replicates import ConditionDifference, Interval, condition_difference, condition_rate
from roboxim_eval.statistics.tables import Arm, total
from roboxim_eval.statistics.training_spread import Trainings, mean_rate_interval


@dataclass(frozen=True, kw_only=True)
class Part:
    """Outcomes of both conditions in the held-out cells of a part; trainings are paired by number."""

    first: Arm
    """The leave-out condition."""
    second: Arm
    """The baseline."""


@dataclass(frozen=True, kw_only=True)
class RotatedScore:
    """Scores over all sets."""

    sets: int
    """Number of held-out sets."""
    cells: int
    """Number of cells of a set."""
    trainings: int
    """Trainings of each condition in each set."""
    absolute: Interval
    """Success rate of the leave-out condition in held-out cells, with cells as a sample."""
    baseline: Interval
    """That of the baseline, with cells as a sample."""
    gap: ConditionDifference
    """What holding out costs, baseline minus leave-out, a difference for each set: with cells as a sample."""
    gap_of_all_cells: Interval
    """95 % interval of the gap with cells as a sample: the union of Student's t over the sets and of one from both
    rates' own intervals, which holds where rates are near 0 or 1 and few sets agree by chance."""
    gap_of_these_cells: Interval
    """95 % interval of the gap over the cells of this design."""
    p_value: float
    """Error probability at which the interval of the gap with cells as a sample begins to include 0."""


def rotated_score(parts: Sequence[Part]) -> RotatedScore:
    """Return the scores of a rotated design.

    Args:
        parts: Outcomes of each held-out set; the sets are disjoint.

    Raises:
        InvalidRequestError: When there are fewer than two sets, or they differ in their numbers of cells or trainings.
    """
    sizes = {(len(part.first.cells), len(part.second.cells), len(part.first.replicates)) for part in parts}
    if len(parts) < 2 or len(sizes) != 1:
        raise InvalidRequestError(
            f"sets of a rotated design must be at least 2, with equal numbers of cells and trainings; got {len(parts)} "
            f"sets of {sorted(sizes)}"
        )
    first, second = (_by_set([getattr(part, name) for part in parts]) for name in ("first", "second"))
    gap = replace(condition_difference(second, first), model=None)  # the union with both rates' intervals has its part
    low, high = condition_rate(first), condition_rate(second)
    union = _union(gap.interval(), high, low)
    return RotatedScore(
        sets=len(parts), cells=len(first.cells), trainings=len(parts[0].first.replicates),
        absolute=low, baseline=high, gap=gap, gap_of_all_cells=union,
        gap_of_these_cells=_of_these_cells(parts, gap) if len(parts[0].first.replicates) > 1 else union,
        p_value=max(gap.p_value, _p_of_rates(gap.value, high, low)),
    )  # fmt: skip


def _by_set(arms: Sequence[Arm]) -> Arm:
    """Return an arm whose replicates are the sets: counts of a cell over all trainings, cells named by their place."""
    rows = []
    for arm in arms:
        counts = [total(replicate[cell] for replicate in arm.replicates) for cell in arm.cells]
        rows.append({str(place): count for place, count in enumerate(counts)})
    return replace(arms[0], replicates=tuple(rows))


def _union(interval: Interval, baseline: Interval, absolute: Interval) -> Interval:
    """Return an interval of a difference that reaches at least as far as those of both rates imply.

    Source:
        Method of variance estimates recovery: Zou and Donner, Statistics in Medicine 27 (2008).
    """
    below, above = _distances(baseline, absolute)
    return Interval(
        value=interval.value, low=max(-1.0, min(interval.low, interval.value - below)),
        high=min(1.0, max(interval.high, interval.value + above)),
    )  # fmt: skip


def _distances(baseline: Interval, absolute: Interval) -> tuple[float, float]:
    """Return how far the intervals of both rates let their difference reach below and above its value."""
    return (
        math.hypot(baseline.value - baseline.low, absolute.high - absolute.value),
        math.hypot(baseline.high - baseline.value, absolute.value - absolute.low),
    )


def _p_of_rates(value: float, baseline: Interval, absolute: Interval) -> float:
    """Return the error probability at which the intervals of both rates begin to allow a difference of 0."""
    from scipy.stats import norm

    half = _distances(baseline, absolute)[0 if value > 0 else 1]
    return float(2 * norm.sf(abs(value) / half * NORMAL)) if half else 0.0


def _of_these_cells(parts: Sequence[Part], gap: ConditionDifference) -> Interval:
    """Return the interval from the trainings' spread within the sets; there are at least two in each."""
    differences = np.array([part.second.rates - part.first.rates for part in parts])  # (sets, trainings)
    freedom = differences.size - len(parts)
    spread = math.sqrt(float(differences.var(axis=1, ddof=1).mean()))
    half = student_limit(freedom) * spread / math.sqrt(differences.size)
    alone = replace(gap, differences=(gap.value,) * len(parts)).interval()  # no spread: use the rollouts' part
    among = Interval(
        value=gap.value, low=min(gap.value - half, alone.low), high=max(gap.value + half, alone.high)
    )  # fmt: skip
    first, second = (_within_sets([getattr(part, name) for part in parts]) for name in ("first", "second"))
    return _union(among, second, first)


def _within_sets(arms: Sequence[Arm]) -> Interval:
    """Return the interval of a rate over these cells: `mean_rate_interval` without the differences between sets."""
    rates = np.array([arm.rates for arm in arms])  # (sets, trainings)
    trainings = rates.shape[1]
    spread = (rates - rates.mean(axis=1, keepdims=True)) * math.sqrt(trainings / (trainings - 1))
    alike = np.clip(rates.mean() + spread, 0.0, 1.0).ravel()
    every = (count for arm in arms for replicate in arm.replicates for count in replicate.values())
    counts = [count.episodes for count in every if count.episodes]
    episodes = len(counts) / rates.size * len(counts) / sum(1 / count for count in counts)
    low, high = mean_rate_interval(Trainings(rates=tuple(alike.tolist()), episodes=episodes))
    value = float(rates.mean())
    return Interval(value=value, low=min(low, value), high=max(high, value))
