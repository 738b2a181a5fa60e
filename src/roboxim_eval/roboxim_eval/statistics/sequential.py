"""Stopping a comparison of two checkpoints early (Q1), without more false alarms.

Both checkpoints meet the same scenes. Looks at the results are planned beforehand, and so is the largest number of
scenes. At look k the share of the error probability that may be spent is a function of the planned scenes alone
(O'Brien and Fleming's type). If both checkpoints are equally good, each scene that only one of them solved is like the
toss of a fair coin. The distribution of the tosses at all looks, given their numbers, is therefore known exactly.
Dynamic programming computes the limits from it, so the test is exact and not asymptotic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.paired import Pairs


@dataclass(frozen=True, kw_only=True)
class SequentialPlan:
    """Looks at the results of two checkpoints, fixed before the first episode."""

    looks: tuple[int, ...]
    """Number of scenes at each look, increasing; the last one is the largest number of scenes."""
    alpha: float = 0.05
    """Probability of any false alarm, two-sided."""

    def __post_init__(self) -> None:
        """Check the looks.

        Raises:
            InvalidRequestError: If they do not increase, or alpha is no probability.
        """
        increasing = all(a < b for a, b in zip((0, *self.looks), self.looks, strict=False))
        if not self.looks or not increasing:
            raise InvalidRequestError(f"looks must be increasing numbers of scenes > 0, got {list(self.looks)}")
        if not 0 < self.alpha < 1:
            raise InvalidRequestError(f"alpha must be between 0 and 1, got {self.alpha:g}")

    @property
    def spent(self) -> tuple[float, ...]:
        """Error probability that may be spent up to each look (Lan and DeMets 1983, O'Brien-Fleming type)."""
        from scipy.stats import norm

        limit = norm.ppf(1 - self.alpha / 2)
        shares = np.array(self.looks) / self.looks[-1]
        return tuple(float(p) for p in 2 * norm.sf(limit / np.sqrt(shares)))

    @staticmethod
    def even(scenes: int, looks: int, alpha: float = 0.05) -> SequentialPlan:
        """Return a plan with evenly spaced looks.

        Args:
            scenes: Largest number of scenes.
            looks: Number of looks.
            alpha: Probability of any false alarm.
        """
        steps = sorted({round(scenes * (k + 1) / looks) for k in range(looks)} - {0})
        return SequentialPlan(looks=tuple(steps), alpha=alpha)


@dataclass(frozen=True, kw_only=True)
class SequentialState:
    """Result of the looks so far."""

    decided: bool
    """Whether the checkpoints differ: no more scenes are needed."""
    look: int
    """Number of the look that decided, from 1; otherwise the number of looks so far."""
    finished: bool
    """Whether the comparison ends here: decided, or no scenes are left."""


def sequential_test(plan: SequentialPlan, looks: Sequence[Pairs]) -> SequentialState:
    """Return whether two checkpoints differ at one of the looks so far.

    Args:
        plan: The plan.
        looks: Outcomes of all scenes up to each look, cumulative.

    Raises:
        InvalidRequestError: If a look has another number of scenes than planned, or outcomes disappeared.
    """
    at = {0: 1.0}  # lead of the first -> probability without an earlier decision, if both are equal
    spent, before = 0.0, 0
    for number, (pairs, planned, allowed) in enumerate(zip(looks, plan.looks, plan.spent, strict=False), start=1):
        if pairs.scenes != planned:
            raise InvalidRequestError(f"look {number} was planned at {planned} scenes, got {pairs.scenes}")
        discordant = pairs.first + pairs.second
        if discordant < before:
            raise InvalidRequestError(f"look {number} has fewer outcomes than the one before")
        at = _after(at, discordant - before)
        before = discordant
        limit = _limit(at, allowed - spent)
        spent += sum(p for lead, p in at.items() if abs(lead) >= limit)
        if abs(pairs.first - pairs.second) >= limit:
            return SequentialState(decided=True, look=number, finished=True)
        at = {lead: p for lead, p in at.items() if abs(lead) < limit}
    return SequentialState(decided=False, look=len(looks), finished=len(looks) >= len(plan.looks))


def _after(at: dict[int, float], tosses: int) -> dict[int, float]:
    """Return the distribution of the lead after some more tosses of a fair coin."""
    from scipy.stats import binom

    moved: dict[int, float] = {}
    chances = binom.pmf(np.arange(tosses + 1), tosses, 0.5)
    for lead, probability in at.items():
        for wins, chance in enumerate(chances):
            there = lead + 2 * wins - tosses
            moved[there] = moved.get(there, 0.0) + probability * float(chance)
    return moved


def _limit(at: dict[int, float], allowed: float) -> int:
    """Return the smallest lead of either checkpoint that is reached with an allowed probability."""
    reached, limit = 0.0, max(map(abs, at), default=0) + 1
    for lead in sorted({abs(lead) for lead in at}, reverse=True):
        reached += sum(at.get(there, 0.0) for there in {lead, -lead})
        if reached > allowed or lead == 0:
            break
        limit = lead
    return limit
