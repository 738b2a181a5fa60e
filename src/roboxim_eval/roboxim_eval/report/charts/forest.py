"""Forest plots: estimates with their intervals below one another, on one scale.

Positions are in percent of the width, so that rows fit a phone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from roboxim_eval.report.charts.svg import element
from roboxim_eval.statistics.rates import SuccessRate

HEIGHT = 24.0
MARGIN = 2.0
"""Space at both ends of the scale [% of the width]."""


@dataclass(frozen=True, kw_only=True)
class ForestRow:
    """An estimate."""

    label: str
    """Name of the estimated quantity."""
    value: float
    """The estimate."""
    low: float
    """Lower bound of its interval; -inf: unbounded."""
    high: float
    """Upper bound; inf: unbounded."""
    dots: tuple[float, ...] = ()
    """Estimates of the single replicates."""
    published: float | None = None
    """A published value of the same quantity; none: not published."""
    number: str = ""
    """Counts behind it, e.g. ``51 of 60 against 40 of 60``."""
    kind: str = "cell"
    """``cell``, ``unseen`` (a held-out cell) or ``total``."""
    link: str = ""
    """Link; empty: none."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """A scale of values."""

    low: float
    """Left end."""
    high: float
    """Right end."""
    ticks: tuple[float, ...]
    """Marked values."""
    zero: float | None = None
    """Value with an emphasised line; none: no such line."""

    def at(self, value: float) -> float:
        """Return the position of a value [% of the width]; values outside are at the ends."""
        inside = min(max(value, self.low), self.high)
        return MARGIN + (100 - 2 * MARGIN) * (inside - self.low) / (self.high - self.low)


RATES = Scale(low=0.0, high=1.0, ticks=(0.0, 0.25, 0.5, 0.75, 1.0))


def ratio_scale(rows: Sequence[ForestRow]) -> Scale:
    """Return a scale of ratios from 0 that holds 1 and all finite bounds and values."""
    ends = [x for row in rows for x in (row.value, row.low, row.high, row.published or 0.0) if math.isfinite(x)]
    steps = math.ceil(2 * max(1.0, *ends)) if ends else 2
    return Scale(low=0.0, high=steps / 2, ticks=tuple(i / 2 for i in range(steps + 1)), zero=1.0)


def difference_scale(rows: Sequence[ForestRow]) -> Scale:
    """Return a symmetric scale of differences that holds all finite bounds and dots."""
    ends = [x for row in rows for x in (row.value, row.low, row.high, *row.dots) if math.isfinite(x)]
    reach = min(1.0, max(0.2, math.ceil(10 * max(map(abs, ends), default=0.2)) / 10))
    return Scale(low=-reach, high=reach, ticks=(-reach, -reach / 2, 0.0, reach / 2, reach), zero=0.0)


def forest_bar(row: ForestRow, scale: Scale) -> Markup:
    """Return a row's picture: the interval as a line, the estimate as a mark, replicates as dots."""
    middle = HEIGHT / 2
    parts = [
        element(
            "line", x1=_at(scale, t), x2=_at(scale, t), y1=0, y2=HEIGHT, class_="zero" if t == scale.zero else "tick"
        )
        for t in scale.ticks
    ]
    if scale.zero is not None and scale.zero not in scale.ticks:
        parts.append(
            element("line", x1=_at(scale, scale.zero), x2=_at(scale, scale.zero), y1=0, y2=HEIGHT, class_="zero")
        )
    parts.append(
        element(
            "line", x1=_at(scale, row.low), x2=_at(scale, row.high), y1=middle, y2=middle, class_=f"reach {row.kind}"
        )
    )
    parts += [element("circle", cx=_at(scale, dot), cy=middle, r=2.6, class_="dot") for dot in row.dots]
    if row.published is not None:
        box = element("rect", x=-5, y=-5, width=10, height=10, class_="published")
        parts.append(element("svg", [box], x=_at(scale, row.published), y=middle, overflow="visible"))
    size = 5.0 if row.kind == "total" else 4.0
    square = element(
        "rect", x=-size, y=-size, width=2 * size, height=2 * size, class_=f"mark {row.kind}", transform="rotate(45)"
    )  # fmt: skip
    mark = element("svg", [square], x=_at(scale, row.value), y=middle, overflow="visible")
    label = f"{row.label}: {100 * row.value:.0f} ({_end(row.low)} to {_end(row.high)})"
    if row.published is not None:
        label += f", published {100 * row.published:.0f}"
    return element("svg", [*parts, mark], width="100%", height=HEIGHT, class_="bar", role="img", aria_label=label)


def rate_bar(rate: SuccessRate) -> Markup:
    """Return the picture of a success rate with its interval, from 0 to 100 %."""
    return forest_bar(ForestRow(label=str(rate), value=rate.rate, low=rate.low, high=rate.high), RATES)


def forest_axis(scale: Scale, *, signed: bool) -> Markup:
    """Return the axis above or below the rows.

    Args:
        scale: The scale.
        signed: Whether values are differences in points, not rates in percent.
    """
    parts = []
    for tick in scale.ticks:
        anchor = "start" if tick == scale.low else "end" if tick == scale.high else "middle"
        text = f"{round(100 * tick):+d}" if signed and tick else f"{round(100 * tick)}"
        place = 0.0 if anchor == "start" else 100.0 if anchor == "end" else scale.at(tick)
        parts.append(element("text", text, x=f"{place:.2f}%", y=13, text_anchor=anchor, class_="axis"))
    return element("svg", parts, width="100%", height=18, class_="bar", aria_hidden="true")


def _at(scale: Scale, value: float) -> str:
    return f"{scale.at(value):.2f}%"


def _end(value: float) -> str:
    return f"{100 * value:.0f}" if math.isfinite(value) else "unbounded"
