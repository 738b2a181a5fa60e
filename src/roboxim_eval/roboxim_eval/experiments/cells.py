"""Cells of an experiment, and the task mixes that they expand to."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.config import TASK, ExperimentConfig, Match

MAX_CELLS = 1000
"""Largest number of cells."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A combination of one level of each factor."""

    levels: dict[str, str]
    """Factor to level."""
    roles: tuple[str, ...]
    """Factors that are roles, sorted: their levels are object models."""
    unseen: bool
    """Whether it is held out."""

    @property
    def key(self) -> str:
        """Name of the cell, as a mix records it: ``pick_up target=apple camera=left``."""
        models = [f"{role}={self.levels[role]}" for role in self.roles]
        return " ".join((PurePath(self.levels[TASK]).stem, *models, *([self.rest] if self.rest else [])))

    @property
    def rest(self) -> str:
        """The levels of the factors that are neither tasks nor roles, e.g. ``camera=left``."""
        factors = sorted(factor for factor in self.levels if factor != TASK and factor not in self.roles)
        return " ".join(f"{factor}={self.levels[factor]}" for factor in factors)

    def matches(self, match: Match) -> bool:
        """Return whether the cell has all levels of a match."""
        return match.items() <= self.levels.items()


def named_cell(name: str) -> Cell | None:
    """Return the cell of a name that a mix records; all factors except the task are taken as roles.

    Args:
        name: For example ``pick_up target=apple camera=left``.

    Returns:
        The cell; its key has the factors in the order of their names. None: the name is not that of a cell.
    """
    task, *others = name.split(" ")
    levels = dict(pair for word in others if len(pair := word.partition("=")[::2]) == 2 and all(pair))
    if len(levels) < len(others) or "=" in task:
        return None
    levels = {TASK: task, **dict(sorted(levels.items()))}
    return Cell(levels=levels, roles=tuple(sorted(levels.keys() - {TASK})), unseen=False)


def cells_of(config: ExperimentConfig) -> tuple[Cell, ...]:
    """Return all cells of an experiment, in the order of the factors' levels.

    Raises:
        ConfigError: When there are too many cells or none, or an entry of ``unseen`` or ``cells`` matches no cell.
    """
    roles = tuple(sorted(f for f, levels in config.factors.items() if f != TASK and not isinstance(levels, Mapping)))
    number = 1
    for levels in config.factors.values():
        number *= len(levels)
    if number > MAX_CELLS:
        raise ConfigError(f"factors have {number} combinations, at most {MAX_CELLS} are allowed")
    combinations = [
        dict(zip(config.factors, map(str, levels), strict=True))
        for levels in itertools.product(*(tuple(levels) for levels in config.factors.values()))
    ]
    kept = [levels for levels in combinations if not config.cells or _in(levels, config.cells)]
    for name, among in (("cells", combinations), ("unseen", kept)):
        for match in getattr(config, name):
            if not any(_in(levels, [match]) for levels in among):
                raise ConfigError(f"{name}: no cell matches {dict(match)}")
    return tuple(Cell(levels=levels, roles=roles, unseen=_in(levels, config.unseen)) for levels in kept)


def _in(levels: Match, matches: Sequence[Match]) -> bool:
    return any(match.items() <= levels.items() for match in matches)


def chosen(cells: Sequence[Cell], where: str, only: Sequence[Match] = ()) -> tuple[Cell, ...]:
    """Return the cells of a group.

    Args:
        cells: All cells.
        where: ``all``, ``seen`` or ``unseen``.
        only: Matches, one of which a cell must have; empty: every cell of the group.
    """
    group = (cell for cell in cells if where == "all" or cell.unseen == (where == "unseen"))
    return tuple(cell for cell in group if not only or any(cell.matches(match) for match in only))


def mix_of(config: ExperimentConfig, counts: Mapping[str, int], changes: Mapping[str, Any] | None = None) -> Any:
    """Return a task mix as plain data, seeded by cell.

    Args:
        config: The experiment.
        counts: Key of a cell to its number of episodes; cells that are left out are not in the mix.
        changes: Further keys of every task to replace; none: only the experiment's.

    Returns:
        The content of a YAML file of ``config/tasks``.
    """
    parts = []
    for cell in cells_of(config):
        if cell.key not in counts:
            continue
        part: dict[str, Any] = {"tasks": [cell.levels[TASK]], "episodes": counts[cell.key]}
        if cell.roles:
            part["models"] = {role: [cell.levels[role]] for role in cell.roles}
        if cell.rest:
            part["key"] = cell.rest
        own: Any = {}
        for factor, level in cell.levels.items():
            levels = config.factors[factor]
            if isinstance(levels, Mapping):
                own = _joined(own, levels[level] or {})
        if own:
            part["set"] = own
        parts.append(part)
    mix: dict[str, Any] = {"seed_by": "cell", "cells": parts}
    common = _joined(config.set, changes or {})
    return mix | ({"set": common} if common else {})


def _joined(first: Any, second: Any) -> Any:
    """Return two changes as one that has the effect of both; a null stays, since it removes a key of the task."""
    if not isinstance(second, Mapping) or "values" in second or "lower" in second or not isinstance(first, Mapping):
        return second
    return {**first, **{key: _joined(first.get(key), value) for key, value in second.items()}}
