"""Comparison of two training conditions over replicates (Q2).

Success rates of the *same* recipe differ between trainings, by several points. Rollouts of one training therefore show
nothing about the recipe, however many there are: a pooled McNemar test finds differences between equal conditions in a
quarter of all experiments. The trainings are the sample here: one difference of success rates for each replicate, and
Student's t over them.

The interval is never narrower than that of the rollouts alone (Newcombe's). A few replicates can agree by chance, for
example when both conditions always succeed; the sample's spread is then too small. Where a condition nearly always
succeeds or fails, a model of the trainings' spread also widens the interval and decides about "as good".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.equivalence import NORMAL, p_within, two_one_sided
from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.rates import SuccessRate, success_rate
from roboxim_eval.statistics.tables import Arm, require_same_replicates
from roboxim_eval.statistics.training_spread import SCALE, MeanDifference, Trainings, mean_rate_interval

MANY = 10**9
"""Degrees of freedom at which Student's t is the normal distribution."""
MAX_TRAININGS = 10_000
"""Number of trainings above which none is proposed."""
MIN_REPLICATES = 3
"""Number of trainings below which no statement about a training condition is made."""


@lru_cache(maxsize=4096)
def _t_limit(probability: float, freedom: int) -> float:
    """Return a cached quantile of Student's t, which SciPy computes slowly."""
    from scipy.stats import t as student

    return float(student.ppf(probability, freedom))


@dataclass(frozen=True, kw_only=True)
class Interval:
    """An estimate with its two-sided interval."""

    value: float
    """The estimate."""
    low: float
    """Lower bound; -inf: unbounded."""
    high: float
    """Upper bound; inf: unbounded."""

    def __str__(self) -> str:
        """Format, e.g. ``0.72 (0.58 to 0.89)``."""
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


@dataclass(frozen=True, kw_only=True)
class ConditionDifference:
    """Difference of two training conditions, first minus second."""

    differences: tuple[float, ...]
    """Difference of each replicate, -1..1."""
    rollouts: tuple[SuccessRate, SuccessRate]
    """Success rates of both conditions over all replicates, for the rollouts' share of the uncertainty."""
    pairs: Pairs | None = None
    """Outcomes of all replicates on the same scenes, which narrow the rollouts' share; none: the scenes differ, or
    cells of several replicates have different numbers of them. Those of one replicate are Q1's sample."""
    model: MeanDifference | None = None
    """Model of the mean difference of all trainings; none: both rates are far from 0 and 1, or the card is older."""

    @property
    def replicates(self) -> int:
        """Number of replicates."""
        return len(self.differences)

    @property
    def value(self) -> float:
        """Mean difference."""
        return float(np.mean(self.differences))

    @property
    def spread(self) -> float:
        """Standard deviation of a replicate's difference; 0 for one replicate."""
        return float(np.std(self.differences, ddof=1)) if self.replicates > 1 else 0.0

    def interval(self, confidence: float = 0.95) -> Interval:
        """Return the interval of the mean difference at a confidence level; unbounded for one replicate.

        It is the union of Student's t, of the rollouts' interval, and of the model's where there is one. The model does
        not move a bound that excludes 0: equal conditions seldom seem to differ, near 0 and 1 too.
        """
        if self.replicates < 2:
            return Interval(value=self.value, low=-math.inf, high=math.inf)
        half = _t_limit((1 + confidence) / 2, self.replicates - 1) * self.spread / math.sqrt(self.replicates)
        below, above = self._rollouts_alone(confidence)
        low, high = self.value - max(half, below), self.value + max(half, above)
        if self.model is not None:
            bounds = self.model.interval(confidence)
            low = low if low > 0 else min(low, bounds[0])
            high = high if high < 0 else max(high, bounds[1])
        return Interval(value=self.value, low=max(-1.0, low), high=min(1.0, high))

    def _rollouts_alone(self, confidence: float) -> tuple[float, float]:
        """Return the distances of the bounds of the rollouts' interval below and above the difference."""
        first, second = self.rollouts
        scale = _t_limit((1 + confidence) / 2, MANY) / NORMAL
        if self.pairs is not None and self.pairs.scenes:
            paired = paired_difference(self.pairs, score=False)
            return scale * (paired.value - paired.low), scale * (paired.high - paired.value)
        below = math.hypot(first.rate - first.low, second.high - second.rate)
        above = math.hypot(first.high - first.rate, second.rate - second.low)
        return scale * below, scale * above

    @property
    def p_value(self) -> float:
        """Two-sided probability of a mean difference at least as large between equal conditions; 1 for one replicate.

        It is the error probability at which the interval begins to include 0: the larger one of the t test over
        replicates and of the rollouts' test.
        """
        from scipy.stats import norm
        from scipy.stats import t as student

        if self.replicates < 2 or not self.value:
            return 1.0
        error = self.spread / math.sqrt(self.replicates)
        by_trainings = 2 * student.sf(abs(self.value) / error, self.replicates - 1) if error else 0.0
        half = self._rollouts_alone(0.95)[0 if self.value > 0 else 1]
        by_rollouts = 2 * norm.sf(abs(self.value) / half * NORMAL) if half else 0.0
        return float(max(by_trainings, by_rollouts))

    def p_as_good(self, margin: float) -> float:
        """Return the p value of two one-sided tests of a mean difference within a margin; 1 for one replicate.

        It is the smallest ``alpha`` at which the interval at the confidence ``1 - 2 alpha`` is within the margin: the
        largest one of the t tests over replicates, of the rollouts' tests and of the model's.

        Args:
            margin: Largest difference that counts as equally good, 0..1.
        """
        from scipy.stats import t as student

        if self.replicates < 2:
            return 1.0
        error, freedom = self.spread / math.sqrt(self.replicates), self.replicates - 1
        by_trainings = two_one_sided(self.value, error, error, margin, tail=lambda x: student.sf(x, freedom))
        found = max(by_trainings, p_within(self.value, *self._rollouts_alone(0.95), margin))
        if self.model is None:
            return found
        excluded = (self.p_value / 2, 1.0) if self.value > 0 else (1.0, self.p_value / 2)  # bounds that stay
        return max(found, *(min(pair) for pair in zip(excluded, self.model.p_beyond(margin), strict=True)))


def condition_difference(
    first: Arm, second: Arm, pairs: Sequence[Pairs] = (), *, same_cells: bool = True, same_trainings: bool = False
) -> ConditionDifference:
    """Compare two conditions over the cells that both met.

    Args:
        first: Outcomes of the first condition.
        second: Outcomes of the second one, replicate by replicate with the same cells and scenes.
        pairs: Outcomes of each replicate on the scenes that both met; empty: the scenes differ.
        same_cells: Whether to require equal cells; otherwise their difficulty is part of the difference.
        same_trainings: Whether the second condition evaluates the trainings of the first one in another way.

    Raises:
        InvalidRequestError: If replicates or cells differ.
    """
    require_same_replicates(first, second)
    if same_cells and set(first.cells) != set(second.cells):
        odd = ", ".join(sorted(set(first.cells) ^ set(second.cells)))
        raise InvalidRequestError(f"conditions are compared on equal cells; these differ: {odd}")
    differences = first.rates - second.rates
    even = is_even(first, slack=0.1 if len(first.replicates) == 1 else 0.0)  # else some cells would weigh more
    return ConditionDifference(
        differences=tuple(float(d) for d in differences),
        rollouts=(pooled_rate(first), pooled_rate(second)),
        pairs=sum(pairs[1:], start=pairs[0]) if pairs and even else None,
        model=_model(first, second, pairs if even else (), same_trainings=same_trainings),
    )


def is_even(arm: Arm, slack: float = 0.1) -> bool:
    """Return whether an arm's cells have equal numbers of episodes, so that a pooled rate is the mean of the cells.

    Args:
        arm: The arm.
        slack: Part of the largest number that may be missing, e.g. by excluded episodes.
    """
    numbers = [count.episodes for count in arm.by_cell.values()]
    return not numbers or min(numbers) >= (1 - slack) * max(numbers)


def equal_rollouts(arm: Arm) -> float:
    """Return the number of rollouts in equally full cells that would give the mean of the cells' rates as exactly.

    With n_c rollouts in cell c of C cells, it is C^2 / sum(1 / n_c), which equals all rollouts if cells have equal
    numbers.
    """
    counts = [count.episodes for count in arm.by_cell.values() if count.episodes]
    return len(counts) ** 2 / sum(1 / count for count in counts)


def _model(first: Arm, second: Arm, pairs: Sequence[Pairs], *, same_trainings: bool) -> MeanDifference | None:
    """Return the model of two conditions of which one is so near 0 or 1 that its trainings' rates are skewed.

    Conditions of the same trainings differ by the scenes that they lose and by those that they gain, so that the model
    is about these two rates; without pairs there is none.
    """
    modelled = {first.intervals, second.intervals} == {"beta_binomial_differences"}
    near = any(min(arm.rate, 1 - arm.rate) < SCALE for arm in (first, second))
    if len(first.replicates) < 2 or not (modelled and near):
        return None
    if not same_trainings:
        return MeanDifference(first=_trainings(first), second=_trainings(second))
    if not all(pair.scenes for pair in pairs) or len(pairs) < len(first.replicates):
        return None
    episodes = sum(pair.scenes for pair in pairs) / len(pairs)
    lost, gained = ([getattr(pair, side) / pair.scenes for pair in pairs] for side in ("first", "second"))
    return MeanDifference(
        first=Trainings(rates=tuple(lost), episodes=episodes), second=Trainings(rates=tuple(gained), episodes=episodes)
    )


def _trainings(arm: Arm) -> Trainings:
    return Trainings(rates=tuple(arm.rates.tolist()), episodes=equal_rollouts(arm) / len(arm.replicates))


def pooled_rate(arm: Arm) -> SuccessRate:
    """Return the rate of an arm, the mean of its cells', as that of `equal_rollouts`."""
    episodes = max(1, round(equal_rollouts(arm)))
    successes = round(arm.rate * episodes)
    if 0 < arm.rate < 1:
        successes = min(max(successes, 1), episodes - 1)
    return success_rate(successes, episodes)


def condition_rate(arm: Arm) -> Interval:
    """Return the success rate of a condition over its trainings, with its 95 % interval.

    The interval is the union of three: Student's t over the trainings' rates, that of the rollouts alone, and
    `mean_rate_interval`, which holds where trainings agree by chance near 0 and 1. ``student`` omits the last one. For
    one training, it is the interval of its rollouts alone, which shows nothing about other trainings.
    """
    pooled, rates = pooled_rate(arm), arm.rates
    below, above = pooled.rate - pooled.low, pooled.high - pooled.rate
    if len(rates) > 1:
        half = _t_limit(0.975, len(rates) - 1) * float(np.std(rates, ddof=1)) / math.sqrt(len(rates))
        below, above = max(below, half), max(above, half)
    low, high = max(0.0, arm.rate - below), min(1.0, arm.rate + above)
    if len(rates) > 1 and arm.intervals != "student":
        bounds = mean_rate_interval(_trainings(arm))
        low, high = min(low, bounds[0]), max(high, bounds[1])
    return Interval(value=arm.rate, low=low, high=high)


def condition_ratio(first: Arm, second: Arm) -> Interval:
    """Return the ratio of two conditions' success rates: of the means over trainings, never a mean of ratios.

    The logarithm of the ratio has Student's t interval with R - 1 degrees of freedom. Its standard error comes from the
    delta method over replicates: the spread of first_r / mean(first) - second_r / mean(second). The interval is never
    narrower than that of the rollouts alone, by the method of variance estimates recovery on the logarithms of the
    pooled rates and their intervals (Zou and Donner, Statistics in Medicine 27, 2008). The ratio is not clipped at 1.

    Returns:
        The ratio. Unbounded above, and 0 below, for one replicate or if the second condition never succeeds.

    Raises:
        InvalidRequestError: If the replicates differ in number.
    """
    replicates = require_same_replicates(first, second)
    u, s = first.rates, second.rates
    if not s.mean():
        return Interval(value=math.inf if u.mean() else math.nan, low=0.0, high=math.inf)
    ratio = float(u.mean() / s.mean())
    if replicates < 2:
        return Interval(value=ratio, low=0.0, high=math.inf)
    if not u.mean():  # no logarithm exists: use the rates that are compatible with the outcomes
        lowest = condition_rate(second).low
        return Interval(value=0.0, low=0.0, high=condition_rate(first).high / lowest if lowest else math.inf)
    deviation = u / u.mean() - s / s.mean()
    among = _t_limit(0.975, replicates - 1) * float(np.std(deviation, ddof=1)) / math.sqrt(replicates)
    one, two = pooled_rate(first), pooled_rate(second)
    below = math.hypot(math.log(one.rate / one.low), math.log(two.high / two.rate))
    above = math.hypot(math.log(one.high / one.rate), math.log(two.rate / two.low))
    return Interval(value=ratio, low=ratio * math.exp(-max(among, below)), high=ratio * math.exp(max(among, above)))


def mean_interval(estimates: Sequence[Interval]) -> Interval:
    """Return the mean of independent estimates with its 95 % interval, from their own intervals.

    The distance of a bound from the mean is the root of the sum of the squared distances of the estimates' own bounds,
    divided by their number: the method of variance estimates recovery (see `condition_ratio`). Intervals need not be
    symmetric. With few trainings and rates away from 0 and 1 the result is wider than necessary, since each estimate's
    quantile of Student's t enters undiminished. Near 0 and 1 it can be too narrow, as the estimates' own intervals can.

    Args:
        estimates: At least one.
    """
    count = len(estimates)
    value = sum(one.value for one in estimates) / count
    below = math.hypot(*(one.value - one.low for one in estimates)) / count
    above = math.hypot(*(one.high - one.value for one in estimates)) / count
    return Interval(value=value, low=value - below, high=value + above)


def more_trainings(difference: ConditionDifference, margin: float, *, alpha: float = 0.05) -> int | None:
    """Return about how many more trainings an arm would decide a margin with a chance of 80 %.

    Args:
        difference: The difference so far.
        margin: Difference to detect, 0..1.
        alpha: Probability of a false alarm of this comparison, two-sided.

    Returns:
        Number in addition to the present ones; none for one replicate, or if it is above `MAX_TRAININGS`. Where a
        model decides, it is at least the number with which the rates so far would show a difference within the margin.
    """
    if difference.replicates < 2 or margin <= 0:
        return None
    alpha = max(alpha, 1e-9)  # above this, the quantiles become infinite
    first, second = difference.rollouts
    episodes = (first.episodes + second.episodes) / 2 / difference.replicates
    spread = max(difference.spread, 1 / max(1.0, episodes))  # a spread of 0 occurs by chance
    minimum = math.ceil(((_t_limit(1 - alpha / 2, MANY) + _t_limit(0.8, MANY)) * spread / margin) ** 2)
    for replicates in range(max(2, difference.replicates, minimum), MAX_TRAININGS + 1):
        needed = _t_limit(1 - alpha / 2, replicates - 1) + _t_limit(0.8, replicates - 1)
        if needed * spread / math.sqrt(replicates) <= margin:
            return max(replicates - difference.replicates, _more_for_model(difference, margin, alpha))
    return None


def _more_for_model(difference: ConditionDifference, margin: float, alpha: float) -> int:
    """Return how many more trainings with the rates so far would show a difference within the margin, up to 100.

    0: the model shows it now, or more trainings would not.
    """
    model = difference.model
    if model is None:
        return 0
    return next((more for more in range(101) if max(model.extended(more).p_beyond(margin)) <= alpha), 0)
