"""Comparison of two policies: on the same scenes (exact McNemar) and on different ones (Boschloo).

This answers only Q1, whether *this checkpoint* is better than that one. It says nothing about the training conditions
of the checkpoints, see `roboxim_eval.statistics.replicates`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.equivalence import NORMAL, p_within
from roboxim_eval.statistics.rates import SuccessRate, success_rate


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A difference of two success rates, first minus second, with its 95 % interval."""

    value: float
    """The difference, -1..1."""
    low: float
    """Lower bound."""
    high: float
    """Upper bound."""
    p_value: float
    """Probability of a difference at least as large if both were equal, two-sided."""

    def p_as_good(self, margin: float) -> float:
        """Return the p value of two one-sided tests of a difference within a margin.

        Args:
            margin: Largest difference that counts as equally good, 0..1.
        """
        return p_within(self.value, self.value - self.low, self.high - self.value, margin)

    def narrowed(self, alpha: float) -> tuple[float, float]:
        """Return the bounds at the confidence ``1 - 2 alpha``, by which two one-sided tests decide."""
        from scipy.stats import norm

        scale = float(norm.isf(alpha)) / NORMAL
        return self.value - scale * (self.value - self.low), self.value + scale * (self.high - self.value)

    def __str__(self) -> str:
        """Format in points, e.g. ``-7.4 points (-15.0 to +0.2)``."""
        return f"{100 * self.value:+.1f} points ({100 * self.low:+.1f} to {100 * self.high:+.1f})"


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Outcomes of two policies on the same scenes."""

    both: int
    """Scenes that both solved."""
    first: int
    """Scenes that the first alone solved."""
    second: int
    """Scenes that the second alone solved."""
    neither: int
    """Scenes that neither solved."""

    def __post_init__(self) -> None:
        """Check the counts.

        Raises:
            InvalidRequestError: If one is negative.
        """
        if min(self.both, self.first, self.second, self.neither) < 0:
            raise InvalidRequestError(f"counts of pairs must be >= 0, got {self}")

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return self.both + self.first + self.second + self.neither

    @property
    def rates(self) -> tuple[SuccessRate, SuccessRate]:
        """Success rate of the first and of the second policy."""
        return success_rate(self.both + self.first, self.scenes), success_rate(self.both + self.second, self.scenes)

    @staticmethod
    def of(outcomes: Iterable[tuple[bool, bool]]) -> Pairs:
        """Count the outcomes of the first and the second policy on each scene."""
        counts = {(True, True): 0, (True, False): 0, (False, True): 0, (False, False): 0}
        for first, second in outcomes:
            counts[bool(first), bool(second)] += 1
        return Pairs(
            both=counts[True, True], first=counts[True, False], second=counts[False, True],
            neither=counts[False, False],
        )  # fmt: skip

    def __add__(self, other: Pairs) -> Pairs:
        """Return the summed counts of both sets of scenes."""
        return Pairs(
            both=self.both + other.both, first=self.first + other.first, second=self.second + other.second,
            neither=self.neither + other.neither,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PairedDifference(Difference):
    """A difference of two policies on the same scenes, whose intervals and tests are Tango's."""

    pairs: Pairs
    """The outcomes."""

    def p_as_good(self, margin: float) -> float:
        """Return the p value of two one-sided score tests of a difference within a margin, see `Difference`."""
        from scipy.stats import norm

        return max(float(norm.sf(_score(self.pairs, -margin))), float(norm.cdf(_score(self.pairs, margin))))

    def narrowed(self, alpha: float) -> tuple[float, float]:
        """Return the bounds at the confidence ``1 - 2 alpha``, see `Difference`."""
        return _score_interval(self.pairs, alpha)


def paired_difference(pairs: Pairs, *, score: bool = True) -> Difference:
    """Compare two policies on the same scenes: exact McNemar test, Tango's score interval.

    Args:
        pairs: Outcomes of both.
        score: Whether the interval is Tango's; otherwise it is Newcombe's, which is too narrow where one policy solves
            all that the other does.

    Raises:
        InvalidRequestError: If there are no scenes.

    Source:
        Tango (1998), Statistics in Medicine 17, 891-908. Newcombe (1998), Statistics in Medicine 17, 2635-2650, method
        10 (score intervals, continuity-corrected correlation).
    """
    from scipy.stats import binomtest

    if not pairs.scenes:
        raise InvalidRequestError("a comparison needs at least one scene that both policies met, got none")
    discordant = pairs.first + pairs.second
    value = (pairs.first - pairs.second) / pairs.scenes
    p_value = float(binomtest(pairs.first, discordant).pvalue) if discordant else 1.0
    if score:
        low, high = _score_interval(pairs, 0.025)
        return PairedDifference(value=value, low=low, high=high, p_value=p_value, pairs=pairs)
    one, two = pairs.rates
    phi = _correlation(pairs)
    below, above = one.rate - one.low, two.high - two.rate
    above_first, below_second = one.high - one.rate, two.rate - two.low
    value = one.rate - two.rate
    return Difference(
        value=value,
        low=value - _root(below, above, phi),
        high=value + _root(below_second, above_first, phi),
        p_value=p_value,
    )


def _score(pairs: Pairs, difference: float) -> float:
    """Return the score statistic of a difference, a standard normal number if it is the true one.

    The variance is that of the most likely rates of discordant scenes with this difference (Tango 1998).
    """
    n, only_first, only_second = pairs.scenes, pairs.first, pairs.second
    b = (2 * n - only_first + only_second) * difference - only_first - only_second
    c = -only_second * difference * (1 - difference)
    rate = (math.sqrt(max(0.0, b * b - 8 * n * c)) - b) / (4 * n)  # of scenes that the second alone solves
    variance = n * (2 * rate + difference * (1 - difference))
    above = only_first - only_second - n * difference
    return above / math.sqrt(variance) if variance > 1e-12 else math.copysign(math.inf, above) if above else 0.0


def _score_interval(pairs: Pairs, tail: float) -> tuple[float, float]:
    """Return the differences at which each one-sided score test has the p value ``tail``."""
    from scipy.optimize import brentq
    from scipy.stats import norm

    value, limit, end = (pairs.first - pairs.second) / pairs.scenes, float(norm.isf(tail)), 1 - 1e-9
    low = brentq(lambda x: _score(pairs, x) - limit, -end, value) if value > -1 else -1.0
    high = brentq(lambda x: _score(pairs, x) + limit, value, end) if value < 1 else 1.0
    return float(low), float(high)


def _correlation(pairs: Pairs) -> float:
    """Return the continuity-corrected phi coefficient of the outcomes."""
    a, b, c, d = pairs.both, pairs.first, pairs.second, pairs.neither
    margins = (a + b) * (c + d) * (a + c) * (b + d)
    if not margins:
        return 0.0
    product = a * d - b * c
    return (max(product - pairs.scenes / 2, 0.0) if product > 0 else float(product)) / math.sqrt(margins)


def _root(first: float, second: float, phi: float) -> float:
    return math.sqrt(max(0.0, first**2 - 2 * phi * first * second + second**2))


def independent_difference(first: SuccessRate, second: SuccessRate) -> Difference:
    """Compare two policies on different scenes: Boschloo's exact test, Newcombe's interval.

    Raises:
        InvalidRequestError: If one has no episodes.

    Source:
        Boschloo (1970), as `scipy.stats.boschloo_exact` computes it; Newcombe (1998), Statistics in Medicine 17,
        873-890, method 10.
    """
    from scipy.stats import boschloo_exact

    if not first.episodes or not second.episodes:
        raise InvalidRequestError("a comparison needs episodes of both policies, got none of one")
    table = [
        [first.successes, second.successes],
        [first.episodes - first.successes, second.episodes - second.successes],
    ]
    low, high = newcombe(first, second)
    apart = first.rate != second.rate
    return Difference(
        value=first.rate - second.rate, low=low, high=high,
        p_value=float(boschloo_exact(table).pvalue) if apart else 1.0,
    )  # fmt: skip


def newcombe(first: SuccessRate, second: SuccessRate) -> tuple[float, float]:
    """Return the 95 % interval of a difference of two independent rates (Newcombe 1998, method 10)."""
    value = first.rate - second.rate
    return (
        value - math.hypot(first.rate - first.low, second.high - second.rate),
        value + math.hypot(first.high - first.rate, second.rate - second.low),
    )
