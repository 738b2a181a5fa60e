"""Variance components of a card: for each condition and for its primary comparison."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card, plain_interval
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.statistics.components import Components, arm_components, difference_components
from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.replicates import Interval, condition_difference, condition_rate


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Components of a condition or a comparison."""

    name: str
    """The condition, or ``first - second``."""
    where: str
    """Cells: ``all``, ``seen`` or ``unseen``."""
    components: Components
    """The components."""
    difference: bool
    """Whether they are those of a difference."""
    fixed: Interval
    """95 % interval of the mean over these very cells, as in the card's scores and verdicts."""

    @property
    def random(self) -> Interval:
        """95 % interval of the mean over all cells that these are a sample of; it contains `fixed`."""
        found, minimum = self.components.random_interval(), -1.0 if self.difference else 0.0
        return Interval(
            value=found.value, low=max(minimum, min(found.low, self.fixed.low)),
            high=min(1.0, max(found.high, self.fixed.high)),
        )  # fmt: skip


def card_spreads(card: Card) -> tuple[Spread, ...]:
    """Return the components of each condition in the cells of the primary comparison, and of the comparison, last.

    If the card compares nothing, or different cells, the components are those of its conditions in all their cells.
    """
    design, arms, primary = design_of_card(card), outcomes_of_card(card).arms, card.experiment.config.primary
    where = primary.where if primary is not None and not primary.against else "all"
    keys = {cell.key for cell in chosen(design.cells, where)}
    found = []
    for name, arm in arms.items():
        if common := [cell for cell in arm.cells if cell in keys]:
            parts, fixed = arm_components(arm, common), condition_rate(arm.within(common))
            found.append(Spread(name=name, where=where, components=parts, difference=False, fixed=fixed))
    if primary is not None and not primary.against:
        first, second = arms[primary.first], arms[primary.second]
        cells = [key for key in first.cells if key in keys]
        components = difference_components(first, second, cells)
        name = f"{primary.first} - {primary.second}"
        fixed = condition_difference(first.within(cells), second.within(cells), _pairs(card)).interval()
        found.append(Spread(name=name, where=where, components=components, difference=True, fixed=fixed))
    return tuple(found)


def _pairs(card: Card) -> tuple[Pairs, ...]:
    """Return the outcomes of the primary comparison's replicates on the scenes that both met."""
    config, outcomes = card.experiment.config, outcomes_of_card(card)
    assert config.primary is not None
    return tuple(outcomes.pairs.get(config.compare.index(config.primary), ()))


def primary_components(card: Card) -> Components:
    """Return the components of the primary comparison's differences.

    Raises:
        ConfigError: When the card compares nothing, compares different cells, or has one training.
    """
    found = card_spreads(card)
    if not found or not found[-1].difference:
        raise ConfigError(f"the card of {card.experiment.name} compares no two conditions in the same cells")
    if found[-1].components.replicates < 2:
        raise ConfigError(f"the card of {card.experiment.name} has one training; its spread needs at least two")
    return found[-1].components


def spread_data(card: Card) -> list[dict[str, Any]]:
    """Return a card's components as plain data: standard deviations as rates, intervals with value and bounds."""
    return [
        {
            "name": one.name, "cells": one.where, "trainings": parts.replicates, "cells_met": parts.cells,
            "rollouts": round(parts.episodes, 3),
            "sd": {
                "training": _root(parts.training), "cell": _root(parts.cell),
                "cell_training": _root(parts.cell_training), "scene": _root(parts.scene),
            },
            "sd_of_trainings": {"observed": _root(parts.observed), "rollouts": _root(parts.rollouts)},
            "cells_fixed": plain_interval(one.fixed),
            "cells_random": plain_interval(one.random),
        }
        for one in card_spreads(card) for parts in [one.components]
    ]  # fmt: skip


def spread_rows(card: Card) -> Iterator[dict[str, str]]:
    """Yield name, components [points] and intervals of each row, as text for tables."""
    for one in card_spreads(card):
        parts = one.components
        yield {
            "name": one.name,
            "size": f"{parts.replicates} x {parts.cells} x {parts.episodes:.0f}",
            "training": _points(parts.training),
            "cell": _points(parts.cell),
            "both": _points(parts.cell_training),
            "scene": _points(parts.scene),
            "fixed": _bounds(one.fixed, one.difference),
            "random": _bounds(one.random, one.difference),
        }


def _root(variance: float | None) -> float | None:
    return None if variance is None else round(variance**0.5, 6)


def _points(variance: float | None) -> str:
    return "-" if variance is None else f"{100 * variance**0.5:.1f}"


def _bounds(interval: Interval, difference: bool) -> str:
    low, high = max(interval.low, -1.0), min(interval.high, 1.0)
    if high - low >= (2.0 if difference else 1.0):
        return "-"
    sign = "+" if difference else ""
    return f"{round(100 * low) + 0:{sign}d} to {round(100 * high) + 0:{sign}d}"
