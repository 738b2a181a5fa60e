"""Search for regions of a scene's continuous factors in which a policy fails.

A quasi-random sample (Sobol) finds first failures. A box with many failures is peeled out of the points, as by the
patient rule induction method. Then each round places half of its points in and around the box, so that its borders
become sharp, and half of them elsewhere. A box is a *region* only if fresh points confirm it: inside the policy fails
significantly more often than outside (Fisher's exact test, Bonferroni). Points of the search never count, since the
box was chosen by them.

Source:
    Patient rule induction: Friedman and Fisher, Statistics and Computing 9 (1999).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError
from roboxim_core.poses import Array

Mask = npt.NDArray[np.bool_]

Oracle = Callable[[Array], Sequence[bool | None]]
"""Returns for points, shape (n, d) in units of the factors, whether the policy fails; None: no such scene exists."""
ALPHA = 0.05
"""Probability of a false region in a whole search."""
PEEL = 0.12
"""Share of a box's points that one step peels off."""
MIN_POINTS = 5
"""Fewest points of a box."""
MARGIN = 0.15
"""Margin around a box in which points are drawn, as a share of its side."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """A continuous factor."""

    name: str
    """Its name, e.g. ``reset.objects.area.0``."""
    lower: float
    """Smallest value."""
    upper: float
    """Largest value."""
    words: str = ""
    """Name for people, e.g. ``light intensity``; empty: `name`."""
    edges: tuple[str, str] = ("", "")
    """Names of the lower and the upper end, e.g. ``near edge of its area``; empty: they have none."""
    unit: str = ""
    """Unit, for words."""
    axis: str = ""
    """Axis of a place, e.g. ``x``, for words about a range that lies at no end with a name; empty: it is no place."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Size of a search."""

    first: int = 32
    """Points of the first sample."""
    rounds: int = 4
    """Rounds of refinement."""
    per_round: int = 16
    """Points of a round."""
    confirm: int = 12
    """Fresh points inside a box, and as many outside."""
    regions: int = 2
    """Largest number of regions."""
    seed: int = 0
    """Seed of all points."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is too small.
        """
        if min(self.first, self.per_round, self.confirm) < 6 or self.rounds < 0 or self.regions < 1:
            raise ConfigError("needs first, per_round and confirm >= 6, rounds >= 0 and regions >= 1")


@dataclass(frozen=True, kw_only=True)
class Region:
    """A box of factors."""

    bounds: dict[str, tuple[float, float]]
    """Factor to the range in which the policy fails; factors that do not matter are left out."""
    inside: tuple[int, int]
    """Failures and points of the confirmation inside."""
    outside: tuple[int, int]
    """Failures and points of the confirmation outside."""
    p: float
    """One-sided p value of the confirmation."""
    confirmed: bool
    """Whether it is a region."""
    words: str
    """Its name, e.g. ``light intensity under 1.8``."""


@dataclass
class _Seen:
    """Points so far, in the unit cube."""

    points: list[Array] = field(default_factory=list)
    failed: list[bool] = field(default_factory=list)

    def add(self, points: Array, outcomes: Sequence[bool | None]) -> None:
        for point, failed in zip(points, outcomes, strict=True):
            if failed is not None:
                self.points.append(point)
                self.failed.append(failed)

    @property
    def arrays(self) -> tuple[Array, Mask]:
        return np.array(self.points), np.array(self.failed, bool)


Box = tuple[Array, Array]
"""Lower and upper corner in the unit cube, shape (d,)."""


def search(oracle: Oracle, factors: Sequence[Factor], config: SearchConfig | None = None) -> list[Region]:
    """Search for regions, the clearest first; those that were not confirmed are named too.

    Args:
        oracle: Runs the policy.
        factors: The factors.
        config: Size of the search; none: the default.

    Raises:
        ConfigError: When there is no factor.
    """
    config = config or SearchConfig()
    if not factors:
        raise ConfigError("a search needs at least one factor with a range")
    rng = np.random.default_rng(config.seed)
    low = np.array([factor.lower for factor in factors])
    width = np.array([factor.upper for factor in factors]) - low

    def evaluate(unit: Array) -> Sequence[bool | None]:
        return oracle(low + unit * width)

    seen = _Seen()
    first = sobol(config.first, len(factors), config.seed)
    seen.add(first, evaluate(first))
    for number in range(config.rounds):
        points = _next_points(seen, config, len(factors), number, rng)
        seen.add(points, evaluate(points))
    found, points_failed = [], seen.arrays
    points, failed = points_failed
    for _ in range(config.regions):
        box = failing_box(points, failed)
        if box is None:
            break
        found.append(_confirmed(box, evaluate, factors, config, rng))
        outside = ~_within(points, box)
        points, failed = points[outside], failed[outside]
    return sorted(found, key=lambda region: region.p)


def sobol(number: int, dimensions: int, seed: int) -> Array:
    """Return points of a scrambled Sobol sequence in the unit cube, shape (number, dimensions)."""
    from scipy.stats.qmc import Sobol

    engine = Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed))
    points: Array = engine.random_base2(math.ceil(math.log2(max(number, 2))))[:number]
    return points


def failing_box(points: Array, failed: Mask) -> Box | None:
    """Return the box whose failures stand out most; None: no box stands out.

    Args:
        points: Points in the unit cube, shape (n, d).
        failed: Whether the policy fails there, shape (n,).
    """
    if len(points) < 2 * MIN_POINTS or not failed.any() or failed.all():
        return None
    low, high = np.zeros(points.shape[1]), np.ones(points.shape[1])
    best, best_score = None, 0.0
    inside = np.ones(len(points), bool)
    while True:
        score = _score(points, failed, (low, high))
        if score > best_score:
            best, best_score = (low.copy(), high.copy()), score
        peeled = _peeled(points[inside], failed[inside], low, high)
        if peeled is None:
            break
        low, high = peeled
        fewer = _within(points, (low, high))
        if fewer.sum() >= inside.sum():  # equal values
            break
        inside = fewer
    return None if best is None else _simplified(points, failed, best)


def _peeled(points: Array, failed: Mask, low: Array, high: Array) -> Box | None:
    """Return the box after the step that leaves the largest share of failures; None: it would be too small."""
    count = max(1, round(PEEL * len(points)))
    if len(points) - count < MIN_POINTS:
        return None
    best, best_rate = None, -1.0
    for dimension in range(points.shape[1]):
        order = np.argsort(points[:, dimension])
        values = points[order, dimension]
        for side, kept, cut in (
            (0, order[count:], (values[count - 1] + values[count]) / 2),
            (1, order[:-count], (values[-count] + values[-count - 1]) / 2),
        ):
            rate = failed[kept].mean()
            if rate > best_rate and values[0] < cut < values[-1]:
                corner = (low.copy(), high.copy())
                corner[side][dimension] = cut
                best, best_rate = corner, rate
    return best


def _simplified(points: Array, failed: Mask, box: Box) -> Box:
    """Return a box without the borders that do not help to separate failures."""
    low, high = box[0].copy(), box[1].copy()
    improved = True
    while improved:
        improved = False
        now = _score(points, failed, (low, high))
        for dimension in range(len(low)):
            for corner, free in ((low, 0.0), (high, 1.0)):
                kept = corner[dimension]
                if kept != free:
                    corner[dimension] = free
                    if _score(points, failed, (low, high)) >= now:
                        improved, now = True, _score(points, failed, (low, high))
                    else:
                        corner[dimension] = kept
    return low, high


def _score(points: Array, failed: Mask, box: Box) -> float:
    """Return how much better two rates (inside, outside) explain the outcomes than one, minus a penalty for borders."""
    inside = _within(points, box)
    if inside.all() or not inside.any() or failed[inside].mean() <= failed[~inside].mean():
        return 0.0
    gain = _log_likelihood(failed[inside]) + _log_likelihood(failed[~inside]) - _log_likelihood(failed)
    borders = int((box[0] > 0).sum() + (box[1] < 1).sum())
    return float(gain - 0.5 * borders * math.log(len(points)))


def _log_likelihood(failed: Mask) -> float:
    k, n = int(failed.sum()), len(failed)
    return sum(x * math.log(x / n) for x in (k, n - k) if x)


def _within(points: Array, box: Box) -> Mask:
    inside: Mask = np.asarray(((points >= box[0]) & (points <= box[1])).all(axis=1), bool)
    return inside


def _next_points(seen: _Seen, config: SearchConfig, dimensions: int, number: int, rng: np.random.Generator) -> Array:
    """Return half of the points around the borders of the box so far, half of a new Sobol sample."""
    anywhere = sobol(config.per_round, dimensions, config.seed + 101 + number)
    box = failing_box(*seen.arrays) if seen.points else None
    if box is None:
        return anywhere
    low, high = box
    side = high - low
    lower, upper = np.maximum(low - MARGIN * side, 0.0), np.minimum(high + MARGIN * side, 1.0)
    around = rng.uniform(lower, upper, (config.per_round, dimensions))
    half = config.per_round // 2
    return np.concatenate([around[half:], anywhere[:half]])


def _confirmed(
    box: Box, evaluate: Callable[[Array], Sequence[bool | None]], factors: Sequence[Factor], config: SearchConfig,
    rng: np.random.Generator,
) -> Region:  # fmt: skip
    from scipy.stats import fisher_exact

    dimensions = len(factors)
    inside = rng.uniform(box[0], box[1], (config.confirm, dimensions))
    elsewhere: list[Array] = []
    for _ in range(1000 * config.confirm):
        point = rng.random(dimensions)
        if not _within(point[None], box)[0]:
            elsewhere.append(point)
        if len(elsewhere) == config.confirm:
            break
    outcomes = [
        [one for one in evaluate(np.array(group)) if one is not None] for group in (inside, elsewhere) if len(group)
    ]
    counts = [(sum(group), len(group)) for group in outcomes] + [(0, 0)]
    (a, n), (b, m) = counts[:2]
    p = float(fisher_exact([[a, n - a], [b, m - b]], alternative="greater").pvalue) if n and m else 1.0
    bounds = {
        factor.name: (
            factor.lower + float(low) * (factor.upper - factor.lower),
            factor.lower + float(high) * (factor.upper - factor.lower),
        )
        for factor, low, high in zip(factors, *box, strict=True) if low > 0 or high < 1
    }  # fmt: skip
    return Region(
        bounds=bounds, inside=(a, n), outside=(b, m), p=p, confirmed=p <= ALPHA / config.regions,
        words=" and ".join(_words(factor, *bounds[factor.name]) for factor in factors if factor.name in bounds),
    )  # fmt: skip


def _words(factor: Factor, low: float, high: float) -> str:
    """Name a range of a factor, e.g. ``object closer than 6 cm to the near edge of its area``."""
    name, unit = factor.words or factor.name, f" {factor.unit}" if factor.unit else ""
    along = f"{factor.axis} of {name}" if factor.axis and factor.words else name
    slack = 1e-9 * (factor.upper - factor.lower)
    if low <= factor.lower + slack:
        if factor.edges[0]:
            return f"{name} closer than {100 * (high - factor.lower):.0f} cm to the {factor.edges[0]}"
        return f"{along} under {high:.3g}{unit}"
    if high >= factor.upper - slack:
        if factor.edges[1]:
            return f"{name} closer than {100 * (factor.upper - low):.0f} cm to the {factor.edges[1]}"
        return f"{along} over {low:.3g}{unit}"
    return f"{along} from {low:.3g} to {high:.3g}{unit}"
