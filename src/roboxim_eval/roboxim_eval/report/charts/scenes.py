"""Policies compared scene by scene: a column for each scene, a row for each policy.

Scenes with the same outcomes are side by side.
"""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from roboxim_eval.report.charts.svg import drawing, element
from roboxim_eval.report.episodes import Episode

SIZE, GAP = 9.0, 2.0
PER_LINE = 60
"""Scenes in a line."""


def scene_rows(
    episodes: Sequence[tuple[int, Episode]], arms: Sequence[str]
) -> list[tuple[tuple[str, ...], list[tuple[int | None, ...]]]]:
    """Return the scenes that at least two arms met, by pattern of outcomes.

    Args:
        episodes: Number on the page, and episode.
        arms: The arms, in the order of the rows.

    Returns:
        For each pattern its outcomes by arm (empty: not met), and its scenes: a number of an episode for each arm.
    """
    scenes: dict[tuple[int, str, str], dict[str, tuple[int, str]]] = {}
    for number, e in episodes:
        scenes.setdefault((e.replicate, e.cell, e.scene), {})[e.arm] = (number, e.outcome)
    patterns: dict[tuple[str, ...], list[tuple[int | None, ...]]] = {}
    for met in scenes.values():
        if len(met) > 1:
            outcomes = tuple(met[arm][1] if arm in met else "" for arm in arms)
            patterns.setdefault(outcomes, []).append(tuple(met[arm][0] if arm in met else None for arm in arms))
    order = {"success": 0, "failure": 1, "error": 2, "": 3}
    return sorted(patterns.items(), key=lambda item: [order.get(outcome, 3) for outcome in item[0]])


def scene_chart(
    rows: Sequence[tuple[tuple[str, ...], Sequence[tuple[int | None, ...]]]], arms: Sequence[str]
) -> Markup:
    """Return the picture; each square leads to its episode.

    Args:
        rows: See `scene_rows`.
        arms: The arms, in the order of the rows.
    """
    columns = [(outcomes, scene) for outcomes, scenes in rows for scene in scenes]
    lines = [columns[i : i + PER_LINE] for i in range(0, len(columns), PER_LINE)]
    step = SIZE + GAP
    block = len(arms) * step + 10
    parts = []
    for line, shown in enumerate(lines):
        for place, (outcomes, scene) in enumerate(shown):
            for row, (outcome, number) in enumerate(zip(outcomes, scene, strict=True)):
                if number is not None:
                    parts.append(
                        element("rect", x=place * step, y=line * block + row * step, width=SIZE, height=SIZE, rx=1.5,
                                class_=f"scene {outcome}", data_e=number)
                    )  # fmt: skip
    width = min(len(columns), PER_LINE) * step
    return drawing(
        parts, width=width, height=len(lines) * block, label="Outcomes scene by scene", class_="chart scenes"
    )
