"""Outcomes of an experiment: successes by cell, for each training of each condition."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Array

Intervals = Literal["student", "beta_binomial", "beta_binomial_differences"]
"""Method of the intervals of conditions: where trainings spread near 0 and 1, the beta-binomial model of
`roboxim_eval.statistics.training_spread` widens none, those of success rates, or also those of differences."""


@dataclass(frozen=True, kw_only=True)
class Count:
    """Episodes of one cell."""

    successes: int
    """Episodes that succeeded."""
    episodes: int
    """Episodes run, errors included."""
    errors: int = 0
    """Episodes that ended in an error; they count as failures."""

    def __post_init__(self) -> None:
        """Check the counts.

        Raises:
            InvalidRequestError: If they are not 0 <= successes + errors <= episodes.
        """
        if min(self.successes, self.errors) < 0 or self.successes + self.errors > self.episodes:
            raise InvalidRequestError(f"needs successes >= 0, errors >= 0 and no more than the episodes, got {self}")


@dataclass(frozen=True, kw_only=True)
class Arm:
    """Outcomes of a condition: each replicate is a separate training, or one checkpoint with other instructions."""

    replicates: tuple[Mapping[str, Count], ...]
    """For each training: cell to its count."""
    intervals: Intervals = "beta_binomial_differences"
    """Method of its intervals; older cards have the earlier ones."""

    def __post_init__(self) -> None:
        """Check that all replicates met the same cells.

        Raises:
            InvalidRequestError: If there is no replicate, or their cells differ.
        """
        if not self.replicates:
            raise InvalidRequestError("an arm needs at least one replicate, got none")
        cells = set(self.replicates[0])
        for number, replicate in enumerate(self.replicates):
            if set(replicate) != cells:
                odd = ", ".join(sorted(cells ^ set(replicate)))
                raise InvalidRequestError(f"replicate {number} met other cells than replicate 0: {odd}")

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells that were met."""
        return tuple(self.replicates[0])

    def within(self, cells: Collection[str]) -> Arm:
        """Return the outcomes in some cells.

        Raises:
            InvalidRequestError: If a cell was not met; names it.
        """
        missing = [cell for cell in cells if cell not in self.replicates[0]]
        if missing:
            raise InvalidRequestError(f"cells that the arm did not meet: {', '.join(missing)}")
        return replace(self, replicates=tuple({cell: r[cell] for cell in cells} for r in self.replicates))

    @property
    def rates(self) -> Array:
        """Success rate of each replicate: the mean of its cells' rates, shape (R,)."""
        return np.array([_mean_rate(replicate.values()) for replicate in self.replicates])

    @property
    def rate(self) -> float:
        """Mean of the replicates' rates."""
        return float(self.rates.mean())

    @property
    def pooled(self) -> Count:
        """Counts of all replicates and cells together."""
        return total(count for replicate in self.replicates for count in replicate.values())

    @property
    def by_cell(self) -> dict[str, Count]:
        """Counts of all replicates, by cell."""
        return {cell: total(replicate[cell] for replicate in self.replicates) for cell in self.cells}


def total(counts: Iterable[Count]) -> Count:
    """Return the sum of counts."""
    successes = episodes = errors = 0
    for count in counts:
        successes, episodes, errors = (
            successes + count.successes, episodes + count.episodes, errors + count.errors
        )  # fmt: skip
    return Count(successes=successes, episodes=episodes, errors=errors)


def _mean_rate(counts: Iterable[Count]) -> float:
    rates = [count.successes / count.episodes for count in counts if count.episodes]
    if not rates:
        raise InvalidRequestError("a rate needs at least one episode, got none")
    return float(np.mean(rates))


def require_same_replicates(first: Arm, second: Arm) -> int:
    """Return the number of replicates of two arms, which are paired by number.

    Raises:
        InvalidRequestError: If they have different numbers of them.
    """
    if len(first.replicates) != len(second.replicates):
        raise InvalidRequestError(
            f"arms are compared replicate by replicate, got {len(first.replicates)} and {len(second.replicates)}; "
            "train and evaluate the missing ones"
        )
    return len(first.replicates)
