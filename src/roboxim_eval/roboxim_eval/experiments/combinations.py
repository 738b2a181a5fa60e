"""Transfer as a curve: how many combinations must a policy see to succeed in unseen ones?

The file states the held-out cells and some numbers of seen cells. For each number there is a dataset and a condition
``seen_N``. All have the same number of demonstrations, spread evenly over the cells of the set, and the same training
steps. Each set contains the smaller ones, so two sets differ only by the added cells. The smallest set contains every
level of every factor, so only the combination is new in a held-out cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.cells import Cell, cells_of, chosen
from roboxim_eval.experiments.config import (
    CombinationsConfig,
    CompareConfig,
    ConditionConfig,
    DatasetConfig,
    ExperimentConfig,
)
from roboxim_eval.statistics.replicates import Interval, condition_rate
from roboxim_eval.statistics.tables import Arm
from roboxim_eval.statistics.trend import trend

Levels = tuple[tuple[str, str], ...]
"""Factors and levels of a cell."""


def name_of(number: int) -> str:
    """Return the name of the dataset and the condition with a number of seen cells."""
    return f"seen_{number}"


def names_of(config: CombinationsConfig | None) -> tuple[str, ...]:
    """Return the names of the datasets and conditions that an experiment receives; none: it has no combinations."""
    return tuple(name_of(number) for number in config.seen) if config is not None else ()


def expanded(config: ExperimentConfig) -> ExperimentConfig:
    """Return an experiment with the datasets, conditions and comparisons of its combinations.

    Each smaller number of cells is compared with the largest one, in the held-out cells; the smallest is the primary
    comparison. Their policies are evaluated in the held-out cells unless ``evaluate.cells`` says otherwise. An
    experiment that is expanded already is not changed.

    Raises:
        ConfigError: When nothing is held out, the sets do not exist, or the file has another dataset or condition of
            such a name.
    """
    combinations = config.combinations
    if combinations is None:
        return config
    cells = cells_of(config)
    if not chosen(cells, "unseen"):
        raise ConfigError("combinations: needs held-out cells, in which transfer is measured; list them in unseen")
    sets = nested_sets(cells, combinations.seen)
    datasets = {
        name_of(number): DatasetConfig(
            cells="seen",
            per_cell=combinations.demonstrations // number,
            only=tuple(dict(cell.levels) for cell in chosen_cells),
        )
        for number, chosen_cells in zip(combinations.seen, sets, strict=True)
    }
    total = len(chosen(cells, "seen"))
    conditions = {
        name_of(number): ConditionConfig(train=name_of(number), about=f"Trained with {number} of {total} seen cells.")
        for number in combinations.seen
    }
    for key, made in (("datasets", datasets), ("conditions", conditions)):
        for name, one in made.items():
            if getattr(config, key).get(name, one) != one:
                raise ConfigError(f"{key}.{name}: combinations makes one of this name; give yours another name")
    largest = combinations.seen[-1]
    has_primary = any(compare.primary for compare in config.compare)
    compares = [
        CompareConfig(
            first=name_of(number), second=name_of(largest), where="unseen",
            primary=number == combinations.seen[0] and not has_primary,
        )
        for number in combinations.seen[:-1]
    ]  # fmt: skip
    known = {(one.first, one.second, one.where) for one in config.compare if one.against in ("", one.where)}
    added = tuple(one for one in compares if (one.first, one.second, one.where) not in known)
    evaluated = dict.fromkeys(conditions, "unseen") | config.evaluate.cells
    return replace(
        config, datasets={**datasets, **config.datasets}, conditions={**conditions, **config.conditions},
        compare=(*added, *config.compare), evaluate=replace(config.evaluate, cells=evaluated),
    )  # fmt: skip


def nested_sets(cells: Sequence[Cell], numbers: Sequence[int]) -> tuple[tuple[Cell, ...], ...]:
    """Choose a set of seen cells for each number; each contains the smaller ones.

    Every level of every factor is in each set, and the levels of a factor are as equally frequent as the cells allow.
    The same arguments give the same sets.

    Args:
        cells: All cells.
        numbers: Numbers of cells, ascending.

    Raises:
        ConfigError: When there are no such sets.
    """
    seen = chosen(cells, "seen")
    if numbers[-1] > len(seen):
        raise ConfigError(f"combinations.seen: {numbers[-1]} cells, but only {len(seen)} of {len(cells)} are seen")
    needed = tuple(sorted({item for cell in cells for item in cell.levels.items()}))
    places = _nested(tuple(tuple(cell.levels.items()) for cell in seen), needed, tuple(numbers))
    return tuple(tuple(seen[place] for place in indices) for indices in places)


@lru_cache(maxsize=32)
def _nested(seen: tuple[Levels, ...], needed: Levels, numbers: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """Return the places of the cells of each set: an integer program that minimises how uneven the levels are."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    cells, sets, levels = len(seen), len(numbers), len(needed)
    size = cells * sets  # then a bound of each level's deviation in each set
    rows: list[np.ndarray] = []
    low: list[float] = []
    high: list[float] = []

    def require(members: Mapping[int, float], minimum: float, maximum: float) -> None:
        row = np.zeros(size + levels * sets)
        for place, value in members.items():
            row[place] = value
        rows.append(row)
        low.append(minimum)
        high.append(maximum)

    factors = {factor: sum(name == factor for name, _ in needed) for factor, _ in needed}
    for k, number in enumerate(numbers):
        require({cell * sets + k: 1.0 for cell in range(cells)}, number, number)
        for cell in range(cells if k else 0):
            require({cell * sets + k - 1: 1.0, cell * sets + k: -1.0}, -1.0, 0.0)
        for place, (factor, level) in enumerate(needed):
            terms = {cell * sets + k: 1.0 for cell in range(cells) if (factor, level) in seen[cell]}
            bound, share = size + place * sets + k, number / factors[factor]
            require(terms, 1.0, math.inf)
            require({**terms, bound: -1.0}, -math.inf, share)
            require({**terms, bound: 1.0}, share, math.inf)
    preferred = np.add.outer(np.arange(cells), np.zeros(sets)).ravel() ** 2 * 1e-6  # always the same sets
    found = milp(
        np.concatenate([preferred, np.ones(levels * sets)]),
        integrality=np.concatenate([np.ones(size), np.zeros(levels * sets)]),
        bounds=Bounds(np.zeros(size + levels * sets), np.concatenate([np.ones(size), np.full(levels * sets, np.inf)])),
        constraints=LinearConstraint(np.array(rows), np.array(low), np.array(high)), options={"time_limit": 30.0},
    )  # fmt: skip
    if found.x is None:
        raise ConfigError(
            f"combinations.seen: no {numbers[0]} of the {cells} seen cells have every level of every factor; give a "
            "larger number, or hold out other cells"
        )
    x = found.x[:size].reshape(cells, sets) > 0.5
    return tuple(tuple(int(place) for place in np.flatnonzero(x[:, k])) for k in range(sets))


# ------------------------------------------------------------------ results


@dataclass(frozen=True, kw_only=True)
class TransferPoint:
    """Success in the held-out cells after training with a number of cells."""

    number: int
    """Number of seen cells."""
    per_cell: int
    """Demonstrations of each."""
    rate: Interval
    """Success rate in the held-out cells, with its 95 % interval."""
    rates: tuple[float, ...]
    """Those of the single trainings."""


@dataclass(frozen=True, kw_only=True)
class TransferCurve:
    """Success in the held-out cells against the number of seen cells."""

    points: tuple[TransferPoint, ...]
    """By increasing number."""
    change: Interval
    """Change of the success rate from the smallest to the largest number, of a straight line over the logarithm of the
    number; unbounded for one training."""
    enough: int | None
    """Smallest number from which on all are shown to be as good as the largest one, or better; none: none is."""
    fewer: tuple[int, ...]
    """Numbers that are shown to be worse than the largest one."""

    @property
    def sentences(self) -> Iterator[str]:
        """The curve in words."""
        first, last = self.points[0].number, self.points[-1].number
        bounds = "no interval from one training"
        if math.isfinite(self.change.low):
            bounds = f"{round(100 * self.change.low) + 0:+d} to {round(100 * self.change.high) + 0:+d}"
        yield (
            f"From {first} to {last} combinations, the success in held-out ones changes by "
            f"{round(100 * self.change.value) + 0:+d} points ({bounds}; a straight line over the logarithm of "
            "their number), at equal numbers of demonstrations."
        )
        if self.enough is not None:
            yield f"{self.enough} combinations are shown to be enough: as good as {last} within the margin, or better."
        else:
            yield f"No smaller number of combinations is shown to be as good as {last} within the margin."
        if self.fewer:
            yield f"Shown to be worse than {last}: {', '.join(map(str, self.fewer))}."


def transfer_curve(
    config: ExperimentConfig, combinations: CombinationsConfig, arms: Mapping[str, Arm], kinds: Mapping[str, str]
) -> TransferCurve:
    """Return the curve of an experiment's results.

    Args:
        config: The experiment.
        combinations: Its combinations.
        arms: Condition to its outcomes.
        kinds: Condition ``seen_N`` to the verdict about its way to train against that with the largest number, in
            held-out cells.
    """
    unseen = [cell.key for cell in cells_of(config) if cell.unseen]
    held_out = [arms[name].within(unseen) for name in names_of(combinations)]
    points = tuple(
        TransferPoint(
            number=number, per_cell=combinations.demonstrations // number, rate=condition_rate(arm),
            rates=tuple(float(rate) for rate in arm.rates),
        )
        for number, arm in zip(combinations.seen, held_out, strict=True)
    )  # fmt: skip
    smaller = combinations.seen[:-1]
    good = [kinds.get(name_of(number)) in ("as_good", "higher") for number in smaller]
    enough = next((number for place, number in enumerate(smaller) if all(good[place:])), None)
    places = [math.log(number) for number in combinations.seen]
    return TransferCurve(
        points=points, change=trend([(x - places[0]) / (places[-1] - places[0]) for x in places], held_out),
        enough=enough, fewer=tuple(number for number in smaller if kinds.get(name_of(number)) == "lower"),
    )  # fmt: skip
