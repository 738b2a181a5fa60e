"""The episodes behind a page's numbers: one row each, for the page's script, which filters and lists them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_eval.grouping import grouped
from roboxim_eval.report.reasons import explained
from roboxim_eval.statistics.factors import Trial


@dataclass(frozen=True, kw_only=True)
class Episode:
    """An episode of a page."""

    arm: str
    """Policy, or condition of an experiment."""
    replicate: int = 0
    """Training of the condition, from 0."""
    cell: str = ""
    """Cell of an experiment; empty: none."""
    scene: str
    """Name of the scene within a replicate; policies that met the same scene share it."""
    outcome: str
    """``success``, ``failure`` or ``error``."""
    reason: str = ""
    """Why it did not succeed, in snake_case."""
    message: str = ""
    """Details for a person."""
    instruction: str = ""
    """The instruction."""
    steps: int = 0
    """Number of actions."""
    bag: str = ""
    """Path of its bag, from the folder of the page; empty: none."""
    start: tuple[float, float] | None = None
    """Where the first object of the task started, x away from the robot and y to its left [m]; none: unknown."""
    drawn: Mapping[str, str] = field(default_factory=dict)
    """Recorded factors."""

    explanation: str = ""
    """Description, a sentence with numbers; empty: unknown, or it succeeded."""
    page: str = ""
    """Path of its own page, from the folder of the page; empty: none."""

    @property
    def success(self) -> bool:
        """Whether it succeeded."""
        return self.outcome == "success"

    @property
    def scene_key(self) -> tuple[int, str, str]:
        """Key that episodes in the same scene share: training, cell and scene."""
        return self.replicate, self.cell, self.scene

    @property
    def trial(self) -> Trial:
        """The episode, in the form for the test of factors."""
        stratum = f"{self.arm}.{self.replicate} {self.cell}"
        return Trial(
            episode=f"{stratum}/{self.scene}", stratum=stratum, scene=f"{self.replicate} {self.cell}/{self.scene}",
            success=self.success, drawn=self.drawn,
        )  # fmt: skip


NOT_FACTORS = (CELL, CELL_NUMBER)
"""Recorded names that are the design, not drawn."""


def recorded_factors(drawn: Mapping[str, str], start: tuple[float, float] | None) -> dict[str, str]:
    """Return the factors whose effect a report shows: the recorded draws, and where the first object started.

    Args:
        drawn: Named draws of the reset components.
        start: Place of the first object, x away from the robot and y to its left [m]; none: unknown.
    """
    found = {name: value for name, value in drawn.items() if name not in NOT_FACTORS}
    if start is not None:
        found["start: distance from the robot [m]"] = f"{math.hypot(*start):.3f}"
        found["start: place to the left [m]"] = f"{start[1]:.3f}"
    return found


def episodes_link(**query: object) -> str:
    """Return the link that lists the episodes with these properties, e.g. ``arm="bc", outcome="failure"``."""
    given = {key: value for key, value in query.items() if value is not None and value != ""}
    return "#episodes?" + urlencode(given)


Link = Callable[..., str]
"""Properties of episodes, as of `episodes_link`, to the link that lists them; empty: no link."""


def no_link(**_: object) -> str:
    """Return no link, for pages without episodes."""
    return ""


def links_into(page: str) -> Link:
    """Return links to the episodes that another page lists.

    Args:
        page: Its address, relative to the page with the links; empty: it does not exist.
    """
    return (lambda **query: page + episodes_link(**query)) if page else no_link


def any_of(values: Iterable[object]) -> str:
    """Return the value of a link's property that selects episodes with any of some values."""
    return "|".join(map(str, values))


def level_links(factor: str, values: Mapping[str, str], link: Link, **query: object) -> dict[str, str]:
    """Return the links of a factor's levels, of its thirds if it has many numbers (see `roboxim_eval.grouping`).

    Args:
        factor: The factor.
        values: Episode to its value.
        link: Makes the links.
        query: Further properties of the episodes.
    """
    members: dict[str, set[str]] = {}
    for episode, level in grouped(values).items():
        members.setdefault(level, set()).add(values[episode])
    return {level: link(**query, **{factor: _chosen(level, numbers)}) for level, numbers in members.items()}


def _chosen(level: str, values: Collection[str]) -> str:
    """Return a level, or the range from its smallest to its largest number, both included."""
    if set(values) == {level}:
        return level
    return f"from {min(values, key=float)} to {max(values, key=float)}"


def checkpoint_arm(condition: str, steps: int) -> str:
    """Return the arm of a learning curve's episodes, which count in no other number of a page."""
    return f"{condition}@{steps}"


class _Table:
    """Texts that are stored once and named by their number."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}

    def __call__(self, text: str) -> int:
        return self.numbers.setdefault(text, len(self.numbers))


def episodes_json(episodes: Sequence[Episode], films: Iterable[int] = ()) -> Markup:
    """Return the episodes as JSON for the page's script; repeated texts are stored once.

    Args:
        episodes: The episodes; their place is their number.
        films: Numbers of the episodes with a film on the page.
    """
    texts, shown = _Table(), set(films)
    rows = [
        [
            texts(e.arm), e.replicate, texts(e.cell), texts(e.scene), texts(e.outcome), texts(e.reason),
            texts(e.instruction), e.steps, e.bag, e.message, int(number in shown),
            [x for name, value in sorted(e.drawn.items()) for x in (texts(name), texts(value))], e.explanation, e.page,
        ]
        for number, e in enumerate(episodes)
    ]  # fmt: skip
    data: dict[str, Any] = {
        "texts": list(texts.numbers),
        "rows": rows,
        "reasons": {reason: explained(reason) for reason in sorted({e.reason for e in episodes if e.reason})},
    }
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))  # a text must not end the script element
