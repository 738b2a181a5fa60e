"""Intervals of the mean success rate of trainings, and of a difference of two, that are also valid near 0 and 1.

Student's t over the rates of a few trainings is too short near the ceiling: three trainings that all succeed in nearly
every episode have no spread, although the next one may fail in a tenth of them. The model here includes both: the rate
of a training has a beta distribution, and its successes are binomial. The interval is the central one of the posterior
distribution of the mean. That of a difference assumes that both conditions' trainings are independent.

Prior: Jeffreys's for the mean. The standard deviation between trainings is half-normal with a scale of 15 points.
Larger spreads are visible in the rates themselves, so that a caller
joins this interval with Student's t (`roboxim_eval.statistics.replicates.condition_rate`).

Source:
    Beta-binomial model: Skellam, Journal of the Royal Statistical Society B 10 (1948). Half-normal priors of standard
    deviations: Gelman, Bayesian Analysis 1 (2006).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import cycle, islice

import numpy as np
from numpy.typing import NDArray

from roboxim_core.poses import Array

SCALE = 0.15
"""Scale of the prior of the standard deviation between trainings, as a success rate."""
MEANS = 200
"""Number of intervals of the grid of mean rates; each has the same prior probability."""
SPREADS = 20
"""Number of standard deviations, each of the same prior probability."""
MAX_CORRELATION = 0.97
"""Largest correlation of two episodes of a training: at 1, a training always or never succeeds."""


@lru_cache(maxsize=1)
def _grid() -> tuple[Array, Array, Array, Array]:
    """Return the bounds of the intervals of means, shape (MEANS + 1,), and the beta distributions.

    Of the distributions: both parameters and the logarithm of their beta function, each of shape (MEANS, SPREADS).
    """
    from scipy.special import betaln
    from scipy.stats import halfnorm

    edges = (1 - np.cos(np.pi * np.arange(MEANS + 1) / MEANS)) / 2  # equal parts of Jeffreys's prior
    means = ((1 - np.cos(np.pi * (np.arange(MEANS) + 0.5) / MEANS)) / 2)[:, None]
    spreads = halfnorm.ppf((np.arange(SPREADS) + 0.5) / SPREADS) * SCALE
    correlation = np.minimum(spreads**2 / (means * (1 - means)), MAX_CORRELATION)
    size = 1 / correlation - 1
    alpha, beta = means * size, (1 - means) * size
    return edges, alpha, beta, betaln(alpha, beta)


@lru_cache(maxsize=512)  # 32 kB each
def _log_likelihood(successes: float, episodes: float) -> Array:
    """Return the logarithm of a training's likelihood, up to a constant, shape (MEANS, SPREADS)."""
    from scipy.special import betaln

    _, alpha, beta, log_beta = _grid()
    found: Array = betaln(alpha + successes, beta + episodes - successes) - log_beta
    return found


@dataclass(frozen=True, kw_only=True)
class Trainings:
    """Success rates of the trainings of a condition."""

    rates: tuple[float, ...]
    """Success rate of each training, 0..1; at least two."""
    episodes: float
    """Number of rollouts of each training, of equal weight; need not be whole."""


@lru_cache(maxsize=4096)
def _posterior(trainings: Trainings) -> Array:
    """Return the probability of each interval of the grid of means, shape (MEANS,)."""
    episodes = round(trainings.episodes, 6)
    log_posterior = sum(_log_likelihood(round(rate * episodes, 6), episodes) for rate in trainings.rates)
    density = np.exp(log_posterior - np.max(log_posterior)).sum(axis=1)
    found: Array = density / density.sum()
    return found


def mean_rate_interval(trainings: Trainings, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the bounds of the mean success rate of all trainings of a condition.

    Args:
        trainings: The trainings that were measured.
        confidence: Probability of the interval, 0..1.
    """
    below = np.concatenate([[0.0], np.cumsum(_posterior(trainings))])
    low, high = np.interp([(1 - confidence) / 2, (1 + confidence) / 2], below, _grid()[0])
    return float(low), float(high)


@lru_cache(maxsize=1)
def _differences() -> tuple[NDArray[np.intp], Array]:
    """Return the order of the differences of all pairs of means, shape (MEANS^2,), and the sorted differences."""
    edges = _grid()[0]
    middles = (edges[1:] + edges[:-1]) / 2
    differences: Array = np.subtract.outer(middles, middles).ravel()
    order = np.argsort(differences)
    return order, differences[order]


@dataclass(frozen=True, kw_only=True)
class MeanDifference:
    """Posterior distribution of the difference of two conditions' mean rates, first minus second."""

    first: Trainings
    """Trainings of the first condition."""
    second: Trainings
    """Trainings of the second condition."""

    def interval(self, confidence: float) -> tuple[float, float]:
        """Return the bounds of the difference; ``confidence`` is the probability between them, 0..1."""
        below, values = self._cumulative
        low, high = np.interp([(1 - confidence) / 2, (1 + confidence) / 2], below, values)
        return float(low), float(high)

    def p_beyond(self, margin: float) -> tuple[float, float]:
        """Return the probabilities of a difference below ``-margin``, and of one above ``margin``."""
        below, values = self._cumulative
        low, high = np.interp([-margin, margin], values, below)
        return float(low), float(1 - high)

    def extended(self, more: int) -> MeanDifference:
        """Return the distribution if each condition had ``more`` trainings of the same rates, in turn."""
        first, second = (
            replace(one, rates=tuple(islice(cycle(one.rates), len(one.rates) + more)))
            for one in (self.first, self.second)
        )
        return MeanDifference(first=first, second=second)

    @cached_property
    def _cumulative(self) -> tuple[Array, Array]:
        """The probability of a smaller difference, shape (MEANS^2,), and the sorted differences."""
        order, values = _differences()
        density = np.outer(_posterior(self.first), _posterior(self.second)).ravel()[order]
        return np.cumsum(density) - density / 2, values
