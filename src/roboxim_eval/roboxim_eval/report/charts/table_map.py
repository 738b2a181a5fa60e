"""Map of the success over the table, by where the first object of the task started, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from roboxim_eval.report.charts.heat_map import SHADES
from roboxim_eval.report.charts.svg import drawing, element, link
from roboxim_eval.report.episodes import any_of, episodes_link

WIDTH = 560.0
MOST_DOTS = 400
"""Number of episodes above which the single ones are not drawn."""
LEAST = 3
"""Number of episodes below which a square has no colour."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """An episode on the map."""

    x: float
    """Place away from the robot [m]."""
    y: float
    """Place to the robot's left [m]."""
    success: bool
    """Whether it succeeded."""
    number: int | None = None
    """Number of the episode on the page, to which it leads; none: nowhere."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Squares of a map; the maps of one page have the same."""

    side: float
    """Side of a square [m]."""
    low_x: float
    """Edge next to the robot [m]."""
    low_y: float
    """Edge on the robot's right [m]."""
    rows: int
    """Number of squares away from the robot."""
    columns: int
    """Number of squares from its right to its left."""

    @staticmethod
    def of(starts: Sequence[Start], episodes: int) -> Grid:
        """Return squares that hold all starts, of about eight episodes each.

        Args:
            starts: The starts of all maps; at least one.
            episodes: Number of episodes of one map.
        """
        x, y = np.array([s.x for s in starts]), np.array([s.y for s in starts])
        side = _side(float(np.ptp(x)), float(np.ptp(y)), episodes)
        low_x, low_y = (float(np.floor(v.min() / side) * side) for v in (x, y))
        rows, columns = (int(np.floor((v.max() - low) / side)) + 1 for v, low in ((x, low_x), (y, low_y)))
        return Grid(side=side, low_x=low_x, low_y=low_y, rows=rows, columns=columns)


def table_map(starts: Sequence[Start], grid: Grid | None = None) -> Markup:
    """Return the picture: the robot is below, its left is on the left. Squares have the rate of their episodes.

    Squares and dots lead to their episodes.

    Args:
        starts: The episodes; at least one.
        grid: The squares; none: chosen for these episodes.
    """
    grid = grid or Grid.of(starts, len(starts))
    side, low_x, low_y, rows, columns = grid.side, grid.low_x, grid.low_y, grid.rows, grid.columns
    scale = min(WIDTH / (columns * side), 420.0 / (rows * side))
    width, height = columns * side * scale, rows * side * scale

    def across(value: float) -> float:
        return float(width - (value - low_y) * scale)

    def down(value: float) -> float:
        return float(height - (value - low_x) * scale)

    parts: list[Markup] = [element("rect", x=0, y=0, width=width, height=height, class_="table")]
    for row in range(rows):
        for column in range(columns):
            inside = [
                s for s in starts
                if int((s.x - low_x) // side) == row and int((s.y - low_y) // side) == column
            ]  # fmt: skip
            if inside:
                left, top = across(low_y + (column + 1) * side), down(low_x + (row + 1) * side)
                parts += _square(left, top, side * scale, inside)
    if len(starts) <= MOST_DOTS:
        parts += [
            element(
                "circle",
                cx=across(s.y),
                cy=down(s.x),
                r=3.2,
                class_="solved" if s.success else "failed",
                data_e=s.number,
            )
            for s in starts
        ]
    label = f"Success by start position of {len(starts)} episodes, squares of {100 * side:.0f} cm"
    return drawing(parts, width=float(width), height=float(height), label=label, class_="chart map")


def _side(wide: float, high: float, episodes: int) -> float:
    """Return the side of a square [m]: about eight episodes each, from 2 to 20 cm, a whole number of centimetres."""
    wanted = (max(wide, 0.02) * max(high, 0.02) * 8 / max(episodes, 1)) ** 0.5
    return float(min(0.2, max(0.02, np.ceil(100 * wanted) / 100)))


def _square(left: float, top: float, size: float, inside: Sequence[Start]) -> list[Markup]:
    solved = sum(start.success for start in inside)
    rate, number = solved / len(inside), f"{solved} of {len(inside)}"
    shade = f"h{round(SHADES * rate)}" if len(inside) >= LEAST else "few"
    title = element("title", f"{number} succeeded")
    parts = [element("rect", [title], x=left, y=top, width=size, height=size, class_=f"square {shade}")]
    if size >= 44:
        parts.append(element("text", f"{solved}/{len(inside)}", x=left + 4, y=top + 14, class_=f"axis on {shade}"))
    numbers = [start.number for start in inside if start.number is not None]
    return [link(parts, episodes_link(n=any_of(numbers)))] if numbers else parts
