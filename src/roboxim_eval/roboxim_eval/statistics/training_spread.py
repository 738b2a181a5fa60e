"""Interval of the mean success rate of trainings that is also valid near 0 and 1.

Student's t over the rates of a few trainings is too short near the ceiling: three trainings that all succeed in nearly
every episode have no spread, although the next one may fail in a tenth of them. The model here includes both: the rate
of a training has a beta distribution, and its successes are binomial. The interval is the central one of the posterior
distribution of the mean.

Prior: Jeffreys's for the mean. The standard deviation between trainings is half-normal with a scale of 15 points.
Larger spreads are visible in the rates themselves, so that a caller
joins this interval with Student's t (`roboxim_eval.statistics.replicates.condition_rate`).

Source:
    Beta-binomial model: Skellam, Journal of the Royal Statistical Society B 10 (1948). Half-normal priors of standard
    deviations: Gelman, Bayesian Analysis 1 (2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

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


def mean_rate_interval(rates: Sequence[float], episodes: float, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the bounds of the mean success rate of all trainings of a condition.

    Args:
        rates: Success rate of each training, 0..1; at least two.
        episodes: Number of rollouts of each training, of equal weight; need not be whole.
        confidence: Probability of the interval, 0..1.
    """
    log_posterior = sum(_log_likelihood(round(float(rate) * episodes, 6), round(episodes, 6)) for rate in rates)
    density = np.exp(log_posterior - np.max(log_posterior)).sum(axis=1)
    below = np.concatenate([[0.0], np.cumsum(density) / density.sum()])
    low, high = np.interp([(1 - confidence) / 2, (1 + confidence) / 2], below, _grid()[0])
    return float(low), float(high)
