"""Effect of recorded factors on the success, e.g. of the drawn light: exploratory, since nobody asked beforehand.

Policies, trainings and cells differ in difficulty. Therefore episodes are only compared within their stratum (policy,
training and cell): the test permutes the outcomes within strata. It needs no assumption about rates or small counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Array
from roboxim_eval.grouping import grouped
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.rates import SuccessRate, success_rate

PERMUTATIONS = 1999
"""Number of permutations; the smallest p value is 1 / (this + 1)."""
NOT_DRAWN = "not drawn"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """An episode, as the test sees it."""

    episode: str
    """Unique name."""
    stratum: str
    """Policy, training and cell."""
    success: bool
    """Whether it succeeded."""
    drawn: Mapping[str, str]
    """Factor to the drawn value."""


@dataclass(frozen=True, kw_only=True)
class FactorEffect:
    """A recorded factor."""

    factor: str
    """Its name."""
    levels: dict[str, SuccessRate]
    """Level, or group of numbers, to the success rate of all its episodes."""
    p_value: float
    """Probability of differences between its levels at least as large by chance."""
    adjusted: float
    """The same, adjusted for all factors of the table (Holm)."""

    @property
    def spread(self) -> float:
        """Difference between the best and the worst level, 0..1."""
        rates = [rate.rate for rate in self.levels.values()]
        return max(rates) - min(rates)


def factor_effects(trials: Sequence[Trial], *, seed: int = 0) -> tuple[FactorEffect, ...]:
    """Return the effect of each recorded factor that varies within strata, the smallest p value first.

    A factor that is constant within each stratum, e.g. the one by which cells are defined, is left out: the design
    compares it.

    Args:
        trials: The episodes.
        seed: Seed of the permutations.
    """
    trials = sorted(trials, key=lambda trial: (trial.stratum, trial.episode))
    names = sorted({name for trial in trials for name in trial.drawn})
    groups = {name: found for name in names if (found := _groups(trials, name)) and _varies(trials, found)}
    if not groups:
        return ()
    strata = np.unique([trial.stratum for trial in trials], return_inverse=True)[1]
    wins = np.array([trial.success for trial in trials], dtype=float)
    means = np.bincount(strata, weights=wins) / np.bincount(strata)
    residuals = wins - means[strata]
    shuffled = _shuffled(residuals, strata, np.random.default_rng(seed))
    p_values = [_p_value(np.array(group), residuals, shuffled) for group in groups.values()]
    effects = [
        FactorEffect(
            factor=name, levels=_rates(wins, np.array(groups[name])), p_value=p, adjusted=adjusted
        )  # fmt: skip
        for name, p, adjusted in zip(groups, p_values, holm(p_values), strict=True)
    ]
    return tuple(sorted(effects, key=lambda effect: (effect.p_value, effect.factor)))


def _groups(trials: Sequence[Trial], factor: str) -> list[str]:
    """Return the group of each episode; empty: the values are too many names."""
    groups = grouped({t.episode: t.drawn[factor] for t in trials if factor in t.drawn})
    return [groups.get(trial.episode, NOT_DRAWN) for trial in trials] if groups else []


def _varies(trials: Sequence[Trial], groups: Sequence[str]) -> bool:
    first: dict[str, str] = {}
    return any(first.setdefault(t.stratum, group) != group for t, group in zip(trials, groups, strict=True))


def _shuffled(residuals: Array, strata: npt.NDArray[np.intp], rng: np.random.Generator) -> Array:
    """Return residuals permuted within strata, shape (`PERMUTATIONS`, episodes); strata are in increasing order."""
    order = np.argsort(rng.random((PERMUTATIONS, len(residuals)), dtype=np.float32) + strata, axis=1)
    found: Array = residuals[order]
    return found


def _p_value(groups: Array, residuals: Array, shuffled: Array) -> float:
    levels = np.unique(groups)
    members = (groups[:, None] == levels).astype(float)
    sizes = members.sum(axis=0)
    observed = float(((residuals @ members) ** 2 / sizes).sum())
    by_chance = ((shuffled @ members) ** 2 / sizes).sum(axis=1)
    return (1 + int((by_chance >= observed - 1e-9).sum())) / (PERMUTATIONS + 1)


def _rates(success: Array, groups: Array) -> dict[str, SuccessRate]:
    found = {}
    for level in sorted(set(groups.tolist()), key=_order):
        mine = success[groups == level]
        found[level] = success_rate(int(mine.sum()), len(mine))
    return found


def _order(level: str) -> tuple[int, float, str]:
    """Sort numbers and groups of numbers by their value, names after them."""
    try:
        return 0, float(level.partition(" to ")[0]), level
    except ValueError:
        return 1, 0.0, level
