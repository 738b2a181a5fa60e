"""Fits how measured motion follows actions, and names the edit that explains why an episode's does not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from roboxim_datasets.audit.values import Flags, Values

LAGS = (-1, 0, 1, 2, 3)
"""Ticks between an action and the motion that is compared with it; -1: the motion comes before the action."""
ROUNDS = 12
EXPLAINS = 0.35
"""Largest share of the residual that an edit may leave to be named."""


def response(pairs: Sequence[tuple[Values, Values]], scale: float) -> Values:
    """Fit one response for all episodes and components, with little weight for what does not fit.

    Args:
        pairs: Asked increments, shape (T, n), and measured ones, shape (T - 1, n), of each episode.
        scale: Residual that is certainly no outlier.

    Returns:
        Weight of each of `LAGS`.
    """
    design = np.concatenate(
        [_lagged(commanded)[: len(measured)].reshape(-1, len(LAGS)) for commanded, measured in pairs]
    )
    goal = np.concatenate([measured.reshape(-1) for _, measured in pairs])
    best, lowest = np.zeros(len(LAGS)), np.inf
    for start in (np.eye(len(LAGS))[1], np.linalg.lstsq(design, goal, rcond=None)[0]):
        weights = start
        for _ in range(ROUNDS):
            residual = goal - design @ weights
            spread = max(1.4826 * float(np.median(np.abs(residual))), scale)
            root = np.sqrt(1 / (1 + (residual / spread) ** 2))
            weights = np.linalg.lstsq(design * root[:, None], goal * root, rcond=None)[0]
        left = float(np.median(np.abs(goal - design @ weights)))
        if left < lowest:
            best, lowest = weights, left
    return np.asarray(best)


def predicted(commanded: Values, weights: Values) -> Values:
    """Return the motion that a response predicts, shape (T - 1, n), for actions of shape (T, n)."""
    return np.asarray(_lagged(commanded)[:-1] @ weights)


def _lagged(commanded: Values) -> Values:
    """Return shape (T, n, lags): the increment `LAGS` ticks before each tick; 0 where there is none."""
    found = [shifted(commanded, lag) for lag in LAGS]
    return np.stack(found, axis=-1)


def shifted(rows: Values, ticks: int) -> Values:
    """Return rows that come some ticks later, with zeros where there are none."""
    moved = np.zeros_like(rows)
    if ticks >= 0:
        moved[ticks:] = rows[: len(rows) - ticks]
    else:
        moved[:ticks] = rows[-ticks:]
    return moved


def runs_of(flags: Flags) -> list[tuple[int, int]]:
    """Return the first and the last place of every run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0]))
    return [(int(start), int(end) - 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]


def likeliest(edited: Values, other: Values, names: Sequence[str]) -> str:
    """Return in words which edit turns rows into the expected ones; empty: none does.

    Args:
        edited: Rows that may be edited, shape (T, n).
        other: What they should be, shape (T, n).
        names: Names of the components.
    """
    before = float(np.square(edited - other).mean())
    best, words = EXPLAINS**2 * before, ""
    for text, rows in _repairs(edited, other, names):
        left = float(np.square(rows - other).mean())
        if left < best:
            best, words = left, text
    return words


def _repairs(rows: Values, other: Values, names: Sequence[str]) -> Iterator[tuple[str, Values]]:
    """Yield edits in words, the plainest first, with the rows before the edit."""
    power = float(np.square(rows).sum())
    if power > 0:
        gain = float((rows * other).sum()) / power
        if gain > 0 and abs(gain - 1) > 0.01:
            yield f"scaled by {1 / gain:.2f}", rows * gain
    for ticks in (1, -1, 2, -2, 3, -3, 4, -4):
        if len(rows) > 3 * abs(ticks):
            words = f"{abs(ticks)} {'tick' if abs(ticks) == 1 else 'ticks'} {'late' if ticks > 0 else 'early'}"
            yield words, rows[np.clip(np.arange(len(rows)) + ticks, 0, len(rows) - 1)]
    count = rows.shape[1]
    if 1 <= count <= 3:
        for order in permutations(range(count)):
            for signs in product((1, -1), repeat=count):
                if order != tuple(range(count)) or min(signs) < 0:
                    yield _permuted(order, signs, names), rows[:, order] * signs
    for component in range(count):
        changed = rows.copy()
        changed[:, component] *= -1
        yield f"the sign of {names[component]}", changed
        power = float(np.square(rows[:, component]).sum())
        if power > 0:
            gain = float(rows[:, component] @ other[:, component]) / power
            changed = rows.copy()
            changed[:, component] *= gain
            if gain > 1e-3:
                yield f"{names[component]} scaled by {1 / gain:.2f}", changed
        for second in range(component + 1, count):
            changed = rows.copy()
            changed[:, [component, second]] = changed[:, [second, component]]
            yield f"{names[component]} and {names[second]} exchanged", changed


def _permuted(order: Sequence[int], signs: Sequence[int], names: Sequence[str]) -> str:
    flipped = [names[place] for place, sign in enumerate(signs) if sign < 0]
    words = []
    if list(order) != sorted(order):
        words.append("components in the order " + ", ".join(names[i] for i in order))
    if flipped:
        words.append(("the sign of " if len(flipped) == 1 else "the signs of ") + " and ".join(flipped))
    return ", ".join(words)
