"""Curves: the success rate over training steps or another number, a line for each condition, a band over replicates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from roboxim_eval.report.charts.svg import drawing, element
from roboxim_eval.report.charts.svg import link as linked

WIDTH, HEIGHT = 680.0, 300.0
LEFT, RIGHT, TOP, BOTTOM = 44.0, 130.0, 12.0, 40.0
LETTER = 7.6
"""Width of a letter of a name [px]."""
LINE = 14.0
"""Least distance of two names [px]."""
TICK = 34.0
"""Least distance of two numbers on the axis [px]."""
COLOURS = 6
"""Number of colours of the style, after which they repeat."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """Rates of a condition's replicates at a place on the axis."""

    steps: int
    """Training steps, or the number on the axis."""
    rates: tuple[float, ...]
    """Success rate of each replicate, 0..1."""


def learning_curve(
    curves: Mapping[str, Sequence[CurvePoint]], link: Callable[[str, int], str] = lambda *_: "",
    axis: str = "training steps",
) -> Markup:  # fmt: skip
    """Return the picture. The band reaches from the worst to the best replicate, the line is their mean.

    Args:
        curves: Condition to its points, by increasing steps.
        link: (condition, steps) to the point's link; empty: no link.
        axis: What the steps are.
    """
    max_steps = max(point.steps for points in curves.values() for point in points)
    width = max(WIDTH, WIDTH - RIGHT + 12 + LETTER * max(map(len, curves)))  # names stand right of the lines

    def x(steps: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * steps / max_steps

    def y(rate: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - rate)

    parts = []
    for rate in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=y(rate), y2=y(rate), class_="tick"))
        parts.append(
            element("text", f"{100 * rate:.0f} %", x=LEFT - 6, y=y(rate) + 4, text_anchor="end", class_="axis")
        )
    marked = 2 * max_steps
    for steps in sorted({point.steps for points in curves.values() for point in points}, reverse=True):
        if x(marked) - x(steps) < TICK:
            continue
        marked = steps
        parts.append(
            element("text", _steps(steps), x=x(steps), y=HEIGHT - BOTTOM + 16, text_anchor="middle", class_="axis")
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(element("text", axis, x=middle, y=HEIGHT - 6, text_anchor="middle", class_="axis"))
    taken: list[float] = []
    for number, (name, points) in enumerate(curves.items()):
        colour = f"c{number % COLOURS}"
        upper = [(x(p.steps), y(max(p.rates))) for p in points]
        lower = [(x(p.steps), y(min(p.rates))) for p in reversed(points)]
        mean = [(x(p.steps), y(float(np.mean(p.rates)))) for p in points]
        parts.append(element("polygon", points=_points([*upper, *lower]), class_=f"band {colour}"))
        parts.append(element("polyline", points=_points(mean), class_=f"line {colour}"))
        for point, (px, py) in zip(points, mean, strict=True):
            spot = element("circle", cx=px, cy=py, r=3.0, class_=f"spot {colour}")
            target = link(name, point.steps)
            parts.append(linked([spot], target) if target else spot)
        label = _free(mean[-1][1] + 4, taken)
        parts.append(element("text", name, x=mean[-1][0] + 8, y=label, class_=f"name {colour}"))
    return drawing(
        parts,
        width=width,
        height=HEIGHT,
        label=f"Success rate over {axis}",
        class_="chart curve",
    )


def _free(y: float, taken: list[float]) -> float:
    """Return the nearest height in the picture for a label that overlaps none of the earlier ones, and note it."""
    offsets = (sign * n * LINE / 2 for n in range(int(4 * HEIGHT / LINE)) for sign in (1, -1))
    free = (
        y + offset for offset in offsets
        if LINE <= y + offset <= HEIGHT - 4 and all(abs(y + offset - other) >= LINE for other in taken)
    )  # fmt: skip
    taken.append(next(free, y))
    return taken[-1]


def _points(places: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{px:.1f},{py:.1f}" for px, py in places)


def _steps(steps: int) -> str:
    return f"{steps // 1000}k" if steps >= 1000 and steps % 1000 == 0 else f"{steps}"
