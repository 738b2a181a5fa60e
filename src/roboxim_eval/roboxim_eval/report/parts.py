"""Parts that pages share: failures, maps, films, breakdowns. Each returns the values for its macro."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from roboxim_eval.grouping import grouped
from roboxim_eval.report.charts.table_map import Place, Start, table_maps
from roboxim_eval.report.episodes import Episode, any_of, episodes_link, level_links
from roboxim_eval.report.films import Film
from roboxim_eval.report.reasons import UNNAMED, explained
from roboxim_eval.statistics.factors import NOT_DRAWN, factor_effects, level_order
from roboxim_eval.statistics.rates import success_rate

TASK = "task"
"""The factor for the tasks of a mix or a suite; its table comes first."""
INSTRUCTION = "instruction"
"""The factor that every episode has, recorded or not."""


def failure_rows(episodes: Sequence[Episode], **query: object) -> list[dict[str, Any]]:
    """Return the reasons of episodes that did not succeed, most frequent first, each with its meaning and link."""
    counts = Counter(e.reason or UNNAMED for e in episodes if not e.success)
    return [
        {
            "reason": reason, "count": count, "meaning": explained(reason),
            "link": episodes_link(**query, reason=reason, outcome="failure|error"),
        }
        for reason, count in counts.most_common()
    ]  # fmt: skip


def map_view(episodes: Sequence[Episode], arms: Sequence[str], place: Place | None = None) -> dict[str, Any] | None:
    """Return a map of the table for each arm; None: no start is known.

    Args:
        episodes: All episodes of the page.
        arms: The arms that have a map.
        place: Where robot and table are; none: unknown.
    """
    starts = {
        arm: [
            Start(x=e.start[0], y=e.start[1], success=e.success, number=number)
            for number, e in enumerate(episodes)
            if e.arm == arm and e.start
        ]
        for arm in arms
    }
    known = {arm: arm_starts for arm, arm_starts in starts.items() if arm_starts}
    return table_maps(known, place) if known else None


def scene_patterns(episodes: Sequence[Episode], arms: Sequence[str]) -> list[tuple[str, int, str]]:
    """Return the patterns of outcomes in scenes that all arms met, in words, with the number of scenes and the link.

    Args:
        episodes: All episodes of the page; their place is their number.
        arms: The arms; with more than three, only "all", "some" and "none" are distinguished.
    """
    met: dict[tuple[int, str, str], dict[str, int]] = {}
    for number, e in enumerate(episodes):
        met.setdefault(e.scene_key, {})[e.arm] = number
    found: dict[str, list[int]] = {}
    for scene in met.values():
        if len(arms) > 1 and all(arm in scene for arm in arms):
            solved = [arm for arm in arms if episodes[scene[arm]].success]
            found.setdefault(_who_succeeded(solved, arms), []).extend(scene[arm] for arm in arms)
    order = {"all succeeded": 0, "both succeeded": 0, "neither succeeded": 2, "none succeeded": 2}
    return [
        (text, len(numbers) // len(arms), episodes_link(n=any_of(numbers)))
        for text, numbers in sorted(found.items(), key=lambda item: (order.get(item[0], 1), -len(item[1])))
    ]


def _who_succeeded(solved: Sequence[str], arms: Sequence[str]) -> str:
    if len(solved) in (0, len(arms)):
        words = ("neither", "both") if len(arms) == 2 else ("none", "all")
        return f"{words[bool(solved)]} succeeded"
    return f"only {' and '.join(solved)} succeeded" if len(arms) <= 3 else "some succeeded"


def film_groups(
    episodes: Sequence[Episode], films: Mapping[int, Film], arms: Sequence[str]
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the films by scene, side by side for each scene: the first of each pattern of outcomes, then the second.

    So a rare failure is not listed after many similar scenes. In each round, scenes with different outcomes come first,
    then unsolved ones.

    Args:
        episodes: All episodes of the page.
        films: Number of an episode to its film.
        arms: The arms, in the order in which they are shown.
    """
    scenes: dict[tuple[int, str, str], list[int]] = {}
    for number in sorted(films, key=lambda number: arms.index(episodes[number].arm)):
        scenes.setdefault(episodes[number].scene_key, []).append(number)
    groups: list[dict[str, Any]] = [
        {
            "instruction": episodes[numbers[0]].instruction,
            "name": ", ".join(filter(None, (episodes[numbers[0]].cell, f"scene {episodes[numbers[0]].scene}"))),
            "films": [{"number": n, "film": films[n], "episode": episodes[n]} for n in numbers],
        }
        for numbers in scenes.values()
    ]
    alike: Counter[tuple[bool, ...]] = Counter()
    order = []
    for group in groups:
        won = tuple(one["episode"].success for one in group["films"])
        order.append((alike[won], len(set(won)) < 2, sum(won) / len(won)))
        alike[won] += 1
    return [groups[index] for index in sorted(range(len(groups)), key=order.__getitem__)]


def films_shown(episodes: Sequence[Episode], films: Mapping[int, Film]) -> str:
    """Return the number of shown films and of all films, in words."""
    failed = [number for number, e in enumerate(episodes) if not e.success]
    solved = len(episodes) - len(failed)
    if len(films) == len(episodes) == 1:
        return f"The only episode is shown: it {'succeeded' if solved else 'did not succeed'}."
    if len(films) == len(episodes):
        return f"All {len(episodes)} episodes are shown: {len(failed)} that did not succeed, {solved} that did."
    shown_failed = sum(number in films for number in failed)
    return (
        f"{len(films)} of {len(episodes)} episodes are shown: {shown_failed} of {len(failed)} that did not succeed, "
        f"{len(films) - shown_failed} of {solved} that did, spread evenly over the run. The others are in the bags."
    )


def breakdowns(
    episodes: Sequence[Episode], arms: Sequence[str], *, without: Collection[str] = ()
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the success of each arm by each recorded factor and by instruction; arms are never pooled.

    Factors that divide the episodes in the same way share a table. The p value of a factor is that of the permutation
    test within arm, training and cell; none if the factor belongs to the design.

    Args:
        episodes: Episodes of the arms.
        arms: The arms, in the order of the columns.
        without: Factors that the page shows elsewhere.
    """
    trials = {number: trial for number, e in enumerate(episodes) if (trial := e.trial).drawn}
    p_values = {effect.factor: effect.adjusted for effect in factor_effects(list(trials.values()))}
    drawn = {name for e in episodes for name in e.drawn}
    names = [*sorted(drawn - set(p_values), key=lambda name: (name != TASK, name)), *p_values, INSTRUCTION]
    names = [name for name in names if name not in without]
    tables: dict[tuple[frozenset[int], ...], dict[str, Any]] = {}
    for name in names:
        table = _breakdown(episodes, arms, name)
        parts = tuple(sorted((frozenset(level["numbers"]) for level in table["levels"]), key=min))
        if len(parts) < 2:
            continue
        if parts in tables:
            tables[parts]["also"].append(table["name"])
        else:
            tables[parts] = table | {"p": p_values.get(name)}
    return list(tables.values())


def by_task(tables: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the first of the breakdowns is by task."""
    return bool(tables) and tables[0]["name"] == TASK


def _breakdown(episodes: Sequence[Episode], arms: Sequence[str], name: str) -> dict[str, Any]:
    """Return the levels of a factor, with the rate of each arm and its link; none: the arm did not meet the level."""
    if name == INSTRUCTION:
        values = {str(n): e.instruction for n, e in enumerate(episodes) if e.instruction}
        levels = dict(values)
    else:
        values = {str(n): e.drawn[name] for n, e in enumerate(episodes) if name in e.drawn}
        levels = grouped(values)
        if levels:
            levels |= {str(n): NOT_DRAWN for n, e in enumerate(episodes) if e.drawn and name not in e.drawn}
    members: dict[str, list[int]] = {}
    for number, level in levels.items():
        members.setdefault(level, []).append(int(number))
    rows = []
    for level in sorted(members, key=level_order):
        by_arm = {arm: [n for n in members[level] if episodes[n].arm == arm] for arm in arms}
        rows.append({
            "level": level, "numbers": members[level],
            "cells": [_cell(episodes, name, level, values, by_arm[arm], arm) for arm in arms],
        })  # fmt: skip
    return {"name": factor_name(name), "also": [], "levels": rows}


def _cell(
    episodes: Sequence[Episode], name: str, level: str, values: Mapping[str, str], numbers: Sequence[int], arm: str
) -> dict[str, Any] | None:  # fmt: skip
    if not numbers:
        return None
    rate = success_rate(sum(episodes[n].success for n in numbers), len(numbers))
    links = level_links(name, values, episodes_link, arm=arm)
    return {"rate": rate, "link": links.get(level) or episodes_link(arm=arm, **{name: NOT_DRAWN})}


def factor_name(name: str) -> str:
    """Return a recorded factor's name for people."""
    return name.replace("_", " ").replace(".", ", ")
