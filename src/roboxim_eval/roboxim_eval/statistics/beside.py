"""Measures other than success of a policy's episodes: median and range, and how many episodes crossed a limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.episode import EpisodeResult
from roboxim_core.verdicts import LIMIT

CROSSED = "crossed"
"""Measure that counts the limits that an episode crossed."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A measure over episodes."""

    median: float
    """Median over episodes."""
    low: float
    """Smallest value."""
    high: float
    """Largest value."""


@dataclass(frozen=True, kw_only=True)
class Beside:
    """Measures other than success."""

    episodes: int
    """Episodes in which it was measured."""
    crossed: int
    """Episodes that crossed at least one limit of their task."""
    measures: dict[str, Spread]
    """Measure, e.g. ``force_max_n`` or ``path_m``, to its values."""

    def __str__(self) -> str:
        """Format the crossings, e.g. ``limits crossed in 3 of 20 episodes``."""
        return f"limits crossed in {self.crossed} of {self.episodes} episodes"


def beside_success(results: Sequence[EpisodeResult]) -> Beside | None:
    """Return the measures other than success, over all episodes; None: no task has ``limits``.

    A policy that does nothing has a short and smooth path: compare policies of similar success rates.
    """
    found = [
        {name.removeprefix(LIMIT): value for name, value in result.verdict.predicates.items() if name.startswith(LIMIT)}
        for result in results
    ]
    measured = [values for values in found if values]
    if not measured:
        return None
    names = dict.fromkeys(name for values in measured for name in values if name != CROSSED)
    spreads = {}
    for name in names:
        column = np.array([values[name] for values in measured if name in values])
        spreads[name] = Spread(median=float(np.median(column)), low=float(column.min()), high=float(column.max()))
    crossed = sum(values.get(CROSSED, 0.0) > 0 for values in measured)
    return Beside(episodes=len(measured), crossed=crossed, measures=spreads)
