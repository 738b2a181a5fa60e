"""Joins the shards of runs: many folders of one configuration become the folder that a single run would have made.

A merge checks everything first and then puts all in place, or nothing. A new output folder appears with one rename. In
an existing one, each run gets its bags first, and then its results with one rename. A bag without a result does not
count, so the same command repeats a killed merge.
"""

from __future__ import annotations

import functools
import itertools
import os
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, listed
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.results_log import RESULTS_FILE, RUN_FILE, line_of
from roboxim_core.whole_files import write_json, write_whole
from roboxim_recorder.bag_writer import PLACES, disk_errors
from roboxim_runs.episodes.generation import write_first_demonstrations
from roboxim_runs.evaluation.report import RECORD_FILE, REPORT_FILE, EvaluationRecord, report_of, stored_record
from roboxim_runs.events import OnEvent, Reporter, ReportProgress, ignore
from roboxim_runs.storage.folder import (
    MAY_DIFFER,
    RunFolder,
    checked_path,
    folders_with,
    locked,
    run_key,
)
from roboxim_runs.storage.store import file_sha256, note_stored, stored_bags
from roboxim_runs.storage.upload import RunUpload

DEEPEST = 3
"""Levels below a shard's folder at which runs are looked for."""
SHOWN = 5
"""Number of episodes that a message names; further ones are only counted."""
CLOCKED = ("wall_s", "inference_s")
"""Fields of a result that differ from machine to machine."""
OF_ALL_POLICIES = ("task", "seed", "stopped", "undecided")
"""Fields of an evaluation's record that all of its policies share."""
OF_THE_SCENES = ("task_config", "run_seed", "definitions")
"""Keys of a run's configuration on which its scenes depend."""


@dataclass(frozen=True, kw_only=True)
class MergedRun:
    """One run of a merge."""

    name: str
    """Path of its folder relative to the output folder; ``.`` for the folder itself."""
    episodes: int
    """Episodes that it has now."""
    shards: int
    """Number of folders that contained some of these episodes."""
    doubles: int
    """Number of episodes that several folders contained, with equal results and equal bags."""
    missing: tuple[int, ...]
    """Indices of the episodes that no folder has."""


def merge_shards(
    out: Path | str, shards: Sequence[Path | str], *, partial: bool = False, on_event: OnEvent = ignore
) -> list[MergedRun]:
    """Join the shards of one or several runs.

    Bags are linked where the file system allows it, otherwise copied; the shards stay unchanged. The report of an
    evaluation is written again; shards of different policies become one evaluation if their scenes are equal.

    Args:
        out: Folder of the merged run; may already hold a part of it.
        shards: The shards' folders.
        partial: Accept that episodes are missing; the run's command, without ``--shard``, runs them.
        on_event: Receives the merge's events.

    Returns:
        The merged runs, by name.

    Raises:
        ConfigError: When a folder holds no run, its runs are of another configuration or still running, evaluations
            are of different scenes, or episodes are missing.
        RecorderError: ``BAG_DAMAGED`` when a bag has vanished, or two folders have different recordings of an episode;
            ``DISK`` when the output cannot be written.
    """
    target = checked_path(out)
    sources = list(dict.fromkeys(checked_path(shard) for shard in shards))
    if target in sources:
        raise ConfigError(f"{target} is both a shard and the output folder; choose another output folder")
    merges = _planned(target, sources)
    if not partial:
        for merge in merges:
            merge.require_complete()
    total = sum(len(merge.chosen) for merge in merges)
    with Reporter(on_event).stage("merging", total, "episodes") as progress:
        _write(target, merges, sources, _records(target, sources), progress)
    return [merge.summary for merge in merges]


def _write(
    target: Path, merges: Sequence[_Merge], shards: Sequence[Path], records: Mapping[str, EvaluationRecord],
    progress: ReportProgress,
) -> None:  # fmt: skip
    """Write the merged runs and their reports."""
    new, done = not target.exists(), itertools.count(1)
    with _stage(target.with_name(f".{target.name}.merging") if new else target / ".merging") as stage:
        for merge in merges:
            for _ in merge.fill(stage / merge.name):
                progress(next(done))
            merge.decorate(stage / merge.name)
        if new:
            _write_reports(stage, records, shards)
            with disk_errors(target):
                stage.rename(target)
        else:
            with disk_errors(target):
                for merge in merges:
                    merge.put(stage / merge.name, target / merge.name)
            _write_reports(target, records, shards)
    for merge in merges:
        upload = RunUpload(target / merge.name, str(merge.config.get("store", "")))
        upload.require_own(merge.config)
        upload.all()


def _write_reports(folder: Path, records: Mapping[str, EvaluationRecord], shards: Sequence[Path]) -> None:
    """Write the evaluations' records, and pages where a shard has one; an experiment's evaluations have none."""
    for name, record in records.items():
        page = any((place / name / REPORT_FILE).exists() for place in (folder, *shards))
        report_of(folder / name, record, page=page)


# ------------------------------------------------------------------ the shards


def _planned(target: Path, shards: Sequence[Path]) -> list[_Merge]:
    groups: dict[str, list[RunFolder]] = {}
    for shard in shards:
        found = _runs_in(shard)
        if not found:
            raise ConfigError(f"{shard} holds no run: no {RUN_FILE} in it, nor {DEEPEST} levels below")
        for name, run in found.items():
            groups.setdefault(name, []).append(run)
    for name, runs in groups.items():
        if (target / name / RUN_FILE).exists():
            runs.insert(0, RunFolder(target / name))
        elif name == "." and target.exists() and any(not path.name.startswith(".") for path in target.iterdir()):
            raise ConfigError(f"{target} exists and is not a run's folder; choose another output folder")
    return [_Merge(name, groups[name]) for name in sorted(groups)]


def _runs_in(shard: Path) -> dict[str, RunFolder]:
    """Return the runs in a folder, by their path relative to it."""
    found = folders_with(RUN_FILE, shard, DEEPEST)
    return {str(folder.relative_to(shard)): RunFolder(folder) for folder in found}


def _records(target: Path, shards: Sequence[Path]) -> dict[str, EvaluationRecord]:
    """Return the evaluations' records, by the path of their folder relative to the shard, with the policies of all.

    Raises:
        ConfigError: When the records of a folder, or the runs of their policies, are of different scenes.
    """
    names = {str(file.relative_to(shard)) for shard in shards for file in folders_with(RECORD_FILE, shard, DEEPEST - 1)}
    records = {}
    for name in sorted(names):
        folders = [place / name for place in (target, *shards) if (place / name / RECORD_FILE).exists()]
        found = (stored_record(folder) for folder in folders)
        records[name] = functools.reduce(_joined, (replace(r, command=whole_command(r.command)) for r in found))
        runs = [folder / policy for policy in records[name].policies for folder in folders]
        _require_same_scenes([RunFolder(run) for run in runs if (run / RUN_FILE).exists()])
    return records


def _joined(one: EvaluationRecord, other: EvaluationRecord) -> EvaluationRecord:
    """Return the record of an evaluation whose policies are those of two records."""
    about, same = ({name: getattr(record, name) for name in OF_ALL_POLICIES} for record in (other, one))
    if about != same:
        words = (f"of {listed(one.policies)}", f"of {listed(other.policies)}")
        raise ConfigError(
            f"the shards are of different evaluations: {differences(same, about, words=words)}; merge them into "
            "different folders, and compare those with roboxim report A B"
        )
    new = [policy for policy in other.policies if policy not in one.policies]
    policies = (*one.policies, *new)
    return replace(
        one, policies=policies, facts={**other.facts, **one.facts},
        command=f"{one.command}\n{other.command}" if new else one.command,
        trained=tuple(p for p in policies if (other if p in new else one).is_trained(p)),
        warnings=tuple(dict.fromkeys((*one.warnings, *other.warnings))),
    )  # fmt: skip


def _require_same_scenes(runs: Sequence[RunFolder]) -> None:
    """Refuse runs of one evaluation in different scenes: its report pairs episodes of one index."""
    for run in runs[1:]:
        first, other = ({key: one.config().get(key) for key in OF_THE_SCENES} for one in (runs[0], run))
        if first != other:
            words = (f"in {runs[0].path}", f"in {run.path}")
            raise ConfigError(
                f"{run.path} was evaluated in other scenes than {runs[0].path}: "
                f"{differences(first, other, words=words)}; merge them into different folders"
            )


def whole_command(command: str) -> str:
    """Return the command line of a whole run: a shard's without ``--shard`` and ``--out``."""
    if not command.startswith("roboxim ") or ("--shard" not in command and "--out" not in command):
        return command
    words, kept = iter(shlex.split(command)), []
    for word in words:
        if word in ("--shard", "--out"):
            next(words, None)
        elif not word.startswith(("--shard=", "--out=")):
            kept.append(word)
    return shlex.join(kept)


@dataclass(frozen=True, kw_only=True)
class _Episode:
    """A finished episode in one of the folders."""

    run: RunFolder
    result: EpisodeResult
    line: dict[str, Any]
    """The result's line, plain data."""

    @property
    def lasting(self) -> dict[str, Any]:
        """Fields of the result that are equal on every machine."""
        return {name: value for name, value in self.line.items() if name not in CLOCKED}

    stored: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Bags of the folder that are in its store, with the facts of their files."""

    def same_bag(self, other: _Episode) -> bool:
        """Return whether another folder's bag of the episode has the same content."""
        own_bag, other_bag = self.run.path / self.result.bag, other.run.path / other.result.bag
        if self.result.bag and own_bag.is_dir() and other_bag.is_dir():
            files = sorted(file.name for file in own_bag.iterdir())
            if files == sorted(file.name for file in other_bag.iterdir()) and all(
                (own_bag / name).samefile(other_bag / name) for name in files
            ):
                return True  # linked by an earlier merge
        return self.content() == other.content()

    def content(self) -> dict[str, str]:
        """Return the hashes of the bag's files."""
        if not self.result.bag:
            return {}
        if self.result.bag in self.stored:
            return {name: facts["sha256"] for name, facts in self.stored[self.result.bag].items()}
        files = sorted((self.run.path / self.result.bag).iterdir())
        return {file.name: file_sha256(file) for file in files}


@dataclass
class _Merge:
    """The folders of one run, checked, and which of them each episode is taken from."""

    name: str
    runs: list[RunFolder]
    chosen: dict[tuple[int, str], _Episode] = field(default_factory=dict)
    doubles: int = 0

    def __post_init__(self) -> None:
        self.config = self._common_config()
        for run in self.runs:
            for episode in _episodes(run, run_key(self.config)):
                self._choose(episode)

    def _common_config(self) -> dict[str, Any]:
        """Return the configuration of all shards; where they may differ, that of the first.

        Raises:
            ConfigError: When a shard belongs to another run or is still running.
        """
        first = self.runs[0].config()
        for run in self.runs:
            if run.in_use:
                raise ConfigError(f"a command is running in {run.path}; wait for it or stop it")
            other = run.config()
            if run_key(other) != run_key(first):
                words = (f"in {self.runs[0].path}", f"in {run.path}")
                raise ConfigError(
                    f"{run.path} is no shard of the run in {self.runs[0].path}: "
                    f"{differences(first, other, ignore=MAY_DIFFER, words=words)}"
                )
            _require_same_server(self.runs[0], first, run, other)
            if first.get("store", "") != other.get("store", ""):
                raise ConfigError(
                    f"the bags of {self.runs[0].path} are in {first.get('store') or 'the folder'}, those of "
                    f"{run.path} in {other.get('store') or 'the folder'}; run all shards with the same --store"
                )
        counts = [int(config["episodes"]) for run in self.runs if "episodes" in (config := run.config())]
        whole = {key: value for key, value in first.items() if key != "shard"}
        return {**whole, "episodes": max(counts)} if counts else whole

    def _choose(self, episode: _Episode) -> None:
        place = episode.result.index, episode.result.episode
        other = self.chosen.get(place)
        if other is None:
            self.chosen[place] = episode
            return
        if other.lasting != episode.lasting or not other.same_bag(episode):
            raise RecorderError(
                f"{other.run.path} and {episode.run.path} have different recordings of episode "
                f"{episode.result.episode_id}, so one of them comes from other code, another kind of machine or a "
                "policy that does not repeat itself; merge without one of the two folders",
                ErrorCode.BAG_DAMAGED,
            )
        self.doubles += 1

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices without an episode in any folder."""
        there = {index for index, _ in self.chosen}
        return tuple(index for index in range(int(self.config.get("episodes", 0))) if index not in there)

    @property
    def summary(self) -> MergedRun:
        return MergedRun(
            name=self.name, episodes=len(self.chosen), shards=len({e.run.path for e in self.chosen.values()}),
            doubles=self.doubles, missing=self.missing,
        )  # fmt: skip

    def require_complete(self) -> None:
        """Refuse a run with gaps."""
        if not self.missing:
            return
        shown = ", ".join(map(str, self.missing[:SHOWN]))
        more = f" and {len(self.missing) - SHOWN} more" if len(self.missing) > SHOWN else ""
        have = ", ".join(str(run.config().get("shard") or "all") for run in self.runs)
        raise ConfigError(
            f"{len(self.missing)} of {self.config['episodes']} episodes of run '{self.name}' are missing: index "
            f"{shown}{more} (given shards: {have}); run the missing shards, or merge the existing ones with --partial"
        )

    # ------------------------------------------------------------------ the merged run

    def fill(self, folder: Path) -> Iterator[None]:
        """Make the merged run's folder; yields after each episode."""
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            attempts = {run.path: _by_episode(_bags_in(run.path)) for run in self.runs}
            stored = {run.path: stored_bags(run.path) for run in self.runs}
            uploads = {path: _by_episode(bags) for path, bags in stored.items()}
            noted: dict[str, Mapping[str, Any]] = {}
            for _, episode in sorted(self.chosen.items()):
                for bag in attempts[episode.run.path].get(episode.result.episode, []):
                    _link(episode.run.path / bag, folder / bag)
                uploaded = uploads[episode.run.path].get(episode.result.episode, [])
                noted |= {bag: stored[episode.run.path][bag] for bag in uploaded}
                yield
            note_stored(folder, noted)
            lines = [line_of(run_key(self.config), episode.line) for _, episode in sorted(self.chosen.items())]
            write_whole(folder / RESULTS_FILE, "".join(lines))
            write_json(folder / RUN_FILE, self.config, sort_keys=True)

    def decorate(self, folder: Path) -> None:
        """Write the picture that the run's command writes."""
        if self.config.get("purpose") == "demo":
            write_first_demonstrations(folder, [episode.result for _, episode in sorted(self.chosen.items())])

    def put(self, made: Path, place: Path) -> None:
        """Move the merged run into its place; the results come last, with one rename."""
        if not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            made.rename(place)
            return
        own = {episode.result.episode for episode in self.chosen.values() if episode.run.path == place}
        with locked(place):
            for bag in sorted(path for kind in PLACES.values() for path in (made / kind).glob("*")):
                there = place / bag.relative_to(made)
                there.parent.mkdir(exist_ok=True)
                if bag.name.rpartition("-")[0] not in own:
                    shutil.rmtree(there, ignore_errors=True)  # of an episode without a result: a killed run left it
                    bag.rename(there)
            for file in sorted(
                (path for path in made.iterdir() if path.is_file()), key=lambda p: p.name == RESULTS_FILE
            ):
                file.replace(place / file.name)


def _episodes(run: RunFolder, key: str) -> Iterator[_Episode]:
    """Yield a folder's finished episodes.

    Raises:
        ConfigError: When a line is of another run, or the list of stored bags is damaged.
        RecorderError: When a bag has vanished.
    """
    stored = stored_bags(run.path)
    latest: dict[tuple[int, str], _Episode] = {}
    for entry in run.log.read():
        if entry.key not in ("", key):
            raise ConfigError(f"{run.log.path} line {entry.line} is a result of another run; merge without this folder")
        result = from_plain(entry.data, EpisodeResult, source=f"{run.log.path} line {entry.line}")
        latest[result.index, result.episode] = _Episode(run=run, result=result, line=dict(entry.data), stored=stored)
    for episode in latest.values():
        if not episode.result.played:
            continue
        bag = episode.result.bag
        if bag and bag not in stored and not any((run.path / bag).glob("*.mcap")):
            raise RecorderError(
                f"{run.log.path} names the bag {bag}, which is gone; put it back, or run that shard "
                "again with --repair",
                ErrorCode.BAG_DAMAGED,
            )
        yield episode


def _require_same_server(first: RunFolder, a: Mapping[str, Any], run: RunFolder, b: Mapping[str, Any]) -> None:
    """Refuse rollouts of another model of a remote policy."""
    if "server_probe" not in a or "server_probe" not in b or a["server_probe"] == b["server_probe"]:
        return
    from roboxim_policies.remote import probe_from_plain

    complaint = probe_from_plain(a["server_probe"]).complaint(probe_from_plain(b["server_probe"]))
    if complaint:
        raise ConfigError(f"{run.path} was evaluated with another model than {first.path}: {complaint}")


def _bags_in(run: Path) -> list[str]:
    """Return every bag in a run's folder, kept or set apart, relative to the folder."""
    return [f"{place}/{bag.name}" for place in PLACES.values() for bag in (run / place).glob("[!.]*")]


def _by_episode(bags: Iterable[str]) -> dict[str, list[str]]:
    """Return the bags of all attempts by their episode's name without the attempt."""
    found: dict[str, list[str]] = {}
    for bag in bags:
        found.setdefault(Path(bag).name.rpartition("-")[0], []).append(bag)
    return found


def _link(source: Path, target: Path) -> None:
    """Link a bag's files into another folder, or copy them to another file system."""

    def place(file: str, copy: str) -> None:
        try:
            os.link(file, copy)
        except OSError:
            shutil.copy2(file, copy)

    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, copy_function=place)


@contextmanager
def _stage(folder: Path) -> Iterator[Path]:
    """Make an empty folder for the merge and remove it afterwards; one that a killed merge left is emptied.

    Raises:
        ConfigError: When another merge into the same folder is running.
    """
    with disk_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    lock = f".{folder.name.lstrip('.')}.lock"
    with locked(folder.parent, lock):
        try:
            with disk_errors(folder):
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            (folder.parent / lock).unlink(missing_ok=True)
