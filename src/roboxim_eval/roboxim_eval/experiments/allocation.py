"""How to spend a budget: the trainings and rollouts that give the primary comparison its narrowest interval.

A training costs its steps once; a rollout costs its seconds in every training. The better choice depends on the
variance components of an earlier card (`roboxim_eval.statistics.components`). The 95 % interval of a difference over R
trainings and n rollouts in each of C cells reaches t(R - 1) * sqrt(variance(R, n)) to both sides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.experiments.cost import Rates, cost_of
from roboxim_eval.experiments.design import design_of
from roboxim_eval.statistics.components import Components, student_limit
from roboxim_eval.statistics.replicates import MIN_REPLICATES

MAX_TRAININGS = 40
"""Largest number of trainings of a condition that is considered."""
MAX_ROLLOUTS = 200
"""Largest number of rollouts of a training in a cell that is considered."""


@dataclass(frozen=True, kw_only=True)
class Allocation:
    """A size of an experiment and the interval to expect of it."""

    config: ExperimentConfig
    """The experiment with these numbers."""
    trainings: int
    """Trainings of a condition."""
    cells: int
    """Cells of the primary comparison."""
    rollouts: int
    """Rollouts of a training in each of them."""
    half_width: float
    """Half the width of the 95 % interval of the difference over these cells, 0..1; at most 1."""
    half_width_sampled: float
    """The same over all cells that these are a sample of."""
    seconds: float
    """Time of the whole experiment [s]."""


def allocation_of(
    config: ExperimentConfig, rates: Rates, components: Components, trainer: str = "", at_once: int = 1
) -> Allocation:
    """Return the interval and the cost of an experiment as it is configured.

    Args:
        config: The experiment at its scale.
        rates: Measured rates of the machine.
        components: Components of an earlier card's primary comparison.
        trainer: Name of a trainer of the file; empty: the first one.
        at_once: Largest number of trainings at a time.

    Raises:
        ConfigError: When the rate of so many trainings at a time was not measured.
    """
    design, trainings = design_of(config, trainer), config.replicates.count
    primary = config.primary
    cells = 1
    if primary is not None and design.compared_scenes:
        cells = sum(primary.where == "all" or c.unseen == (primary.where == "unseen") for c in design.cells)
    rollouts = max(1, round(design.compared_scenes / cells))
    return Allocation(
        config=config, trainings=trainings, cells=cells, rollouts=rollouts,
        half_width=_half(components, trainings, rollouts, cells),
        half_width_sampled=_half_sampled(components, trainings, rollouts, cells),
        seconds=cost_of(design, rates, at_once).total_s,
    )  # fmt: skip


def allocated(
    config: ExperimentConfig, rates: Rates, components: Components, budget_s: float, trainer: str = "", at_once: int = 1
) -> Allocation | None:
    """Return the allocation of a budget with the narrowest interval of the primary comparison; none: nothing fits.

    Rollouts in the other cells keep their ratio to those in the compared ones. For each number of trainings, the
    largest number of rollouts that fits is considered.

    Args:
        config: The experiment at its scale.
        rates: Measured rates of the machine.
        components: Components of an earlier card's primary comparison.
        budget_s: Time [s].
        trainer: Name of a trainer of the file; empty: the first one.
        at_once: Largest number of trainings at a time.

    Raises:
        ConfigError: When the rate of so many trainings at a time was not measured.
    """
    fitting = list(_fitting(config, rates, components, budget_s, trainer, at_once))
    return min(fitting, key=lambda one: (one.half_width, one.seconds)) if fitting else None


def _fitting(
    config: ExperimentConfig, rates: Rates, components: Components, budget_s: float, trainer: str, at_once: int
) -> Iterable[Allocation]:
    for trainings in range(MIN_REPLICATES, MAX_TRAININGS + 1):
        low, high, best = 1, MAX_ROLLOUTS, None
        while low <= high:
            middle = (low + high) // 2
            one = allocation_of(_sized(config, trainings, middle), rates, components, trainer, at_once)
            if one.seconds <= budget_s:
                low, best = middle + 1, one
            else:
                high = middle - 1
        if best is None:  # not even one rollout fits, so that more trainings fit still less
            return
        yield best


def _sized(config: ExperimentConfig, trainings: int, rollouts: int) -> ExperimentConfig:
    evaluate, primary = config.evaluate, config.primary
    unseen = evaluate.per_unseen_cell or evaluate.per_cell
    compared = unseen if primary is not None and primary.where == "unseen" else evaluate.per_cell
    factor = rollouts / compared
    sized = replace(
        evaluate,
        per_cell=max(1, math.floor(factor * evaluate.per_cell + 1e-9)),
        per_unseen_cell=max(1, math.floor(factor * unseen + 1e-9)),
    )
    return replace(config, replicates=replace(config.replicates, count=trainings), evaluate=sized)


def _half(components: Components, trainings: int, rollouts: int, cells: int) -> float:
    variance = components.variance(trainings, rollouts, cells=cells)
    return min(1.0, student_limit(trainings - 1) * math.sqrt(variance)) if trainings > 1 else 1.0


def _half_sampled(components: Components, trainings: int, rollouts: int, cells: int) -> float:
    """Return the half width with cells as a sample, see `Components.random_interval`."""
    if min(trainings, cells) < 2:
        return 1.0
    within = (components.cell_training or 0.0) + components.scene * components.episodes / rollouts
    over_cells = student_limit(cells - 1) * math.sqrt((components.cell or 0.0) / cells + within / (trainings * cells))
    added = student_limit(trainings - 1) * math.sqrt((components.training or 0.0) / trainings)
    return min(1.0, max(math.hypot(over_cells, added), _half(components, trainings, rollouts, cells)))
