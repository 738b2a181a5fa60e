"""Agreement of two benchmarks about the same policies, e.g. of a simulator with real robots.

Two measures: Pearson's correlation of the success rates, and the mean maximum rank violation (MMRV)::

    violation(i, j) = |real_i - real_j| if (sim_i > sim_j) != (real_i > real_j), else 0
    MMRV = mean over i of max over j of violation(i, j)

MMRV is 0 if both rank the policies alike. A wrong order of two policies counts by their difference in reality.

Measured rates scatter around true ones. Scatter lowers a correlation and raises MMRV, and a bootstrap adds the scatter
again: if the true rates agree perfectly, its intervals almost never contain the truth. Intervals here therefore come
from a model. The log-odds of both true rates of a policy are drawn from a bivariate normal distribution; counts give
each with a known error. The posterior is computed on a grid. It has two answers:

- **these policies**: agreement of the true rates of the policies of the table. Its uncertainty is that of the rollouts.
- **policies of this kind**: correlation of the distribution that the policies are a sample of. Its uncertainty is also
  that of few policies, and mostly much larger. The lower bound is stated.

Source:
    MMRV: Li et al., Evaluating Real-World Robot Manipulation Policies in Simulation (SIMPLER, 2024), section 4, in the
    form of its published code (``simpler_env/utils/metrics.py``), which compares by ``>``. Errors of log-odds: Gart and
    Zweifel, Biometrika 54 (1967).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Array
from roboxim_eval.statistics.replicates import Interval, equal_rollouts, is_even
from roboxim_eval.statistics.tables import Arm

MIN_POLICIES = 3
"""Number of policies below which a correlation has no meaning: two points always lie on a line."""
WHOLE = ""
"""Cell of a table without cells."""
DRAWS = 2000
"""Draws from the posterior."""
SPREAD_SCALE = 2.0
"""Scale of the half-normal prior of the policies' standard deviations in log-odds; 2 is from 0.5 to 0.88."""


@dataclass(frozen=True, kw_only=True)
class PolicyCounts:
    """Outcomes of a policy in both benchmarks, over the cells that all policies have in both."""

    name: str
    """The policy."""
    first: tuple[float, float]
    """Successes and rollouts in the benchmark to be predicted, e.g. on real robots. Rates are means over cells, so that
    these are numbers of rollouts in equally full cells that give the mean as exactly; they need not be whole."""
    second: tuple[float, float]
    """Those in the benchmark that is to predict it, e.g. in simulation."""
    even: bool = True
    """Whether all cells have as many rollouts, so that those numbers are the ones that were run."""

    @property
    def rates(self) -> tuple[float, float]:
        """Success rates of the first benchmark and of the second."""
        return self.first[0] / self.first[1], self.second[0] / self.second[1]


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Agreement of two benchmarks."""

    policies: tuple[PolicyCounts, ...]
    """The policies."""
    pearson: Interval
    """Pearson's correlation of the measured rates; the interval is of that of the true rates of these policies. It need
    not contain the measured value, which scatter lowers. NaN: all policies have one rate in a benchmark."""
    mmrv: Interval
    """Mean maximum rank violation, 0..1; the interval is of that of the true rates of these policies."""
    at_least: float
    """Lower 95 % bound of the correlation of log-odds over policies of this kind."""


def pearson(first: Array, second: Array) -> Array:
    """Return Pearson's correlation along the last axis; NaN where one of both does not vary."""
    one = first - first.mean(axis=-1, keepdims=True)
    two = second - second.mean(axis=-1, keepdims=True)
    scale = np.sqrt((one**2).sum(axis=-1) * (two**2).sum(axis=-1))
    found: Array = np.where(scale > 1e-12, (one * two).sum(axis=-1) / np.maximum(scale, 1e-12), np.nan)
    return found


def mean_maximum_rank_violation(real: Array, predicted: Array) -> Array:
    """Return the MMRV along the last axis, see the module.

    Args:
        real: Success rates of the policies in the benchmark to be predicted, shape (..., N).
        predicted: Those in the other one, shape (..., N).
    """
    order = (predicted[..., :, None] > predicted[..., None, :]) != (real[..., :, None] > real[..., None, :])
    violation = np.where(order, np.abs(real[..., :, None] - real[..., None, :]), 0.0)
    found: Array = violation.max(axis=-1).mean(axis=-1)
    return found


def policy_counts(policies: Mapping[str, tuple[Arm, Arm]]) -> list[PolicyCounts]:
    """Return the outcomes of policies over the cells that all of them have in both benchmarks.

    Outcomes without cells (`WHOLE`) count as they are, as those of a benchmark of one cell.

    Args:
        policies: Policy to its outcomes in the benchmark to be predicted, and in the one that is to predict it.

    Raises:
        InvalidRequestError: When no cell is common to all, or cells of some policies are left out of a table in which
            others name none.
    """
    met = [
        (name, [cell for cell, count in arm.by_cell.items() if count.episodes])
        for name, both in policies.items() for arm in both if WHOLE not in arm.cells
    ]  # fmt: skip
    common = [cell for cell in met[0][1] if all(cell in cells for _, cells in met)] if met else []
    if met and not common:
        have = "; ".join(dict.fromkeys(f"{name}: {', '.join(cells)}" for name, cells in met))
        raise InvalidRequestError(f"no cell is common to all policies and both tables ({have})")
    for table in (0, 1):
        arms = {name: both[table] for name, both in policies.items()}
        whole = [name for name, arm in arms.items() if WHOLE in arm.cells]
        left = dict.fromkeys(cell for arm in arms.values() for cell in arm.cells if cell not in (*common, WHOLE))
        if whole and left:
            raise InvalidRequestError(
                f"not all policies and tables have the cells {', '.join(left)}, so that they are left out, but the "
                f"{('first', 'second')[table]} table has outcomes of {', '.join(whole)} that name no cell: name their "
                "cells, or give all policies the same cells"
            )
    return [
        PolicyCounts(
            name=name, first=_counts(one), second=_counts(two), even=is_even(one, slack=0.0) and is_even(two, slack=0.0)
        )
        for name, both in policies.items()
        for one, two in [[arm if WHOLE in arm.cells else arm.within(common) for arm in both]]
    ]  # fmt: skip


def _counts(arm: Arm) -> tuple[float, float]:
    rollouts = equal_rollouts(arm)
    return arm.rate * rollouts, rollouts


def correlation(policies: Sequence[PolicyCounts], *, seed: int = 0) -> Correlation:
    """Return the agreement of two benchmarks.

    Args:
        policies: Outcomes of at least `MIN_POLICIES` policies.
        seed: Seed of the draws from the posterior.

    Raises:
        InvalidRequestError: When there are fewer policies.
    """
    if len(policies) < MIN_POLICIES:
        raise InvalidRequestError(
            f"a correlation needs at least {MIN_POLICIES} policies that both tables have, got {len(policies)} "
            f"({', '.join(p.name for p in policies) or 'none'}): two points always lie on a line"
        )
    rates = np.array([policy.rates for policy in policies])
    posterior = _posterior(policies)
    real, predicted = posterior.draw(np.random.default_rng(seed))
    drawn = pearson(real, predicted)
    value = float(pearson(rates[:, 0], rates[:, 1]))
    low, high = np.quantile(drawn[np.isfinite(drawn)], [0.025, 0.975])
    violation = float(mean_maximum_rank_violation(rates[:, 0], rates[:, 1]))
    violation_low, violation_high = np.quantile(mean_maximum_rank_violation(real, predicted), [0.025, 0.975])
    # draws nearly always have a violation, a perfect order has none
    violation_low = min(violation_low, max(0.0, 2 * violation - violation_high))
    return Correlation(
        policies=tuple(policies), pearson=Interval(value=value, low=float(low), high=float(high)),
        mmrv=Interval(value=violation, low=float(violation_low), high=float(violation_high)),
        at_least=posterior.correlation_quantile(0.05),
    )  # fmt: skip


# ------------------------------------------------------------------ the model


@lru_cache(maxsize=1)
def _grid() -> tuple[Array, Array]:
    """Return the grid of (standard deviation of the first, of the second, correlation), and its log prior.

    The prior of a standard deviation is half-normal, that of the correlation is uniform from -1 to 1.
    """
    spreads = np.geomspace(0.05, 4.0, 12)
    correlations = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 33)) * 0.998
    one, two, rho = (part.ravel() for part in np.meshgrid(spreads, spreads, correlations, indexing="ij"))
    width = np.log(np.gradient(correlations))[np.searchsorted(correlations, rho)]
    prior = width + sum(np.log(s) - 0.5 * (s / SPREAD_SCALE) ** 2 for s in (one, two))  # the grid is even in log s
    return np.stack([one, two, rho], axis=-1), prior


@dataclass(frozen=True, kw_only=True)
class _Posterior:
    """Posterior of the model on its grid."""

    values: Array
    """Measured log-odds, shape (N, 2)."""
    errors: Array
    """Their variances, shape (N, 2)."""
    weights: Array
    """Probability of each point of the grid, shape (G,)."""
    means: Array
    """Expected mean log-odds at each point, shape (G, 2)."""
    precisions: Array
    """Precision of that mean, shape (G, 2, 2)."""

    def correlation_quantile(self, probability: float) -> float:
        """Return a quantile of the correlation of log-odds."""
        rho = _grid()[0][:, 2]
        levels = np.unique(rho)
        mass = np.array([self.weights[rho == level].sum() for level in levels])
        return float(np.interp(probability, np.cumsum(mass) - 0.5 * mass, levels))

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return draws of the true success rates in both benchmarks, each of shape (draws, N)."""
        places = rng.choice(len(self.weights), DRAWS, p=self.weights)
        spread = _covariances(_grid()[0][places])  # (B, 2, 2)
        uncertain: Array = np.linalg.inv(self.precisions[places]).astype(np.float64)
        mean = self.means[places] + _normal(rng, uncertain)
        noise = np.einsum("ni,ij->nij", self.errors, np.eye(2))
        gain = spread[:, None] @ np.linalg.inv(spread[:, None] + noise)  # (B, N, 2, 2)
        expected = mean[:, None] + (gain @ (self.values - mean[:, None])[..., None])[..., 0]
        rates = 1 / (1 + np.exp(-expected - _normal(rng, spread[:, None] - gain @ spread[:, None])))
        return rates[..., 0], rates[..., 1]


def _covariances(grid: Array) -> Array:
    one, two, rho = grid[..., 0], grid[..., 1], grid[..., 2]
    found = np.empty((*grid.shape[:-1], 2, 2))
    found[..., 0, 0], found[..., 1, 1] = one**2, two**2
    found[..., 0, 1] = found[..., 1, 0] = one * two * rho
    return found


def _normal(rng: np.random.Generator, covariance: Array) -> Array:
    """Draw from normal distributions of mean 0 and 2 x 2 covariances, shape (..., 2)."""
    first = np.sqrt(np.maximum(covariance[..., 0, 0], 1e-12))
    slope = covariance[..., 0, 1] / first
    rest = np.sqrt(np.maximum(covariance[..., 1, 1] - slope**2, 0.0))
    z = rng.standard_normal((*covariance.shape[:-2], 2))
    return np.stack([first * z[..., 0], slope * z[..., 0] + rest * z[..., 1]], axis=-1)


def _posterior(policies: Sequence[PolicyCounts]) -> _Posterior:
    counts = np.array([(policy.first, policy.second) for policy in policies])  # (N, 2, 2)
    won, lost = counts[..., 0] + 0.5, counts[..., 1] - counts[..., 0] + 0.5
    values, errors = np.log(won / lost), 1 / won + 1 / lost
    grid, prior = _grid()
    spread = _covariances(grid)
    a, d = spread[:, None, 0, 0] + errors[:, 0], spread[:, None, 1, 1] + errors[:, 1]
    c = spread[:, None, 0, 1]
    determinant = a * d - c**2
    p, q, r = d / determinant, a / determinant, -c / determinant  # the inverse, shape (G, N) each
    y, x = values[:, 0], values[:, 1]
    precisions = np.empty((len(grid), 2, 2))
    precisions[:, 0, 0], precisions[:, 1, 1] = p.sum(axis=1), q.sum(axis=1)
    precisions[:, 0, 1] = precisions[:, 1, 0] = r.sum(axis=1)
    sums = np.stack([(p * y + r * x).sum(axis=1), (r * y + q * x).sum(axis=1)], axis=-1)
    means = np.linalg.solve(precisions, sums[..., None])[..., 0]
    squares = (p * y**2 + 2 * r * y * x + q * x**2).sum(axis=1) - (sums * means).sum(axis=1)
    log = prior - 0.5 * (np.log(determinant).sum(axis=1) + np.linalg.slogdet(precisions)[1] + squares)
    weights = np.exp(log - log.max())
    return _Posterior(values=values, errors=errors, weights=weights / weights.sum(), means=means, precisions=precisions)


# ------------------------------------------------------------------ how many policies


@dataclass(frozen=True, kw_only=True)
class Needed:
    """How many policies would decide whether two benchmarks agree."""

    limit: float
    """Correlation that is to be shown."""
    assumed: float
    """Correlation of log-odds that is assumed to be true: the posterior's median."""
    power: Mapping[int, float]
    """Number of policies to the share of simulated tables whose lower bound is above the limit."""
    policies: int | None
    """Smallest number that shows it in 4 of 5 tables; none: more than the largest one that was tried."""

    @property
    def sentence(self) -> str:
        """The answer in words."""
        assumed = f"If {self.assumed:.2f} is the true correlation of log-odds"
        if self.policies is None:
            largest = max(self.power)
            return (
                f"{assumed}, {largest} policies show that it is above {self.limit:g} in "
                f"{100 * self.power[largest]:.0f} % of simulated tables: no number of policies up to that decides it."
            )
        return (
            f"{assumed}, {self.policies} policies with as many rollouts show that it is above {self.limit:g} in "
            f"{100 * self.power[self.policies]:.0f} % of simulated tables."
        )


def needed_policies(
    found: Correlation, *, limit: float = 0.5, numbers: Sequence[int] = (3, 4, 5, 6, 8, 10, 14, 20, 30),
    tables: int = 100, seed: int = 0,
) -> Needed:  # fmt: skip
    """Simulate tables of more policies of this kind, each with as many rollouts as here.

    Args:
        found: Agreement of the policies so far; spread and correlation are the medians of its posterior, so that they
            are rough guesses where the policies are few.
        limit: Correlation of log-odds that the lower 95 % bound is to exceed.
        numbers: Numbers of policies to try, ascending.
        tables: Simulated tables for each number.
        seed: Seed of the tables.
    """
    posterior, rng = _posterior(found.policies), np.random.default_rng(seed)
    grid = _grid()[0]
    median = [_weighted_median(grid[:, k], posterior.weights) for k in range(3)]
    mean, spread = posterior.weights @ posterior.means, _covariances(np.array(median))
    rollouts = np.median([(policy.first[1], policy.second[1]) for policy in found.policies], axis=0).round().astype(int)
    power: dict[int, float] = {}
    for number in numbers:
        shown = 0
        for _ in range(tables):
            rates = 1 / (1 + np.exp(-rng.multivariate_normal(mean, spread, number)))
            shown += _posterior(counted(rng.binomial(rollouts, rates), rollouts)).correlation_quantile(0.05) > limit
        power[number] = shown / tables
        if power[number] >= 0.8:
            break
    enough = [number for number, share in power.items() if share >= 0.8]
    return Needed(limit=limit, assumed=median[2], power=power, policies=enough[0] if enough else None)


def counted(won: npt.ArrayLike, rollouts: npt.ArrayLike) -> list[PolicyCounts]:
    """Return numbers of successes as outcomes of policies.

    Args:
        won: Successes in both benchmarks, shape (N, 2).
        rollouts: Rollouts of each policy in both, shape (2,).
    """
    one, two = map(float, np.asarray(rollouts))
    return [
        PolicyCounts(name=str(number), first=(float(a), one), second=(float(b), two))
        for number, (a, b) in enumerate(np.asarray(won))
    ]


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    place = int(np.searchsorted(np.cumsum(weights[order]), 0.5))
    return float(values[order][min(place, len(values) - 1)])


def sentences(found: Correlation, names: tuple[str, str]) -> tuple[str, ...]:
    """Return the agreement in words.

    Args:
        found: The agreement.
        names: Names of the benchmark to be predicted and of the one that is to predict it.
    """
    one, two, r, m = *names, found.pearson, found.mmrv
    value = "undefined, since all policies have one rate in a table" if math.isnan(r.value) else f"{r.value:.2f}"
    return (
        f"{two} and {one}, {len(found.policies)} policies: Pearson {value}; of the true rates of these policies "
        f"{r.low:.2f} to {r.high:.2f} (95 %).",
        f"Mean maximum rank violation {100 * m.value:.1f} points; of the true rates {100 * m.low:.1f} to "
        f"{100 * m.high:.1f} (95 %). It is the mean, over policies, of the largest difference in {one} that {two} "
        "orders wrongly.",
        f"Over policies of this kind, the correlation of log-odds is at least {found.at_least:.2f} (95 %).",
    )  # fmt: skip
