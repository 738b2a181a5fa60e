"""Effect of recorded factors on the success, e.g. of the drawn light: exploratory, without prior hypotheses.

Policies, trainings and cells differ in difficulty. Therefore episodes are only compared within their stratum (policy,
training and cell). Scenes differ in difficulty too, and several policies meet the same scene with the same draws. Their
outcomes on it are not independent: if each policy were permuted alone, a test at 5 % would raise false alarms in about
20 % of the cases with six policies. Therefore the test permutes whole scenes, in the same way in every stratum that met
them, among scenes that the same strata met. It needs no assumption about rates or small counts.

Source: permutation of exchangeable blocks, Winkler et al. 2015, Multi-level block permutation, NeuroImage 123.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Array
from roboxim_eval.grouping import grouped
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.rates import SuccessRate, success_rate

PERMUTATIONS = 1999
"""Number of permutations; the smallest p value is 1 / (this + 1)."""
CHUNK = 2_000_000
"""Number of outcomes permuted at a time, 16 MB."""
NOT_DRAWN = "not drawn"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """An episode, in the form for the test."""

    episode: str
    """Unique name."""
    stratum: str
    """Policy, training and cell."""
    scene: str
    """Name of its scene, e.g. training, cell and number; strata that met the same scene share the name, each met it
    once."""
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


def factor_effects(trials: Sequence[Trial]) -> tuple[FactorEffect, ...]:
    """Return the effect of each recorded factor that varies within strata, the smallest p value first.

    A factor that is constant within each stratum, e.g. the one by which cells are defined, is left out, because the
    design compares it.

    Args:
        trials: The episodes, in any order.
    """
    trials = sorted(trials, key=lambda trial: (trial.stratum, trial.episode))
    names = sorted({name for trial in trials for name in trial.drawn})
    groups = {name: found for name in names if (found := _groups(trials, name)) and _varies(trials, found)}
    if not groups:
        return ()
    strata = _numbers([trial.stratum for trial in trials])
    wins = np.array([trial.success for trial in trials], dtype=float)
    means = np.bincount(strata, weights=wins) / np.bincount(strata)
    residuals = wins - means[strata]
    members = [_members(group) for group in groups.values()]
    observed = [_between(residuals, indices) for indices in members]
    reached = np.zeros(len(groups), dtype=int)
    for shuffled in _shuffles(trials, residuals, np.random.default_rng(0)):
        reached += [
            int((_between(shuffled, indices) >= own - 1e-9).sum())
            for indices, own in zip(members, observed, strict=True)
        ]
    p_values = [(1 + int(number)) / (PERMUTATIONS + 1) for number in reached]
    effects = [
        FactorEffect(
            factor=name, levels=_rates(wins, np.array(groups[name])), p_value=p, adjusted=adjusted
        )  # fmt: skip
        for name, p, adjusted in zip(groups, p_values, holm(p_values), strict=True)
    ]
    return tuple(sorted(effects, key=lambda effect: (effect.p_value, effect.factor)))


def _groups(trials: Sequence[Trial], factor: str) -> list[str]:
    """Return the group of each episode; empty: there are too many different names."""
    groups = grouped({t.episode: t.drawn[factor] for t in trials if factor in t.drawn})
    return [groups.get(trial.episode, NOT_DRAWN) for trial in trials] if groups else []


def _varies(trials: Sequence[Trial], groups: Sequence[str]) -> bool:
    first: dict[str, str] = {}
    return any(first.setdefault(t.stratum, group) != group for t, group in zip(trials, groups, strict=True))


def _numbers(names: Sequence[str]) -> npt.NDArray[np.intp]:
    """Return the number of each name in the sorted different names."""
    return np.unique(names, return_inverse=True)[1]


def _shuffles(trials: Sequence[Trial], residuals: Array, rng: np.random.Generator) -> Iterator[Array]:
    """Yield permuted residuals, shape (permutations, episodes), until there are `PERMUTATIONS`.

    A scene gets the residuals of another scene that the same strata met, in each of these strata.
    """
    strata = _numbers([trial.stratum for trial in trials])
    scenes = _numbers([trial.scene for trial in trials])
    episode_of = np.zeros((strata.max() + 1, scenes.max() + 1), dtype=np.intp)
    episode_of[strata, scenes] = np.arange(len(trials))
    met: dict[int, set[int]] = defaultdict(set)
    for stratum, scene in zip(strata.tolist(), scenes.tolist(), strict=True):
        met[scene].add(stratum)
    numbers: dict[frozenset[int], int] = {}
    groups = np.array([numbers.setdefault(frozenset(met[scene]), len(numbers)) for scene in range(len(met))])
    order = np.argsort(groups, kind="stable")  # sorts by group; keys of 0..1 permute within a group
    rows = max(CHUNK // len(trials), 1)
    for done in range(0, PERMUTATIONS, rows):
        keys = rng.random((min(rows, PERMUTATIONS - done), len(groups))) + groups[order]
        source = np.empty(keys.shape, dtype=np.intp)
        source[:, order] = order[np.argsort(keys, axis=1)]
        yield residuals[episode_of[strata, source[:, scenes]]]


def _members(groups: Sequence[str]) -> Array:
    """Return the membership of episodes in groups, as 0 or 1, shape (episodes, groups)."""
    members: Array = (np.array(groups)[:, None] == np.unique(groups)).astype(float)
    return members


def _between(residuals: Array, members: Array) -> Array:
    """Return the sum of squares between groups of residuals of shape (..., episodes), shape (...)."""
    found: Array = ((residuals @ members) ** 2 / members.sum(axis=0)).sum(axis=-1)
    return found


def _rates(success: Array, groups: Array) -> dict[str, SuccessRate]:
    found = {}
    for level in sorted(set(groups.tolist()), key=level_order):
        outcomes = success[groups == level]
        found[level] = success_rate(int(outcomes.sum()), len(outcomes))
    return found


def level_order(level: str) -> tuple[int, float, str]:
    """Sort numbers and groups of numbers by their value, names after them."""
    try:
        return 0, float(level.partition(" to ")[0]), level
    except ValueError:
        return 1, 0.0, level
