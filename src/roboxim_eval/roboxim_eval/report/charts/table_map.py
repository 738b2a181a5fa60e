"""Maps of the success over the table, by where the first object of the task started, seen from above.

They have axes in metres, the robot and the edges of the table, for orientation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from roboxim_eval.report.charts.heat_map import SHADES
from roboxim_eval.report.charts.svg import drawing, element, link
from roboxim_eval.report.episodes import any_of, episodes_link

WIDTH, HEIGHT = 470.0, 230.0
"""Largest size of the picture's inner part [px]."""
LEFT, BELOW, EDGE = 46.0, 40.0, 8.0
"""Space for the axes, and at the other two edges [px]."""
MARGIN_M = 0.06
"""Margin around the shown part [m]."""
MIN_WIDTH_M = 0.8
"""Smallest width of the shown part [m], without margins."""
MAX_DOTS = 400
"""Number of episodes above which the single ones are not drawn."""
MIN_EPISODES = 3
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
    """Number of the episode on the page, to which it links; none: no link."""


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


@dataclass(frozen=True, kw_only=True)
class Place:
    """Position of the table in the frame of the robot's base, which is that of the starts."""

    table: tuple[float, float, float, float] | None
    """Centre of the table's top, and its extent: x, y, along x, along y [m]; none: it is turned against the robot."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Part of the plane that a map shows; the maps of one page show the same part."""

    low_x: float
    """Lower edge, next to the robot [m]."""
    high_x: float
    """Upper edge [m]."""
    low_y: float
    """Right edge [m]."""
    high_y: float
    """Left edge [m]."""

    @staticmethod
    def of(grid: Grid, place: Place | None) -> View:
        """Return a view of all squares, and of the robot's base if it is known."""
        x = [grid.low_x, grid.low_x + grid.rows * grid.side]
        y = [grid.low_y, grid.low_y + grid.columns * grid.side]
        if place is not None:
            x, y = [*x, -0.04], [*y, -0.1, 0.1]
        wider = max(0.0, MIN_WIDTH_M - (max(y) - min(y))) / 2 + MARGIN_M
        return View(low_x=min(x) - MARGIN_M, high_x=max(x) + MARGIN_M, low_y=min(y) - wider, high_y=max(y) + wider)

    @property
    def scale(self) -> float:
        """Pixels of a metre."""
        return min(WIDTH / (self.high_y - self.low_y), HEIGHT / (self.high_x - self.low_x))

    def across(self, y: float) -> float:
        """Return the horizontal place of a y; the robot's left is on the left [px]."""
        return LEFT + (self.high_y - y) * self.scale

    def down(self, x: float) -> float:
        """Return the vertical place of an x; the robot is below [px]."""
        return EDGE + (self.high_x - x) * self.scale

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the picture, axes included [px]."""
        return self.across(self.low_y) + EDGE, self.down(self.low_x) + BELOW


def table_maps(starts: Mapping[str, Sequence[Start]], place: Place | None = None) -> dict[str, Any]:
    """Return a picture for each arm, all with the same squares and axes, and the content of their legend.

    Args:
        starts: Arm to its episodes; at least one each.
        place: Where robot and table are; none: unknown.
    """
    grid = Grid.of([s for arm_starts in starts.values() for s in arm_starts], max(map(len, starts.values())))
    return {
        "pictures": {arm: table_map(arm_starts, grid, place) for arm, arm_starts in starts.items()},
        "square_cm": 100 * grid.side,
        "keys": [(text, mark_key(success)) for text, success in (("success", True), ("no success", False))]
        if any(len(arm_starts) <= MAX_DOTS for arm_starts in starts.values()) else [],
    }  # fmt: skip


def table_map(starts: Sequence[Start], grid: Grid | None = None, place: Place | None = None) -> Markup:
    """Return the picture: the robot is below, its left is on the left. Squares have the rate of their episodes.

    Squares and marks link to their episodes.

    Args:
        starts: The episodes; at least one.
        grid: The squares; none: chosen for these episodes.
        place: Where robot and table are; none: unknown.
    """
    grid = grid or Grid.of(starts, len(starts))
    view = View.of(grid, place)
    parts = [*_table(view, place), *_squares(starts, grid, view), *_axes(view)]
    if place is not None:
        x, y = view.across(0.0), view.down(0.0)
        parts += [
            element("circle", cx=x, cy=y, r=11.0, class_="robot"),
            element("text", "robot", x=x + 16, y=y + 4, class_="axis"),
        ]
    if len(starts) <= MAX_DOTS:
        parts += [mark(view.across(s.y), view.down(s.x), success=s.success, number=s.number) for s in starts]
    label = f"Success by start position of {len(starts)} episodes, squares of {100 * grid.side:.0f} cm"
    width, height = view.size
    return drawing(parts, width=width, height=height, label=label, class_="chart map")


def mark(x: float, y: float, *, success: bool, number: int | None = None) -> Markup:
    """Return the mark of an episode: a disc for a success, a cross for other ends (distinct without colour)."""
    if success:
        return element("circle", cx=x, cy=y, r=4.0, class_="solved", data_e=number)
    ends = f"M{x - 3.6:.1f} {y - 3.6:.1f}l7.2 7.2m0 -7.2l-7.2 7.2"
    return element("path", d=ends, class_="unsolved", data_e=number)


def mark_key(success: bool) -> Markup:
    """Return a mark for a legend, drawn as on the map."""
    return drawing(
        [mark(7.0, 7.0, success=success)], width=14, height=14, label="", class_="mark-key"
    )  # fmt: skip


def _table(view: View, place: Place | None) -> list[Markup]:
    """Return the visible part of the table's top, with its visible edges."""
    if place is None or place.table is None:
        return []
    x, y, along_x, along_y = place.table
    low_x, high_x = max(view.low_x, x - along_x / 2), min(view.high_x, x + along_x / 2)
    low_y, high_y = max(view.low_y, y - along_y / 2), min(view.high_y, y + along_y / 2)
    left, right, top, bottom = view.across(high_y), view.across(low_y), view.down(high_x), view.down(low_x)
    edges = [
        (low_x > view.low_x, left, bottom, right, bottom), (high_x < view.high_x, left, top, right, top),
        (low_y > view.low_y, right, top, right, bottom), (high_y < view.high_y, left, top, left, bottom),
    ]  # fmt: skip
    parts = [element("rect", x=left, y=top, width=right - left, height=bottom - top, class_="table")]
    parts += [
        element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_="table-edge") for shown, x1, y1, x2, y2 in edges if shown
    ]
    if edges[0][0]:
        parts.append(element("text", "edge of the table", x=right - 6, y=bottom - 6, text_anchor="end", class_="axis"))
    return parts


def _axes(view: View) -> list[Markup]:
    """Return both axes, with a number every 10 or 20 cm."""
    step = 0.1 if view.scale > 250 else 0.2
    left, right, top, bottom = LEFT, view.across(view.low_y), EDGE, view.down(view.low_x)
    parts = [element("rect", x=left, y=top, width=right - left, height=bottom - top, class_="frame")]
    for y in _ticks(view.low_y, view.high_y, step):
        at = view.across(y)
        parts.append(element("line", x1=at, x2=at, y1=bottom, y2=bottom + 4, class_="zero"))
        parts.append(element("text", f"{y + 0.0:.1f}", x=at, y=bottom + 16, text_anchor="middle", class_="axis"))
    for x in _ticks(view.low_x, view.high_x, step):
        at = view.down(x)
        parts.append(element("line", x1=left - 4, x2=left, y1=at, y2=at, class_="zero"))
        parts.append(element("text", f"{x + 0.0:.1f}", x=left - 7, y=at + 4, text_anchor="end", class_="axis"))
    middle = (top + bottom) / 2
    parts.append(element(
        "text", "y, to the robot's left [m]", x=(left + right) / 2, y=bottom + 33, text_anchor="middle", class_="axis"
    ))  # fmt: skip
    parts.append(element(
        "text", "x, away from the robot [m]", x=11, y=middle, text_anchor="middle", class_="axis",
        transform=f"rotate(-90 11 {middle:.1f})",
    ))  # fmt: skip
    return parts


def _ticks(low: float, high: float, step: float) -> list[float]:
    return [n * step for n in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _squares(starts: Sequence[Start], grid: Grid, view: View) -> list[Markup]:
    inside: dict[tuple[int, int], list[Start]] = {}
    for s in starts:
        place = int((s.x - grid.low_x) // grid.side), int((s.y - grid.low_y) // grid.side)
        inside.setdefault(place, []).append(s)
    parts = []
    for (row, column), square in sorted(inside.items()):
        left = view.across(grid.low_y + (column + 1) * grid.side)
        parts += _square(left, view.down(grid.low_x + (row + 1) * grid.side), grid.side * view.scale, square)
    return parts


def _side(wide: float, high: float, episodes: int) -> float:
    """Return the side of a square [m]: about eight episodes each, from 2 to 20 cm, a whole number of centimetres."""
    wanted = (max(wide, 0.02) * max(high, 0.02) * 8 / max(episodes, 1)) ** 0.5
    return float(min(0.2, max(0.02, np.ceil(100 * wanted) / 100)))


def _square(left: float, top: float, size: float, inside: Sequence[Start]) -> list[Markup]:
    solved = sum(start.success for start in inside)
    rate, number = solved / len(inside), f"{solved} of {len(inside)}"
    shade = f"h{round(SHADES * rate)}" if len(inside) >= MIN_EPISODES else "few"
    title = element("title", f"{number} succeeded")
    parts = [element("rect", [title], x=left, y=top, width=size, height=size, class_=f"square {shade}")]
    if size >= 44:
        parts.append(element("text", f"{solved}/{len(inside)}", x=left + 4, y=top + 14, class_=f"axis on {shade}"))
    numbers = [start.number for start in inside if start.number is not None]
    return [link(parts, episodes_link(n=any_of(numbers)))] if numbers else parts
