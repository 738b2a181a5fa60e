"""Parts that pages have in common: failures, maps, scenes, films, factors. Each is what its macro shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from roboxim_eval.report.charts.scenes import scene_chart, scene_rows
from roboxim_eval.report.charts.table_map import MOST_DOTS, Grid, Start, table_map
from roboxim_eval.report.episodes import Episode, any_of, episodes_link, level_links
from roboxim_eval.report.films import Film
from roboxim_eval.report.reasons import UNNAMED, explained
from roboxim_eval.statistics.factors import NOT_DRAWN, factor_effects


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


def map_view(episodes: Sequence[Episode], arms: Sequence[str]) -> dict[str, Any] | None:
    """Return a map of the table for each arm; None: no start is known."""
    starts = {
        arm: [
            Start(x=e.start[0], y=e.start[1], success=e.success, number=number)
            for number, e in enumerate(episodes)
            if e.arm == arm and e.start
        ]
        for arm in arms
    }
    known = {arm: mine for arm, mine in starts.items() if mine}
    if not known:
        return None
    grid = Grid.of([s for mine in known.values() for s in mine], max(map(len, known.values())))
    return {
        "pictures": {arm: table_map(mine, grid) for arm, mine in known.items()},
        "square_cm": 100 * grid.side,
        "dots": any(len(mine) <= MOST_DOTS for mine in known.values()),
    }


def scenes_view(episodes: Sequence[Episode], arms: Sequence[str]) -> dict[str, Any] | None:
    """Return the comparison scene by scene; None: no two arms met the same scene."""
    rows = scene_rows(list(enumerate(episodes)), arms)
    if not rows:
        return None
    patterns = [
        (outcomes, len(scenes), episodes_link(n=any_of(n for scene in scenes for n in scene if n is not None)))
        for outcomes, scenes in rows
    ]
    return {"arms": tuple(arms), "picture": scene_chart(rows, arms), "patterns": patterns}


def film_views(episodes: Sequence[Episode], films: Mapping[int, Film]) -> list[dict[str, Any]]:
    """Return the films with their episodes, failures first.

    Args:
        episodes: All episodes of the page.
        films: Number of an episode to its film.
    """
    shown = sorted(films, key=lambda number: (episodes[number].success, number))
    return [
        {"number": number, "film": films[number], "episode": episodes[number], "name": _name(episodes[number])}
        for number in shown
    ]


def _name(episode: Episode) -> str:
    where = f"{episode.arm}.{episode.replicate}, {episode.cell}" if episode.cell else episode.arm
    return f"{where}, scene {episode.scene}"


def films_shown(episodes: Sequence[Episode], films: Mapping[int, Film]) -> str:
    """Return how many of how many films are shown, in words."""
    failed = [number for number, e in enumerate(episodes) if not e.success]
    solved = len(episodes) - len(failed)
    if len(films) == len(episodes):
        return f"All {len(episodes)} episodes are shown: {len(failed)} that did not succeed, {solved} that did."
    shown_failed = sum(number in films for number in failed)
    return (
        f"{len(films)} of {len(episodes)} episodes are shown: {shown_failed} of {len(failed)} that did not succeed, "
        f"{len(films) - shown_failed} of {solved} that did, spread evenly over the run. The others are in the bags."
    )


def effects_view(episodes: Sequence[Episode], **query: object) -> list[dict[str, Any]]:
    """Return the effects of the recorded factors and of the start position, with a link for each level.

    Args:
        episodes: The episodes of a page, or some of them.
        query: Properties that these have and the others have not, see `episodes_link`.
    """
    trials = [trial for e in episodes if (trial := e.trial).drawn]
    found = []
    for effect in factor_effects(trials):
        name = effect.factor
        values = {trial.episode: trial.drawn[name] for trial in trials if name in trial.drawn}
        links = level_links(name, values, episodes_link, **query)
        links[NOT_DRAWN] = episodes_link(**query, **{name: NOT_DRAWN})
        found.append({
            "name": factor_name(name), "p": effect.adjusted,
            "levels": [(level, rate, links[level]) for level, rate in effect.levels.items()],
        })  # fmt: skip
    return found


def factor_name(name: str) -> str:
    """Return a recorded factor's name for people."""
    return name.replace("_", " ").replace(".", ", ")
