"""Proves from bags that an experiment's demonstrations and evaluations are what its cells say.

`roboxim_eval.experiments.proving.proofs` decides; this module finds the bags and lets workers read them.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from string import Formatter
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
from roboxim_core.plain_data.documents import read_json_object
from roboxim_datasets.dataset import EXPORT_FILE, Dataset
from roboxim_datasets.formats import open_dataset
from roboxim_eval.experiments.proving.changes import WORDS_SAY_OTHER_ROLES
from roboxim_eval.experiments.proving.delivery import WORDS
from roboxim_eval.experiments.proving.demand import Allowed, Demand, Shown
from roboxim_eval.experiments.proving.proofs import (
    PROOF_OF_TRAINING,
    Fault,
    Tally,
    Trained,
    pairing,
    tally,
    training_tally,
)
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation, Executor, Job, Work, run_required
from roboxim_runs.experiments.delivery.demands import demands_of
from roboxim_runs.experiments.delivery.substitution import Judging
from roboxim_runs.experiments.delivery.worker import BagJob, shown_from
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.training.run import TRAINED_ON

THREADS_VARIABLE = "LP_NUM_THREADS"
"""Threads of the software renderer of a worker."""
INLINE = 32
"""Number of bags up to which this process reads them: the start of workers would take longer."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How bags are read."""

    workers: int = 1
    """Processes."""
    logs: Path
    """Folder of their output."""
    on_event: OnEvent = ignore
    """Receives progress."""
    cancellation: Cancellation | None = None
    """Ends the reading when it is set."""
    executor: Executor | None = None
    """Reads the bags; none: processes of this machine."""

    def run(self, title: str, worker: str, settings: Any, jobs: Mapping[str, Any]) -> dict[str, Any]:
        """Return what workers find in bags.

        Args:
            title: Title of the stage.
            worker: ``module:name`` of the worker.
            settings: Its settings.
            jobs: Bag to the job's data.

        Raises:
            CancelledError: When the run was cancelled.
            RoboximError: When a bag is damaged or cannot be drawn, or workers die.
        """
        workers = self.workers if len(jobs) > INLINE else 1
        work = Work(worker=worker, settings=settings, environment={THREADS_VARIABLE: "1"} if workers > 1 else {})
        found: dict[str, Any] = {}
        queued = [Job(key=bag, data=data) for bag, data in jobs.items()]
        with Reporter(self.on_event).stage(title, len(jobs), "bags") as progress:
            for outcome in run_required(
                work, queued, lost="bag {} was not read", executor=self.executor, workers=workers, log_dir=self.logs,
                cancellation=self.cancellation,
            ):  # fmt: skip
                found[outcome.key] = outcome.value
                progress(len(found))
        return found

    def read(
        self, title: str, jobs: Sequence[BagJob], mixes: Mapping[str, str], *, pictures: bool = True
    ) -> Iterator[tuple[Shown, tuple[Demand, ...]]]:
        """Yield the content of each bag and the demands of its instruction, in the order of the jobs.

        Args:
            title: Title of the stage.
            jobs: The bags.
            mixes: Task mixes by name, as JSON texts.
            pictures: Whether to compare the pictures of tick 0.

        Raises:
            CancelledError: When the run was cancelled.
            RoboximError: When a bag is damaged or cannot be drawn, or workers die.
        """
        found = self.run(
            title, "roboxim_runs.experiments.delivery.worker:DeliveryWorker",
            {"mixes": dict(mixes), "pictures": pictures},
            {job.bag: to_plain(job) for job in jobs},
        )  # fmt: skip
        for job in jobs:
            value = found[job.bag]
            instructed = tuple(
                Demand(skill=one["skill"], models={r: Allowed(values=(m,)) for r, m in one["models"].items()})
                for one in value["asked"]
            )
            yield shown_from(value["shown"]), instructed


# ------------------------------------------------------------------ training data


@dataclass(frozen=True, kw_only=True)
class DatasetClaim:
    """A dataset with its claimed content."""

    name: str
    """Its name."""
    path: Path
    """Folder of the export."""
    bags: Path
    """The run that it was exported from."""
    counts: Mapping[str, int]
    """Cell to number of episodes."""
    planted: Mapping[str, str]
    """Name of an episode to the fault that was planted in it on purpose."""


def prove_training(claims: Sequence[DatasetClaim], mix: Any, unseen: Sequence[str], reading: Reading) -> Tally:
    """Prove that datasets hold what they claim, and nothing of a held-out cell.

    Args:
        claims: The datasets.
        mix: Task mix of all cells, as plain data.
        unseen: Held-out cells.
        reading: How bags are read.

    Raises:
        RoboximError: When a bag or a dataset is damaged or missing.
    """
    text = json.dumps(mix)
    demands = demands_of(text)
    episodes = {claim.name: list(_episodes(open_dataset(claim.path), claim)) for claim in claims}
    instructions = dict(pair for claim in claims for pair in episodes[claim.name])
    jobs = [BagJob(bag=bag, mix="all", instruction=words) for bag, words in instructions.items()]
    known = {
        shown.bag: (shown, instructed) for shown, instructed in reading.read("proving datasets", jobs, {"all": text})
    }
    found = Tally()
    for claim in claims:
        trained = [
            Trained(shown=known[bag][0], instructed=known[bag][1], planted=claim.planted.get(Path(bag).name, ""))
            for bag, _ in _distinct(episodes[claim.name], claim.name)
        ]
        own = training_tally(demands, unseen, claim.counts, trained)
        shown = tally(demands, [episode.shown for episode in trained if not episode.planted], without=(WORDS,))
        found += _titled(own + shown, claim.name)
    return found


def _titled(found: Tally, name: str) -> Tally:
    faults = tuple(replace(fault, text=f"{fault.text} (dataset {name})") for fault in found.faults)
    return replace(found, faults=faults, statements=tuple(f"{name}: {text}" for text in found.statements))


def _episodes(dataset: Dataset, claim: DatasetClaim) -> Iterator[tuple[str, str]]:
    """Yield bag and instruction of every episode of a dataset."""
    for episode in dataset.episodes():
        path = str(episode.metadata.get("file_path", ""))
        bag = claim.bags / path
        if not path or not bag.exists():
            raise RoboximError(
                f"dataset {claim.path}: episode '{episode.episode_id}' names the bag '{path}', which is not in "
                f"{claim.bags}, so nothing proves where it comes from; export it again",
                ErrorCode.BAG_DAMAGED,
            )
        yield str(bag), episode.instruction


def _distinct(episodes: Sequence[tuple[str, str]], dataset: str) -> Sequence[tuple[str, str]]:
    """Return the episodes of a dataset.

    Raises:
        ConfigError: When a bag occurs twice.
    """
    counts = Counter(bag for bag, _ in episodes)
    if twice := [bag for bag, number in counts.items() if number > 1]:
        raise ConfigError(f"dataset {dataset} has the episode of bag {twice[0]} more than once")
    return episodes


def prove_trained_on(training: Path, claim: DatasetClaim) -> Tally:
    """Prove that a training read its dataset: the export that the checkpoint's folder names has the claimed counts.

    Args:
        training: Folder of the training.
        claim: The dataset.

    Raises:
        ConfigError: When the file that names the export is damaged.
    """
    file = training / TRAINED_ON
    if not file.is_file():
        return Tally(
            statements=(f"{training.name}: its trainer does not name its dataset ({TRAINED_ON}), so this is unproven",)
        )
    named = read_json_object(file)
    export = read_json_object(open_dataset(claim.path).folder / EXPORT_FILE)
    faults = []
    if named.get("identity") != export.get("identity"):
        faults.append(f"it was trained with the export {named.get('identity')}, expected {export.get('identity')}")
    cells = export.get("cells", {}).get("train", {})
    if cells != dict(claim.counts):
        faults.append(f"its export holds {cells}, expected {dict(claim.counts)}")
    wrong = tuple(Fault(check=PROOF_OF_TRAINING, bag=str(training), text=text) for text in faults)
    return Tally(checks={PROOF_OF_TRAINING: (int(not wrong), 1)}, faults=wrong)


# ------------------------------------------------------------------ evaluations


@dataclass(frozen=True, kw_only=True)
class ArmClaim:
    """The rollouts of a condition in a replicate."""

    condition: str
    """The condition."""
    folder: Path
    """Folder of its run."""
    mix: Any
    """Its task mix, as plain data."""
    words: str | None
    """What its policy must receive as instruction; none: the task's."""
    latency_ticks: int = 0
    """Ticks by which its policy's answers must be late."""
    changed: tuple[str, ...] = ()
    """Parts of the task that the condition changes."""


def prove_evaluation(arms: Sequence[ArmClaim], reading: Reading) -> tuple[Tally, dict[str, list[int]]]:
    """Prove that rollouts took place as their cells say.

    Args:
        arms: Conditions of a replicate.
        reading: How bags are read.

    Returns:
        The results, and for each condition the indices of the episodes that are none of their cells.

    Raises:
        RoboximError: When a bag is damaged or missing.
    """
    mixes = {arm.condition: json.dumps(arm.mix) for arm in arms}
    index_of: dict[str, tuple[str, int]] = {}
    jobs = []
    for arm in arms:
        run = RunFolder(arm.folder)
        for result in run.results():
            if result.bag:
                bag = str(run.path / result.bag)
                index_of[bag] = arm.condition, result.index
                jobs.append(BagJob(bag=bag, mix=arm.condition, words=arm.words, latency_ticks=arm.latency_ticks))
    found = Tally()
    shown_by_arm: dict[str, list[Shown]] = {arm.condition: [] for arm in arms}
    for shown, _ in reading.read("proving rollouts", jobs, mixes):
        shown_by_arm[index_of[shown.bag][0]].append(shown)
    demands = {arm.condition: demands_of(mixes[arm.condition], arm.words, arm.latency_ticks) for arm in arms}
    for arm in arms:
        found += tally(demands[arm.condition], shown_by_arm[arm.condition])
    found += pairing(shown_by_arm, _changed(arms, demands))
    excluded: dict[str, list[int]] = {}
    for bag in sorted(found.faulty):
        condition, index = index_of[bag]
        excluded.setdefault(condition, []).append(index)
    return found, excluded


def _changed(arms: Sequence[ArmClaim], demands: Mapping[str, Mapping[str, Demand]]) -> dict[str, tuple[str, ...]]:
    """Return the parts of the task that each condition changes; roles that only its instructions name are one too."""
    named = {arm.condition: {cell: _named_roles(one) for cell, one in demands[arm.condition].items()} for arm in arms}
    plain = next((named[arm.condition] for arm in arms if not arm.changed), {})

    def other(arm: ArmClaim) -> bool:
        roles = named[arm.condition]
        return not {"templates", "paraphrases", "wordings"}.isdisjoint(arm.changed) and any(
            len(roles[cell]) != 1 or roles[cell] != plain[cell] for cell in roles.keys() & plain.keys()
        )

    return {arm.condition: arm.changed + ((WORDS_SAY_OTHER_ROLES,) if other(arm) else ()) for arm in arms}


def _named_roles(demand: Demand) -> set[frozenset[str]]:
    """Return the names that the templates of a cell have in braces; one set if all have the same ones."""
    return {frozenset(n for _, n, _, _ in Formatter().parse(template) if n) for template in demand.templates}


def judge_again(failed: Mapping[str, str], dataset: DatasetClaim, mix: Any, reading: Reading) -> list[dict[str, Any]]:
    """Judge failed held-out episodes by the instructions of the training.

    Args:
        failed: Bag to its held-out cell.
        dataset: What the policy was trained with.
        mix: Task mix of all cells, as plain data.
        reading: How bags are read.

    Returns:
        Of each episode its cell, and the cells of the training whose instructions it satisfies.

    Raises:
        RoboximError: When a bag or the dataset is damaged.
    """
    judging = Judging.of(open_dataset(dataset.path), mix)
    found = reading.run(
        "judging again", "roboxim_runs.experiments.delivery.substitution:SubstitutionWorker", to_plain(judging),
        {bag: bag for bag in failed},
    )  # fmt: skip
    return [{"cell": cell, "satisfied": found[bag]} for bag, cell in failed.items()]
