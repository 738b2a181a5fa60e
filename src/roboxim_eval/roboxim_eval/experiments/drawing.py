"""Levels of a factor that are drawn from a set of objects by seed: a sample of many, of which some are held out.

The order of a set's objects is a function of the seed and the set's name. A draw takes the first ones: the first
``hold_out`` of them are held out, the others are seen. A larger draw with the same seed thus contains a smaller one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.config import LocatedMap, from_plain, line_of, place
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary

DRAW = "draw"
"""Key of a factor whose levels are drawn; it stands alone."""


@dataclass(frozen=True, kw_only=True)
class DrawConfig:
    """Value of a factor's key ``draw``."""

    set: str
    """Set of objects, a folder of ``config/objects``, e.g. ``shapes``."""
    count: int
    """Number of objects, the levels of the factor."""
    hold_out: int = 0
    """Number of these that are held out in every cell, as ``unseen`` would say."""
    seed: int = 0
    """Seed of the draw."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is out of range.
        """
        if self.count < 1 or not 0 <= self.hold_out < self.count or self.seed < 0:
            raise ConfigError(
                f"needs count >= 1, 0 <= hold_out < count and seed >= 0, got {self.count}, {self.hold_out}, {self.seed}"
            )


def with_draws(data: Any, source: str) -> Any:
    """Return an experiment's plain data with lists of objects in place of draws, and the held-out ones in ``unseen``.

    Args:
        data: Plain data of the file, at its scale.
        source: Its name, for messages.

    Raises:
        ConfigError: When a draw is invalid, its set is unknown or has too few objects.
    """
    factors = data.get("factors") if isinstance(data, Mapping) else None
    if not isinstance(factors, Mapping):
        return data
    drawn = {
        name: _levels(levels, data, source, name)
        for name, levels in factors.items()
        if isinstance(levels, Mapping) and DRAW in levels
    }
    if not drawn:
        return data
    unseen = [{name: level} for name, (levels, held_out) in drawn.items() for level in levels[:held_out]]
    changed: dict[str, Any] = {"factors": {**factors, **{name: levels for name, (levels, _) in drawn.items()}}}
    if unseen:
        changed["unseen"] = [*(data.get("unseen") or ()), *unseen]
    return LocatedMap({**data, **changed}, {key: line_of(data, key) for key in data})


def _levels(factor: Mapping[str, Any], data: Any, source: str, name: str) -> tuple[list[str], int]:
    """Return the drawn objects, and how many of them, the first ones, are held out."""
    where = f"{source} is not valid: {place(data, ('factors', name))}"
    if len(factor) > 1:
        raise ConfigError(f"{where}: draw stands alone, got also {', '.join(key for key in factor if key != DRAW)}")
    draw = from_plain(factor[DRAW], DrawConfig, source=source, path=f"factors.{name}.{DRAW}")
    sets = ModelLibrary().object_sets
    if draw.set not in sets:
        raise ConfigError(f"{where}: unknown set of objects '{draw.set}'; {one_of(sets, draw.set)}")
    members = sets[draw.set]
    if draw.count > len(members):
        raise ConfigError(f"{where}: draws {draw.count} of the {len(members)} objects of '{draw.set}'; draw fewer")
    order = np.random.default_rng([draw.seed, *draw.set.encode()]).permutation(len(members))
    return [members[number] for number in order[: draw.count]], draw.hold_out
