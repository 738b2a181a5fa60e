"""Variance components of a card: for each condition and for its primary comparison."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

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
        same = card.experiment.config.compares_same_trainings(primary)
        fixed = condition_difference(
            first.within(cells), second.within(cells), _pairs(card), same_trainings=same
        ).interval()  # fmt: skip
        found.append(Spread(name=name, where=where, components=components, difference=True, fixed=fixed))
    return tuple(found)


def _pairs(card: Card) -> tuple[Pairs, ...]:
    """Return the outcomes of the primary comparison's replicates on the scenes that both met."""
    config, outcomes = card.experiment.config, outcomes_of_card(card)
    assert config.primary is not None
    return tuple(outcomes.pairs.get(config.compare.index(config.primary), ()))


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """What trainings of one seed have in common, in the primary comparison."""

    trainings: int
    """Number of pairs."""
    paired: float
    """Standard deviation of the differences of trainings of one seed, as a success rate."""
    unrelated: float
    """That of trainings of different seeds, from the variances of both conditions."""
    correlation: Interval
    """Pearson's correlation of the rates of one seed, with its 95 % interval (Fisher)."""

    @property
    def sentence(self) -> str:
        """The gain in one sentence."""
        one = self.correlation
        return (
            f"Differences of trainings of one seed have an SD of {100 * self.paired:.1f} points, those of any two "
            f"{100 * self.unrelated:.1f}; correlation of {self.trainings} pairs {one.value:+.2f} ({one.low:+.2f} to "
            f"{one.high:+.2f})."
        )


def card_pairing(card: Card) -> Pairing | None:
    """Return what the pairing of the primary comparison gains.

    None: fewer than four pairs, whose correlation has no interval; a condition that is not trained, or whose trainings
    have equal rates.
    """
    from scipy.stats import pearsonr

    config = card.experiment.config
    primary = config.primary
    if (
        primary is None
        or primary.against
        or not all(config.conditions[c].train for c in (primary.first, primary.second))
    ):
        return None
    arms = outcomes_of_card(card).arms
    keys = {cell.key for cell in chosen(design_of_card(card).cells, primary.where)}
    cells = [key for key in arms[primary.first].cells if key in keys]
    first, second = (arms[name].within(cells).rates for name in (primary.first, primary.second))
    if len(first) < 4 or not (np.ptp(first) and np.ptp(second)):
        return None
    found = pearsonr(first, second)
    bounds = found.confidence_interval()
    return Pairing(
        trainings=len(first), paired=float(np.std(first - second, ddof=1)),
        unrelated=float(np.sqrt(np.var(first, ddof=1) + np.var(second, ddof=1))),
        correlation=Interval(value=float(found.statistic), low=float(bounds.low), high=float(bounds.high)),
    )  # fmt: skip


def pairing_data(card: Card) -> dict[str, Any] | None:
    """Return `card_pairing` as plain data."""
    found = card_pairing(card)
    return None if found is None else {
        "trainings": found.trainings, "sd_paired": round(found.paired, 6), "sd_unrelated": round(found.unrelated, 6),
        "correlation": plain_interval(found.correlation),
    }  # fmt: skip


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
