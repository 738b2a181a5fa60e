"""Heat maps: a rate, or a difference of rates, for each cell of an experiment; held-out cells are framed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from roboxim_eval.experiments.cells import Cell
from roboxim_eval.statistics.tables import Count

SHADES = 10
"""Number of shades from 0 to 100 %, and of each sign of a difference."""


@dataclass(frozen=True, kw_only=True)
class HeatCell:
    """One field."""

    text: str
    """Its text, e.g. ``85`` for 85 %."""
    number: str
    """Its numbers, e.g. ``51 of 60``."""
    shade: str
    """Class of its colour."""
    unseen: bool
    """Whether the cell is held out."""
    link: str
    """Its link."""
    title: str
    """Name and numbers of the cell."""


@dataclass(frozen=True, kw_only=True)
class HeatMap:
    """A heat map."""

    title: str
    """Its title."""
    columns: tuple[str, ...]
    """Levels of the last factor."""
    rows: tuple[tuple[str, tuple[HeatCell | None, ...]], ...]
    """Levels of the other factors, and a field for each column; none: no such cell, or it was not evaluated."""


def rate_map(
    title: str, cells: Sequence[Cell], counts: Mapping[str, Count], link: Callable[[str], str]
) -> HeatMap:  # fmt: skip
    """Return the success rates of an arm.

    Args:
        title: Name of the arm.
        cells: All cells of the experiment.
        counts: Key of a cell to its count.
        link: Key of a cell to its field's link.
    """

    def field(cell: Cell) -> HeatCell | None:
        count = counts.get(cell.key)
        if count is None or not count.episodes:
            return None
        rate, number = count.successes / count.episodes, f"{count.successes} of {count.episodes}"
        return HeatCell(
            text=f"{100 * rate:.0f}", number=number, shade=f"h{round(SHADES * rate)}", unseen=cell.unseen,
            link=link(cell.key), title=f"{cell.key}: {number} = {100 * rate:.0f} %{_held_out(cell)}",
        )  # fmt: skip

    return _map(title, cells, field)


def difference_map(
    title: str, cells: Sequence[Cell], first: Mapping[str, Count], second: Mapping[str, Count],
    link: Callable[[str], str],
) -> HeatMap:  # fmt: skip
    """Return the differences of two arms, first minus second, in points; see `rate_map`."""

    def field(cell: Cell) -> HeatCell | None:
        one, two = first.get(cell.key), second.get(cell.key)
        if one is None or two is None or not one.episodes or not two.episodes:
            return None
        apart = one.successes / one.episodes - two.successes / two.episodes
        sign = "p" if apart > 0 else "m"
        number = f"{one.successes} of {one.episodes} - {two.successes} of {two.episodes}"
        each = f"2 x {one.episodes}" if one.episodes == two.episodes else f"{one.episodes}, {two.episodes}"
        return HeatCell(
            text=f"{round(100 * apart) + 0:+d}", number=each, shade=f"d{sign}{round(SHADES / 2 * abs(apart))}",
            unseen=cell.unseen, link=link(cell.key),
            title=f"{cell.key}: {number} = {100 * apart:+.0f} points{_held_out(cell)}",
        )  # fmt: skip

    return _map(title, cells, field)


def arm_maps(
    cells: Sequence[Cell], counts: Mapping[str, Mapping[str, Count]], pair: tuple[str, str] | None,
    link: Callable[[tuple[str, ...], str], str],
) -> list[HeatMap]:  # fmt: skip
    """Return the rates of each arm, and the differences of two of them.

    Args:
        cells: All cells.
        counts: Arm to its counts by key of a cell.
        pair: The arms of the differences; none: no such map.
        link: Arms and key of a cell to the field's link.
    """
    maps = [rate_map(arm, cells, arm_counts, partial(link, (arm,))) for arm, arm_counts in counts.items()]
    if pair is not None:
        first, second = pair
        heading = f"{first} - {second}, points"
        maps.append(difference_map(heading, cells, counts[first], counts[second], partial(link, pair)))
    return maps


def _held_out(cell: Cell) -> str:
    return ", held out" if cell.unseen else ""


def _map(title: str, cells: Sequence[Cell], field: Callable[[Cell], HeatCell | None]) -> HeatMap:
    *rest, last = cells[0].levels
    columns = tuple(dict.fromkeys(cell.levels[last] for cell in cells))
    rows: dict[str, dict[str, HeatCell | None]] = {}
    for cell in cells:
        name = ", ".join(cell.levels[factor] for factor in rest) or "all"
        rows.setdefault(name, {})[cell.levels[last]] = field(cell)
    return HeatMap(
        title=title, columns=columns,
        rows=tuple((name, tuple(row.get(column) for column in columns)) for name, row in rows.items()),
    )  # fmt: skip
