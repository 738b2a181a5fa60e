"""Policies as a report shows them: facts from their bags, films of some scenes, and a page for each of those episodes.

The report is imported where it is needed: the import takes seconds.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_core.whole_files import write_whole
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.evaluation.results import PolicyResult
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.store import readable_run

if TYPE_CHECKING:
    from roboxim_eval.report import PolicyRun
    from roboxim_eval.report.charts.table_map import Place
    from roboxim_runs.episodes.facts import EpisodeFacts

PAGES = "pages"
"""Folder beside a report with the pages of the episodes that it shows, in a folder for each policy."""
MAX_OTHERS = 2
"""Largest number of episodes of others in an episode's page."""


def with_bags(result: PolicyResult) -> list[EpisodeResult]:
    """Return the episodes whose bags are in the folder or in its store; an unpacked run has none."""
    recorded = [episode for episode in result.results if episode.bag]
    gone = {episode.bag for episode in RunFolder(result.folder).without_bag(recorded)}
    return [episode for episode in recorded if episode.bag not in gone]


def shown_runs(
    found: Mapping[str, PolicyResult], out: Path, *, film: FilmOptions, trained: Collection[str],
    by_scene: bool = False,
) -> tuple[list[PolicyRun], Place | None]:  # fmt: skip
    """Return the policies, and where robot and table are; write the pages of the shown episodes.

    Args:
        found: Policy to result.
        out: The report's folder.
        film: Which films are shown.
        trained: Policies that are checkpoints of a training.
        by_scene: Whether scenes are identified by what they hold, as policies of several runs need; else by index.

    Raises:
        ConfigError: When stored facts are damaged, or a scene whose film is asked for is not recorded.
        RecorderError: With code ``BAG_DAMAGED`` when a bag is not whole.
    """
    from roboxim_eval.report.films import chosen_scenes
    from roboxim_runs.episodes.facts import episode_facts
    from roboxim_runs.episodes.showing import forget_episodes

    with contextlib.ExitStack() as stack:
        stack.callback(forget_episodes)
        whole = {name: with_bags(result) for name, result in found.items()}
        bags = {
            name: stack.enter_context(readable_run(found[name].folder, [episode.bag for episode in episodes]))
            for name, episodes in whole.items()
        }
        facts = {name: episode_facts(result.folder, result.results, bags=bags[name]) for name, result in found.items()}
        scenes = _scenes(found, facts, by_scene=by_scene)
        outcomes: dict[str, list[str]] = {}
        for name, episodes in whole.items():
            for episode in episodes:
                outcomes.setdefault(scenes[name][episode.episode_id], []).append(episode.outcome)
        if missing := set(film.only) - set(outcomes):
            raise ConfigError(f"no episode of scene {', '.join(sorted(missing))} is recorded, so there is no film")
        longest = max(map(len, outcomes.values()), default=0)
        by_all = {scene: met for scene, met in outcomes.items() if len(met) == longest}
        chosen = set(film.only or chosen_scenes(by_all, film.scenes))
        shown = {
            name: {scenes[name][e.episode_id]: bags[name] / e.bag for e in episodes
                   if scenes[name][e.episode_id] in chosen}
            for name, episodes in whole.items()
        }  # fmt: skip
        runs = [
            _run(result, facts[name], scenes[name], shown, out, film=film, trained=name in trained, name=name)
            for name, result in found.items()
        ]
    return runs, place_of(fact for policy_facts in facts.values() for fact in policy_facts.values())


def place_of(facts: Iterable[EpisodeFacts]) -> Place | None:
    """Return where the table is, seen from the robot; None: unknown, or not the same in all episodes."""
    from roboxim_eval.report.charts.table_map import Place

    places = {Place(table=one.table_from_robot) for one in facts if one.scene}
    return places.pop() if len(places) == 1 else None


def _scenes(
    found: Mapping[str, PolicyResult], facts: Mapping[str, Mapping[str, EpisodeFacts]], *, by_scene: bool
) -> dict[str, dict[str, str]]:
    """Return the name of each episode's scene: its index, or where runs differ the index and the policy that met it."""
    if not by_scene:
        return {name: {e.episode_id: str(e.index) for e in result.results} for name, result in found.items()}
    names: dict[str, str] = {}
    taken: set[str] = set()
    scenes: dict[str, dict[str, str]] = {}
    for name, result in found.items():
        keys = scenes[name] = {}
        times: Counter[str] = Counter()
        for episode in result.results:
            known = facts[name].get(episode.episode_id)
            scene = known.scene if known is not None and known.scene else f"{name} {episode.episode_id}"
            times[scene] += 1
            met = f"{scene} {times[scene]}"  # a task may draw one scene more than once
            if met not in names:
                plain = str(episode.index)
                names[met] = plain if plain not in taken else f"{plain} of {name}"
                taken.add(names[met])
            keys[episode.episode_id] = names[met]
    return scenes


def _run(
    result: PolicyResult, facts: Mapping[str, EpisodeFacts], scenes: Mapping[str, str],
    shown: Mapping[str, Mapping[str, Path]], out: Path, *, film: FilmOptions, trained: bool, name: str,
) -> PolicyRun:  # fmt: skip
    """Return a policy with its films, and write the pages of its shown episodes.

    Args:
        result: The policy's results.
        facts: What its bags say.
        scenes: Episode id to scene.
        shown: Policy to scene and bag of the shown episodes.
        out: The report's folder.
        film: How films are shown.
        trained: Whether it is a checkpoint of a training.
        name: Its name in the report.
    """
    from roboxim_eval.report import PolicyRun
    from roboxim_runs.episodes.showing import films_of

    films, pages = {}, {}
    for old in (out / PAGES / _folder(name)).glob("*.html"):  # of a report that showed other scenes
        old.unlink()
    for episode in result.results:
        scene = scenes[episode.episode_id]
        bag = shown[name].get(scene)
        if bag is None:
            continue
        if both := films_of(bag, film):
            films[episode.episode_id] = both[0]
        others = {other: bags[scene] for other, bags in shown.items() if other != name and scene in bags}
        pages[episode.episode_id] = write_episode_page(
            bag, out, run=result.folder, name=name, others=others, film=film, shown_as=result.folder / episode.bag,
        )  # fmt: skip
    return PolicyRun(
        policy=name, results=result.results, folder=Path(os.path.relpath(result.folder, out)).as_posix(), films=films,
        pages=pages, trained=trained, scenes=scenes,
        drawn={key: one.drawn for key, one in facts.items()},
        starts={key: start for key, one in facts.items() if (start := one.start_from_robot) is not None},
        explanation={key: one.explanation for key, one in facts.items() if one.explanation},
    )  # fmt: skip


def write_episode_page(
    bag: Path, out: Path, *, run: Path, name: str, others: Mapping[str, Path], film: FilmOptions, shown_as: Path,
) -> str:  # fmt: skip
    """Write the page that explains an episode of a report, and return its path from the report's folder.

    Args:
        bag: The episode's bag.
        out: The report's folder.
        run: The episode's run, with the logs.
        name: Policy or condition, as the report names it.
        others: Further ones to their bags of the same scene; their pages are linked.
        film: How the report shows films.
        shown_as: The bag, as commands of the page name it.

    Raises:
        ConfigError: When the path is not a bag.
        RecorderError: With code ``BAG_DAMAGED``.
    """
    from roboxim_eval.report.episode import episode_page
    from roboxim_runs.episodes.showing import Other, shown_episode

    there = [Other(name=other, bag=one, link=f"../{_folder(other)}/{one.name}.html") for other, one in others.items()][
        :MAX_OTHERS
    ]
    page = shown_episode(bag, films=film, others=there, shown_as=os.path.relpath(shown_as, out), name=name, run=run)
    path = out / PAGES / _folder(name) / f"{bag.name}.html"
    write_whole(path, episode_page(page))
    return path.relative_to(out).as_posix()


def _folder(name: str) -> str:
    """Return the folder of a policy's pages: names of compared runs have a colon and a space."""
    return name.replace(": ", ".").replace("/", ".")
