"""Several comparisons at a time: adjusted p values, and groups of more than two models."""

from __future__ import annotations

import itertools
import string
from collections.abc import Mapping, Sequence

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Array


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Return p values adjusted by Holm's step-down method, which bounds the chance of any false alarm.

    Source:
        Holm (1979), Scandinavian Journal of Statistics 6, 65-70.
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    adjusted, highest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = highest
    return tuple(adjusted)


def compact_letters(rates: Mapping[str, float], different: Mapping[tuple[str, str], bool]) -> dict[str, str]:
    """Return letters of models: two models without a common letter differ.

    Args:
        rates: Model to its success rate; the best gets the first letter. After ``z`` follow ``A`` to ``Z``, then
            ``(53)``, ``(54)``, ...
        different: Pair of models to whether they differ after Holm's adjustment; either order of the names.

    Raises:
        InvalidRequestError: If a pair is missing.

    Source:
        Piepho (2004), Journal of Computational and Graphical Statistics 13, 456-466 (insert and absorb).
    """
    names = sorted(rates, key=lambda name: (-rates[name], name))
    groups: list[set[str]] = [set(names)]
    for one, two in itertools.combinations(names, 2):
        if (one, two) not in different and (two, one) not in different:
            raise InvalidRequestError(f"no comparison of {one} and {two}")
        if not different.get((one, two), different.get((two, one), False)):
            continue
        split = []
        for group in groups:
            split += [group - {one}, group - {two}] if {one, two} <= group else [group]
        groups = [g for i, g in enumerate(split) if not any(g < o or (g == o and j < i) for j, o in enumerate(split))]
    groups.sort(key=lambda group: min(names.index(name) for name in group))
    return {name: "".join(_letter(i) for i, group in enumerate(groups) if name in group) for name in names}


def _letter(number: int) -> str:
    """Return the letter of a group, e.g. ``a`` for 0; a number in brackets where no letter is left."""
    return string.ascii_letters[number] if number < len(string.ascii_letters) else f"({number + 1})"


def bradley_terry(wins: Mapping[tuple[str, str], int]) -> dict[str, float]:
    """Return strengths of models that met in pairs, on scenes that not all of them shared.

    A small penalty keeps the strength of a model that always wins finite. With shared scenes use `compact_letters`.

    Args:
        wins: (winner, loser) to the number of scenes that the winner alone solved.

    Returns:
        Model to log-odds of winning against an average model; the sum is 0.

    Source:
        Bradley and Terry (1952), Biometrika 39, 324-345.
    """
    from scipy.optimize import minimize

    names = sorted({name for pair in wins for name in pair})
    place = {name: i for i, name in enumerate(names)}
    first = np.array([place[winner] for winner, _ in wins])
    second = np.array([place[loser] for _, loser in wins])
    counts = np.array(list(wins.values()), dtype=float)

    def cost(strength: Array) -> float:
        return float(counts @ np.logaddexp(0.0, strength[second] - strength[first]) + 0.01 * strength @ strength)

    found = minimize(cost, np.zeros(len(names))).x if names else np.zeros(0)
    return {name: float(found[i] - found.mean()) for i, name in enumerate(names)}
