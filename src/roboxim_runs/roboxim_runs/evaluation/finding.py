"""Finds one episode: a bag, or a run's or evaluation's folder and a number; and others' episodes in its scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, counted, one_of
from roboxim_core.plain_data.results_log import RESULTS_FILE
from roboxim_core.plain_data.shell import shell_line
from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.run_bags import read_results
from roboxim_runs.episodes.showing import Other
from roboxim_runs.evaluation.report import RECORD_FILE, inside, stored_record
from roboxim_runs.evaluation.shown import MAX_OTHERS

EXPERIMENT_FILE = "experiment.json"


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
    if (place / EXPERIMENT_FILE).exists():
        raise ConfigError(_of_an_experiment(place, number))
    if number is not None:
        raise ConfigError(f"{place} has no {RESULTS_FILE}, so it is not a run with an episode {number}")
    if place.is_dir() and not any(place.glob("*.mcap")) and not any(place.glob("*.db3")):
        raise ConfigError(f"{place} is neither a bag nor the folder of a run or an evaluation{inside(place)}")
    bag = mcap_file(place)
    return _with_evaluation(
        bag if place.is_file() and bag.parent.name != BagReader(bag).info.episode_id else bag.parent
    )


def _of_an_experiment(place: Path, number: int | None) -> str:
    folders = sorted(file.parent for file in place.glob(f"evaluate/*/{RECORD_FILE}"))
    if not folders:
        return f"{place} is an experiment without evaluations yet; run it first"
    names = ", ".join(folder.name for folder in folders[:8]) + (", ..." if len(folders) > 8 else "")
    return (
        f"{place} is an experiment with {counted(len(folders), 'evaluation')} ({names}); name one, e.g. "
        + shell_line("roboxim", "show", folders[0], number or 0)
    )


def _with_evaluation(bag: Path) -> FoundEpisode:
    run = bag.resolve().parent.parent
    if (run.parent / RECORD_FILE).exists():
        return in_evaluation(bag, run.parent, run.name)
    return FoundEpisode(bag=bag)


def in_evaluation(bag: Path, evaluation: Path, policy: str) -> FoundEpisode:
    """Return an episode of an evaluation, with those of others in the same scene, the expert first.

    Others are its other policies, and in an experiment the other conditions with the same number of training.

    Raises:
        ConfigError: When the evaluation's files are damaged.
    """
    info = BagReader(bag).info
    runs = {name: evaluation / name for name in stored_record(evaluation).policies if name != policy}
    runs |= {run.name: run for run in _other_conditions(evaluation)}
    found = []
    for name, run in runs.items():
        if (run / RESULTS_FILE).exists():
            bags = (run / result.bag for result in read_results(run) if result.index == info.index and result.bag)
            found += [Other(name=name, bag=one) for one in bags if one.exists() and _same_scene(one, info)]
    found.sort(key=lambda one: not BagReader(one.bag).info.actor_privileged)
    return FoundEpisode(bag=bag, policy=policy, others=tuple(found[:MAX_OTHERS]))


def _same_scene(bag: Path, info: EpisodeInfo) -> bool:
    """Tell whether an episode had the same objects in the same places: experiments may test other cells."""
    scene = BagReader(bag).info.scene
    return (scene.entities, scene.robot) == (info.scene.entities, info.scene.robot)


def _other_conditions(evaluation: Path) -> list[Path]:
    """Return the runs of an experiment's other conditions, of the same training; empty: it is in no experiment."""
    stages = evaluation.resolve().parent
    if stages.name != "evaluate" or not (stages.parent / EXPERIMENT_FILE).exists():
        return []
    training = evaluation.resolve().name.rpartition(".")[2]
    others = (folder for folder in sorted(stages.iterdir()) if folder.name != evaluation.resolve().name)
    return [
        folder / condition
        for folder in others
        for condition, _, replicate in [folder.name.rpartition(".")]
        if replicate == training and "@" not in condition
    ]


def _bag_of(run: Path, number: int | None) -> Path:
    results = read_results(run)
    if number is None:
        raise ConfigError(
            f"{run} has {counted(len(results), 'episode')}; say which one, e.g. "
            + shell_line("roboxim", "show", run, _example(results))
        )
    matching = [result for result in results if result.index == number]
    if not matching:
        there = ", ".join(map(str, sorted({result.index for result in results})[:12]))
        raise ConfigError(f"{run} has no episode {number}; it has {there}{', ...' if len(results) > 12 else ''}")
    bag = run / matching[-1].bag
    if not matching[-1].bag or not bag.exists():
        raise ConfigError(f"episode {number} of {run} has no bag here ({matching[-1].outcome} {matching[-1].reason})")
    return bag


def _example(results: list[EpisodeResult]) -> int:
    """Return the index of an episode that did not succeed, if there is one."""
    return next((r.index for r in results if r.outcome != "success"), results[0].index if results else 0)
