"""Charts of an episode's ticks, all with the same time axis, so that they share one cursor."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from roboxim_eval.report.charts.svg import element
from roboxim_eval.report.course import shown

HEIGHT = 100.0
"""Height in units of the drawing, which the page stretches; its width is one unit for each tick."""
TOP = 6.0
"""Space above and below the values."""
STILL = 1e-6
"""Ranges of values up to this size are drawn as constant."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """Numbers over an episode's ticks."""

    name: str
    """Name of the quantity."""
    lines: Sequence[npt.NDArray[np.float64]]
    """Values of each line, shape (T,); NaN: none at this tick."""
    measure: str = ""
    """Name that ends in a unit, e.g. ``lift_m``, which sets the format of numbers; empty: plain numbers."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Bounds within which the values should stay."""
    broken: npt.NDArray[np.bool_] | None = None
    """Ticks outside the bounds, which are shaded; none: no shading."""
    mark: int | None = None
    """A tick to mark."""


def course_chart(curve: Curve) -> Markup:
    """Return the picture; the page's script moves its cursor and writes the values at a tick."""
    bounds = [x for x in curve.limits if math.isfinite(x)]
    found = np.concatenate([*map(np.asarray, curve.lines), np.array(bounds)])
    found = found[np.isfinite(found)]
    low, high = (float(found.min()), float(found.max())) if len(found) else (0.0, 1.0)
    still = high - low < STILL
    if still:
        low, high = low - 1.0, high + 1.0
    count = len(curve.lines[0])

    def down(value: float) -> float:
        return TOP + (HEIGHT - 2 * TOP) * (high - value) / (high - low)

    width = float(max(1, count - 1))
    parts = [
        element("rect", x=float(a), y=0, width=float(max(b - a, 1)), height=HEIGHT, class_="broken")
        for a, b in _runs(curve.broken)
    ]
    parts += [element("line", x1=0, x2=width, y1=down(x), y2=down(x), class_="limit") for x in bounds]
    if curve.mark is not None:
        parts.append(element("line", x1=curve.mark, x2=curve.mark, y1=0, y2=HEIGHT, class_="mark-at"))
    parts += [
        element("polyline", points=points, class_=f"line c{number}")
        for number, values in enumerate(curve.lines)
        for points in _points(values, down)
    ]
    parts.append(element("line", x1=0, x2=0, y1=0, y2=HEIGHT, class_="cursor"))
    picture = element(
        "svg", parts, viewBox=f"0 0 {width:g} {HEIGHT:g}", preserveAspectRatio="none", class_="course", role="img",
        aria_label=f"{curve.name} over the episode",
    )  # fmt: skip
    ends = [
        element("span", text or "\u00a0", class_=place)
        for place, text in (("high", "" if still else value_text(curve, high)), ("low", value_text(curve, low + still)))
    ]
    values = [[value_text(curve, float(value)) for value in line] for line in curve.lines]
    return element(
        "div", [*ends, picture, element("output", "\u00a0")], class_="course-chart", data_values=json.dumps(values)
    )  # fmt: skip


def value_text(curve: Curve, value: float) -> str:
    """Return a value of a curve in the unit for people; empty: no value."""
    if not math.isfinite(value):
        return ""
    return shown(curve.measure, value) if curve.measure else f"{0.0 if abs(value) < STILL else value:.3g}"


def _points(values: npt.NDArray[np.float64], down: Callable[[float], float]) -> list[str]:
    """Return the points of the parts of a line between ticks without a value."""
    there = np.isfinite(values)
    runs = _runs(there)
    return [" ".join(f"{t},{down(float(values[t])):.1f}" for t in range(a, b)) for a, b in runs]


def _runs(flags: npt.NDArray[np.bool_] | None) -> list[tuple[int, int]]:
    """Return first tick, and tick after the last one, of each run of true flags."""
    if flags is None:
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
