"""Planning: the difference that a design can find, and the chance to find it.

The model: a training's success rate deviates from that of its recipe by ``training_spread`` (standard deviation), and
its rollouts deviate from its rate by chance. Scenes differ in difficulty (standard deviation ``SCENE_SPREAD`` on the
logit). Difficulty cancels where both conditions meet the same scenes.

Where both sides of a comparison are the same checkpoints, a training's deviation shifts both rates by the same amount
on the logit, and nearly cancels. That is also an assumption: trainings may react differently to the change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Array

TRAINING_SPREAD = 0.046
"""Assumed standard deviation of a recipe's success rate between trainings, at a rate of 0.8; constant on the logit."""
SPREAD_AT = 0.8
"""Success rate at which spreads of trainings are stated."""
SCENE_SPREAD = 1.5
"""Assumed standard deviation of the scenes' difficulty, on the logit."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """Size of a comparison."""

    replicates: int
    """Trainings of each condition."""
    scenes: int
    """Rollouts of each training that the comparison counts; of the better condition where the scenes differ."""
    other_scenes: int = 0
    """Rollouts of each training of the worse condition, on scenes of their own; 0: both meet the same scenes."""
    same_checkpoints: bool = False
    """Whether both conditions evaluate the same trainings, e.g. in other cells or with another instruction."""
    training_spread: float = TRAINING_SPREAD
    """Standard deviation of a recipe's success rate between trainings at a rate of 0.8, 0..1."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidRequestError: If one is too small.
        """
        if self.replicates < 1 or self.scenes < 1 or min(self.training_spread, self.other_scenes) < 0:
            raise InvalidRequestError(
                f"needs replicates >= 1, scenes >= 1, other_scenes >= 0 and training_spread >= 0, got {self}"
            )


def power(design: Design, first: float, second: float, *, alpha: float = 0.05) -> float:
    """Return the chance to find a difference of two conditions' success rates.

    Three or more replicates: Student's t over them (Q2). One: the exact McNemar test of one checkpoint (Q1), without
    the spread of trainings; on different scenes one decides nothing. Two decide nothing.

    Args:
        design: Size of the comparison.
        first: Success rate of the first condition, 0..1; the one with ``scenes``.
        second: Success rate of the second one, 0..1; the one with ``other_scenes``, where the scenes differ.
        alpha: Probability of a false alarm, two-sided.
    """
    from scipy.stats import norm
    from scipy.stats import t as student

    if design.replicates == 1 and not design.other_scenes:
        return _mcnemar_power(design.scenes, first, second, alpha)
    if design.replicates <= 2:
        return 0.0
    rollouts, trainings = _rollouts_variance(design, first, second), _trainings_variance(design, first, second)
    if not trainings + rollouts:
        return 1.0 if first != second else alpha
    lead = abs(first - second) / math.sqrt((trainings + rollouts) / design.replicates)
    freedom = design.replicates - 1
    limits = student.ppf(1 - alpha / 2, freedom) * _sample_spreads(freedom)
    if design.same_checkpoints:  # the rollouts' own test decides more often, since trainings hardly spread
        limits = np.maximum(limits, norm.ppf(1 - alpha / 2) * math.sqrt(rollouts / (rollouts + trainings)))
    return float(np.mean(norm.sf(limits - lead) + norm.cdf(-limits - lead)))


@lru_cache(maxsize=4096)
def detectable(design: Design, rate: float = 0.8, *, chance: float = 0.8, alpha: float = 0.05) -> float | None:
    """Return the smallest drop from a success rate that a design finds with a chance, 0..1; none: not even to 0.

    Args:
        design: Size of the comparison.
        rate: Success rate of the better condition, 0..1.
        chance: Chance to find the drop.
        alpha: Probability of a false alarm, two-sided.
    """
    from scipy.optimize import brentq

    def missing(drop: float) -> float:
        return power(design, rate, rate - drop, alpha=alpha) - chance

    return float(brentq(missing, 1e-6, rate)) if missing(rate) > 0 else None


def _rollouts_variance(design: Design, first: float, second: float) -> float:
    """Return the variance of a training's difference that comes from its rollouts."""
    if design.other_scenes:  # difficulty does not cancel
        return first * (1 - first) / design.scenes + second * (1 - second) / design.other_scenes
    return (_within(first) + _within(second)) / design.scenes


def _trainings_variance(design: Design, first: float, second: float) -> float:
    """Return the variance of a training's difference that comes from the spread of trainings."""
    one, two = _logit_scale(first), _logit_scale(second)
    return design.training_spread**2 * ((one - two) ** 2 if design.same_checkpoints else one**2 + two**2)


def _logit_scale(rate: float) -> float:
    """Return the slope of the success rate over its logit, relative to that at `SPREAD_AT`."""
    return rate * (1 - rate) / (SPREAD_AT * (1 - SPREAD_AT))


@lru_cache(maxsize=64)
def _sample_spreads(freedom: int) -> Array:
    """Return equally likely standard deviations of a sample, relative to the true one."""
    from scipy.stats import chi2

    spreads: Array = np.sqrt(chi2.ppf((np.arange(500) + 0.5) / 500, freedom) / freedom)
    return spreads


def _mcnemar_power(scenes: int, first: float, second: float, alpha: float) -> float:
    """Return the chance that the exact McNemar test of two checkpoints on the same scenes finds their difference."""
    from scipy.stats import binom

    one, two = _chances(first), _chances(second)
    weights = _nodes()[1]
    only_first, only_second = float(weights @ (one * (1 - two))), float(weights @ (two * (1 - one)))
    if not only_first + only_second:
        return 0.0
    discordant = np.arange(scenes + 1)
    limits = binom.ppf(alpha / 2, discordant, 0.5)
    limits -= binom.cdf(limits, discordant, 0.5) > alpha / 2  # largest number of wins of one that shows it is worse
    share = only_first / (only_first + only_second)
    below, above = binom.cdf(limits, discordant, share), binom.sf(discordant - limits - 1, discordant, share)
    found = np.where(limits >= 0, below + above, 0.0)
    return float(binom.pmf(discordant, scenes, only_first + only_second) @ found)


@lru_cache(maxsize=1)
def _nodes() -> tuple[Array, Array]:
    """Return standard normal nodes and their weights, for means over scenes."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    return nodes, weights / weights.sum()


@lru_cache(maxsize=1024)
def _chances(rate: float) -> Array:
    """Return the success rate in scenes of increasing ease, at `_nodes`, whose mean is a rate."""
    from scipy.optimize import brentq

    nodes, weights = _nodes()
    if not 0 < rate < 1:
        return np.full(len(nodes), float(rate))

    def at(middle: float) -> Array:
        chances: Array = 1 / (1 + np.exp(-(middle + SCENE_SPREAD * nodes)))
        return chances

    return at(brentq(lambda middle: float(weights @ at(middle)) - rate, -40, 40))


def _within(rate: float) -> float:
    """Return the mean variance of one rollout given its scene: scenes differ in difficulty."""
    chances = _chances(rate)
    return float(_nodes()[1] @ (chances * (1 - chances)))
