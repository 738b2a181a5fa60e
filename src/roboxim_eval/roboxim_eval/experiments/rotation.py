"""Rotated designs: the held-out set changes from part to part, so a score describes factors, not a few cells.

An experiment with one held-out set measures a policy in those cells. A rotated one consists of parts, each an ordinary
experiment with its own held-out set and its own trainings. The sets are disjoint, like the symbols of a Latin
square: each holds out every level of every factor about equally often, and every level remains in the training.
Where objects alone vary, the sets are disjoint groups of objects, each of which one part never sees.

`roboxim_eval.statistics.rotated` joins the parts' results.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, counted
from roboxim_core.plain_data.differences import differences
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.experiments.cells import Cell, cells_of, chosen
from roboxim_eval.experiments.config import CompareConfig, DatasetConfig, ExperimentConfig
from roboxim_eval.statistics.rotated import Part, RotatedScore, rotated_score

MIN_SETS = 3
"""Smallest number of sets of a rotated design; fewer sets allow no statement about cells."""


def held_out_sets(cells: Sequence[Cell], sets: int, held_out: int) -> tuple[tuple[Cell, ...], ...]:
    """Choose disjoint sets of cells to hold out.

    In each set the levels of a factor are held out equally often, or nearly so where the number of cells does not
    divide by that of the levels. Every level keeps a cell that is seen, unless each level of the factor has one cell,
    as where objects alone vary. The same arguments give the same sets.

    Args:
        cells: All cells.
        sets: Number of sets.
        held_out: Number of cells of a set.

    Raises:
        ConfigError: When there are fewer than `MIN_SETS` sets, or no such sets exist.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    if sets < MIN_SETS:
        raise ConfigError(f"a rotated design needs at least {MIN_SETS} sets, got {sets}")
    if held_out < 1 or sets * held_out > len(cells):
        raise ConfigError(
            f"{sets} disjoint sets of {held_out} cells need {sets * held_out} cells, the experiment has {len(cells)}; "
            + (f"give at most {most} a set, or fewer sets" if (most := len(cells) // sets) else "give fewer sets")
        )
    number = len(cells)
    rows, low, high = [], [], []

    def require(members: Sequence[tuple[int, int]], minimum: float, maximum: float) -> None:
        row = np.zeros((number, sets))
        for member in members:
            row[member] = 1
        rows.append(row.ravel())
        low.append(minimum)
        high.append(maximum)

    for cell in range(number):
        require([(cell, one) for one in range(sets)], 0, 1)
    for one in range(sets):
        require([(cell, one) for cell in range(number)], held_out, held_out)
        for members in _levels(cells):
            share = held_out * len(members) / number
            require([(cell, one) for cell in members], int(share), min(int(np.ceil(share)), len(members) - 1))
    size = number * sets
    preferred = np.add.outer(np.arange(number), -np.arange(sets)).astype(float) ** 2  # always the same one
    found = milp(
        preferred.ravel() * 1e-3, integrality=np.ones(size), bounds=Bounds(0, 1),
        constraints=LinearConstraint(np.array(rows), np.array(low), np.array(high)), options={"time_limit": 30.0},
    )  # fmt: skip
    if found.x is None:
        raise ConfigError(
            f"no {sets} disjoint sets of {held_out} cells hold out every level equally often and leave it to be seen; "
            "give another number of sets or of cells"
        )
    held = found.x.reshape(number, sets) > 0.5
    return tuple(tuple(cell for cell, out in zip(cells, held[:, one], strict=True) if out) for one in range(sets))


def _levels(cells: Sequence[Cell]) -> Iterator[list[int]]:
    """Yield the places of the cells with each level of each factor that has several levels and not one cell each."""
    for factor in cells[0].levels:
        levels = dict.fromkeys(cell.levels[factor] for cell in cells)
        if 1 < len(levels) < len(cells):
            for level in levels:
                yield [place for place, cell in enumerate(cells) if cell.levels[factor] == level]


def rotated(config: ExperimentConfig, sets: int, held_out: int, replicates: int = 1) -> tuple[ExperimentConfig, ...]:
    """Return the parts of a rotated design: the experiment with each of the held-out sets.

    The trainings of each part have their own seeds, from the experiment's first one on. Datasets of seen cells keep
    their sizes: with fewer cells held out they have fewer demonstrations of each, and of some cells one more.

    Args:
        config: The experiment at its scale; its own held-out cells are replaced.
        sets: Number of held-out sets.
        held_out: Number of cells of a set.
        replicates: Trainings of each condition in a part.

    Raises:
        ConfigError: When no such sets exist, or the experiment compares no two conditions in held-out cells, or has
            combinations.
    """
    if config.combinations is not None:
        raise ConfigError("an experiment with combinations is not rotated: its seen cells belong to its unseen ones")
    if not _rotatable(config):
        raise ConfigError("a rotated design needs a primary comparison of two conditions in unseen cells")
    cells = cells_of(config)
    before, first = len(chosen(cells, "seen")), config.replicates.first_seed
    parts = []
    for number, held in enumerate(held_out_sets(cells, sets, held_out)):
        seen = [cell.key for cell in cells if cell not in held]
        given = config.datasets.items()
        datasets = {name: _spread(data, before, seen) if _all_seen(data) else data for name, data in given}
        seeds = replace(config.replicates, count=replicates, first_seed=first + number * replicates)
        unseen = tuple(cell.levels for cell in held)
        parts.append(replace(config, unseen=unseen, datasets=datasets, replicates=seeds))
    return tuple(parts)


def _all_seen(data: DatasetConfig) -> bool:
    """Return whether a dataset is of every seen cell."""
    return data.cells == "seen" and not data.only


def _spread(data: DatasetConfig, before: int, seen: Sequence[str]) -> DatasetConfig:
    """Return a dataset with as many demonstrations, spread over other cells.

    Args:
        data: The dataset.
        before: Number of its cells.
        seen: The other cells.
    """
    total = data.per_cell * before + sum(data.more.values())
    per_cell, rest = divmod(max(total, len(seen)), len(seen))
    return replace(data, per_cell=per_cell, more={seen[n * len(seen) // rest]: 1 for n in range(rest)})


def joined(cards: Sequence[Card]) -> RotatedScore:
    """Return the scores of a rotated design from the cards of its parts.

    Raises:
        ConfigError: When the cards are not parts of one design: other experiments, or held-out cells in common.
    """
    if len(cards) < MIN_SETS:
        raise ConfigError(f"a rotated design has at least {MIN_SETS} parts, got {counted(len(cards), 'card')}")
    seen: set[str] = set()
    parts = []
    for number, card in enumerate(cards, start=1):
        primary = _rotated_comparison(card)
        others = [to_plain(_without_set(one.experiment.config)) for one in (cards[0], card)]
        if others[0] != others[1]:
            names = f"{card.experiment.name} and {cards[0].experiment.name}"
            differing = differences(*others, words=("in the first card", f"in card {number}"))
            raise ConfigError(f"{names} differ in more than the held-out set: {differing}")
        trainers = [_trainer(one) for one in (card, cards[0])]
        if trainers[0] != trainers[1]:
            raise ConfigError(f"the parts were trained by different trainers: {trainers[1]} and {trainers[0]}")
        cells = [cell.key for cell in chosen(design_of_card(card).cells, "unseen")]
        if twice := seen & set(cells):
            raise ConfigError(f"held out in two parts: {', '.join(sorted(twice))}; the sets must be disjoint")
        seen |= set(cells)
        arms = outcomes_of_card(card).arms
        parts.append(Part(first=arms[primary.first].within(cells), second=arms[primary.second].within(cells)))
    return rotated_score(parts)


def _rotated_comparison(card: Card) -> CompareConfig:
    """Return the comparison of a part's conditions in its held-out cells.

    Raises:
        ConfigError: When the experiment is no part of a rotated design.
    """
    config = card.experiment.config
    primary = config.primary
    if primary is None or not _rotatable(config):
        raise ConfigError(
            f"{card.experiment.name} is no part of a rotated design: it does not compare two conditions in held-out "
            "cells; give the cards of the experiments that 'roboxim experiment rotate' wrote"
        )
    return primary


def _rotatable(config: ExperimentConfig) -> bool:
    """Return whether an experiment compares two conditions in its held-out cells, which a rotation can choose."""
    primary = config.primary
    return config.combinations is None and primary is not None and primary.where == "unseen" and not primary.against


def _trainer(card: Card) -> str:
    return card.experiment.trainer or next(iter(card.experiment.config.trainers), "")


def _without_set(config: ExperimentConfig) -> ExperimentConfig:
    datasets = {name: replace(data, more={}) if _all_seen(data) else data for name, data in config.datasets.items()}
    seeds = replace(config.replicates, first_seed=0)
    return replace(config, unseen=(), deviations=(), datasets=datasets, replicates=seeds)
