"""Groups of recorded choices, by which a report counts successes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

MAX_NUMBERS = 12
"""Number of distinct numbers above which they are grouped into thirds."""
MAX_NAMES = 60
"""Number of distinct names above which a choice is not a dimension of a report, e.g. positions of a long list."""


def grouped(values: Mapping[str, str]) -> dict[str, str]:
    """Return the group of each episode.

    Names are groups themselves. More than `MAX_NUMBERS` different numbers are divided into thirds with equal numbers of
    episodes, e.g. ``1.6 to 2.1``.

    Args:
        values: Episode id to the recorded value, e.g. ``{"eval-0-00000-0": "1.732"}``.

    Returns:
        Episode id to group; empty if there are too many different names for groups.
    """
    different = set(values.values())
    if len(different) <= MAX_NUMBERS:
        return dict(values)
    try:
        numbers = {episode: float(value) for episode, value in values.items()}
    except ValueError:
        return dict(values) if len(different) <= MAX_NAMES else {}
    limits = np.quantile(list(numbers.values()), [0, 1 / 3, 2 / 3, 1])
    names = [f"{low:.3g} to {high:.3g}" for low, high in zip(limits, limits[1:], strict=False)]
    places = np.searchsorted(limits[1:-1], list(numbers.values()), side="right")
    return {episode: names[place] for episode, place in zip(numbers, places, strict=True)}
