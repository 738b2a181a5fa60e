"""Finds one episode: a bag, or a run's or evaluation's folder and a number; and others' episodes in its scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, one_of
from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.run_bags import read_results
from roboxim_runs.episodes.showing import Other
from roboxim_runs.evaluation.report import RECORD_FILE, inside, stored_record
from roboxim_runs.evaluation.shown import MOST_OTHERS

RESULTS_FILE = "results.jsonl"


@dataclass(frozen=True, kw_only=True)
class FoundEpisode:
    """An episode and its surroundings."""

    bag: Path
    """Its bag."""
    policy: str = ""
    """Name of its policy in the evaluation; empty: it is in none."""
    others: tuple[Other, ...] = ()
    """Episodes of other policies in its scene."""


def find_episode(place: Path, number: int | None = None, policy: str = "") -> FoundEpisode:
    """Return an episode and those of other policies in its scene.

    Args:
        place: Its bag, or the folder of a run or of an evaluation.
        number: Its index, with a folder only.
        policy: Policy of the evaluation; empty: the one under test.

    Raises:
        ConfigError: When it is not there, saying what is.
    """
    record = place / RECORD_FILE
    if record.exists():
        names = stored_record(place).policies
        if policy and policy not in names:
            raise ConfigError(f"no policy '{policy}' in {place}; {one_of(names, policy)}")
        return in_evaluation(_bag_of(place / (policy or names[0]), number), place, policy or names[0])
    if policy:
        raise ConfigError(f"{place} is not an evaluation's folder (it has no {RECORD_FILE}), so it has no --policy")
    if (place / RESULTS_FILE).exists():
        return _with_evaluation(_bag_of(place, number))
    if number is not None:
        raise ConfigError(f"{place} has no {RESULTS_FILE}, so it is no run whose episode {number} could be shown")
    if place.is_dir() and not any(place.glob("*.mcap")) and not any(place.glob("*.db3")):
        raise ConfigError(f"{place} is neither a bag nor the folder of a run or an evaluation{inside(place)}")
    bag = mcap_file(place)
    return _with_evaluation(
        bag if place.is_file() and bag.parent.name != BagReader(bag).info.episode_id else bag.parent
    )


def _with_evaluation(bag: Path) -> FoundEpisode:
    run = bag.resolve().parent.parent
    if (run.parent / RECORD_FILE).exists():
        return in_evaluation(bag, run.parent, run.name)
    return FoundEpisode(bag=bag)


def in_evaluation(bag: Path, evaluation: Path, policy: str) -> FoundEpisode:
    """Return an episode of an evaluation, with those of its other policies in the same scene, the expert first.

    Raises:
        ConfigError: When the evaluation's files are damaged.
    """
    index = BagReader(bag).info.index
    found = []
    for name in stored_record(evaluation).policies:
        run = evaluation / name
        if name != policy and (run / RESULTS_FILE).exists():
            bags = (run / result.bag for result in read_results(run) if result.index == index and result.bag)
            found += [Other(name=name, bag=one) for one in bags if one.exists()]
    found.sort(key=lambda one: not BagReader(one.bag).info.actor_privileged)
    return FoundEpisode(bag=bag, policy=policy, others=tuple(found[:MOST_OTHERS]))


def _bag_of(run: Path, number: int | None) -> Path:
    results = read_results(run)
    if number is None:
        raise ConfigError(
            f"{run} has {len(results)} episodes; say which one, e.g. roboxim show {run} {_example(results)}"
        )
    mine = [result for result in results if result.index == number]
    if not mine:
        there = ", ".join(str(result.index) for result in results[:12])
        raise ConfigError(f"{run} has no episode {number}; it has {there}{', ...' if len(results) > 12 else ''}")
    bag = run / mine[-1].bag
    if not mine[-1].bag or not bag.exists():
        raise ConfigError(f"episode {number} of {run} has no bag here ({mine[-1].outcome} {mine[-1].reason})")
    return bag


def _example(results: list[EpisodeResult]) -> int:
    """Return the index of an episode that did not succeed, if there is one."""
    return next((r.index for r in results if r.outcome != "success"), results[0].index if results else 0)
