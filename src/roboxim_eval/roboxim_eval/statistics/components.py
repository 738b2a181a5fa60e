"""Variance components of success rates: the contributions of trainings, cells and scenes to the uncertainty of a mean.

Each training r of a condition has a success rate in each cell c, so that a condition is a table y[r, c]. The model is::

    y[r, c] = mean + training[r] + cell[c] + both[r, c] + scene[r, c]

``scene`` is the binomial part of a finite number of rollouts. The components follow from the mean squares of the table
(method of moments), with negative estimates set to 0. The same model describes the differences of two conditions.

Source:
    Searle, Casella and McCulloch, Variance Components (1992), section 4.3; intervals of sums of mean squares: Graybill
    and Wang, Journal of the American Statistical Association 75 (1980).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Array
from roboxim_eval.statistics.replicates import Interval
from roboxim_eval.statistics.tables import Arm, require_same_replicates


@dataclass(frozen=True, kw_only=True)
class Components:
    """Variance components of a table of rates, or of differences of rates. All variances are those of rates, 0..1."""

    value: float
    """Mean of the table."""
    replicates: int
    """Number of trainings."""
    cells: int
    """Number of cells."""
    episodes: float
    """Rollouts of a training in a cell: the harmonic mean over the table."""
    mean_squares: tuple[float, float, float]
    """Mean squares of trainings, of cells, and of the rest."""
    scene: float
    """Variance of a rate in the table that is due to its number of rollouts; for differences that of both sides."""

    @property
    def training(self) -> float | None:
        """Variance between trainings; none: there is one."""
        rest = self.mean_squares[2] if self.cells > 1 else self.scene
        return max(0.0, (self.mean_squares[0] - rest) / self.cells) if self.replicates > 1 else None

    @property
    def cell(self) -> float | None:
        """Variance between cells; none: there is one."""
        rest = self.mean_squares[2] if self.replicates > 1 else self.scene
        return max(0.0, (self.mean_squares[1] - rest) / self.replicates) if self.cells > 1 else None

    @property
    def cell_training(self) -> float | None:
        """Variance of the interaction of trainings and cells; none: one training or one cell."""
        return max(0.0, self.mean_squares[2] - self.scene) if min(self.replicates, self.cells) > 1 else None

    @property
    def observed(self) -> float:
        """Variance of the trainings' means, including the part due to their rollouts."""
        return self.mean_squares[0] / self.cells

    @property
    def rollouts(self) -> float:
        """Part of `observed` that is due to the number of rollouts."""
        return self.scene / self.cells

    def variance(self, replicates: int, episodes: float, *, cells: int = 0) -> float:
        """Return the variance of the mean of another table, with these cells.

        Args:
            replicates: Number of trainings.
            episodes: Rollouts of a training in a cell.
            cells: Number of cells; 0: as many as here.
        """
        within = (self.cell_training or 0.0) + self.scene * self.episodes / episodes
        return ((self.training or 0.0) + within / (cells or self.cells)) / replicates

    def fixed_interval(self) -> Interval:
        """Return the 95 % interval of the mean over these very cells: Student's t over the trainings."""
        return self._interval(self.replicates, self.mean_squares[0] / (self.replicates * self.cells))

    def random_interval(self) -> Interval:
        """Return the 95 % interval of the mean over all cells that these are a sample of.

        The squared half width is the sum of those of Student's t over the cells' means, and over what trainings add to
        them. It is never narrower than `fixed_interval`, and unbounded for one training or one cell.
        """
        among_trainings, among_cells, rest = self.mean_squares
        number = self.replicates * self.cells
        over_cells = self._interval(self.cells, among_cells / number)
        added = self._interval(self.replicates, max(0.0, among_trainings - rest) / number)
        half = math.hypot(over_cells.high - self.value, added.high - self.value)
        half = max(half, self.fixed_interval().high - self.value)
        return Interval(value=self.value, low=self.value - half, high=self.value + half)

    def _interval(self, sample: int, variance: float) -> Interval:
        half = student_limit(sample - 1) * math.sqrt(variance) if sample > 1 else math.inf
        return Interval(value=self.value, low=self.value - half, high=self.value + half)


def student_limit(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t; infinite without a degree of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975)) if freedom > 0 else math.inf


def arm_components(arm: Arm, cells: Collection[str] = ()) -> Components:
    """Return the components of a condition's rates.

    Args:
        arm: Outcomes of the condition.
        cells: Cells to look at; empty: all.

    Raises:
        InvalidRequestError: When a cell was not met, or none has a rollout in every training.
    """
    rates, scene, episodes = _table(arm, _cells([arm], cells))
    return _components(rates, float(scene.mean()), float(1 / np.mean(1 / episodes)))


def difference_components(first: Arm, second: Arm, cells: Collection[str] = ()) -> Components:
    """Return the components of the differences of two conditions, first minus second.

    Scenes that both met vary together, so that the binomial part of the differences is at most the sum of both sides'.

    Raises:
        InvalidRequestError: When replicates differ, a cell was not met, or none has a rollout in every training.
    """
    require_same_replicates(first, second)
    keys = _cells([first, second], cells)
    (one, scene_one, many_one), (two, scene_two, many_two) = _table(first, keys), _table(second, keys)
    episodes = float(2 / np.mean(1 / many_one + 1 / many_two))
    return _components(one - two, float((scene_one + scene_two).mean()), episodes)


def pooled_components(parts: Sequence[Components]) -> Components:
    """Return the components that several tables have in common, weighted by their degrees of freedom.

    The value, the numbers of trainings, cells and rollouts are those of the first one.

    Raises:
        InvalidRequestError: When there is none.
    """
    if not parts:
        raise InvalidRequestError("needs the components of at least one table, got none")
    one = parts[0]
    scene = float(np.average(
        [p.scene * p.episodes for p in parts], weights=[p.replicates * p.cells for p in parts]
    )) / one.episodes  # fmt: skip
    rest = scene + _weighted(parts, lambda p: p.cell_training, lambda p: (p.replicates - 1) * (p.cells - 1))
    trainings = rest + one.cells * _weighted(parts, lambda p: p.training, lambda p: p.replicates - 1)
    among = rest + one.replicates * _weighted(parts, lambda p: p.cell, lambda p: p.cells - 1)
    return Components(
        value=one.value, replicates=one.replicates, cells=one.cells, episodes=one.episodes,
        mean_squares=(trainings, among, rest), scene=scene,
    )  # fmt: skip


def _weighted(
    parts: Sequence[Components], variance: Callable[[Components], float | None], weight: Callable[[Components], int]
) -> float:
    known = [(found, weight(part)) for part in parts if (found := variance(part)) is not None and weight(part) > 0]
    return float(np.average([v for v, _ in known], weights=[w for _, w in known])) if known else 0.0


def _cells(arms: Sequence[Arm], cells: Collection[str]) -> list[str]:
    """Return the cells with a rollout in every training."""
    for arm in arms:
        arm.within(cells)
    keys = list(cells) or list(arms[0].cells)
    met = [key for key in keys if all(r[key].episodes for arm in arms for r in arm.replicates)]
    if not met:
        raise InvalidRequestError("no cell has a rollout in every training; variance components need one")
    return met


def _table(arm: Arm, keys: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return rates, their binomial variances and numbers of rollouts, each of shape (R, C)."""
    counts = np.array([[(r[key].successes, r[key].episodes) for key in keys] for r in arm.replicates], float)
    successes, episodes = counts[..., 0], counts[..., 1]
    rates = successes / episodes
    pooled = successes.sum(axis=0) / episodes.sum(axis=0)  # the variance of a single rollout cannot be estimated
    alone = pooled * (1 - pooled) / episodes
    scene = np.where(episodes > 1, rates * (1 - rates) / np.maximum(episodes - 1, 1), alone)
    return rates, scene, episodes


def _components(table: Array, scene: float, episodes: float) -> Components:
    replicates, cells = table.shape
    among_trainings = cells * table.mean(axis=1).var(ddof=1) if replicates > 1 else 0.0
    among_cells = replicates * table.mean(axis=0).var(ddof=1) if cells > 1 else 0.0
    rest = 0.0
    if min(replicates, cells) > 1:
        left = table - table.mean(axis=1, keepdims=True) - table.mean(axis=0, keepdims=True) + table.mean()
        rest = float((left**2).sum() / ((replicates - 1) * (cells - 1)))
    return Components(
        value=float(table.mean()), replicates=replicates, cells=cells, episodes=episodes,
        mean_squares=(float(among_trainings), float(among_cells), rest), scene=scene,
    )  # fmt: skip
