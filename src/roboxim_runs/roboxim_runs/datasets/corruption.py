"""Plants faults in copies of bags and datasets, to test the audit and to measure how faults affect training.

The source is never changed. ``<copy>-planted.json`` lists what was planted, so that a test can score an audit's recall.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.user_folders import expanded
from roboxim_datasets.audit.faults import DATASET_FAULTS, DatasetFault, EditableEpisode, choose
from roboxim_datasets.card import write_card
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import FORMATS, open_dataset
from roboxim_datasets.rewrite import files_beside, options_like
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import PLACES, bag_path
from roboxim_recorder.edited import copy_edited
from roboxim_recorder.run_bags import holds_bags, run_bags
from roboxim_runs.datasets.simulated_faults import SIMULATED_FAULTS
from roboxim_runs.datasets.viewing import episode_of_bag
from roboxim_runs.episodes.reenactment import Recorded, Reenactor
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.storage.folder import path_as_given


@dataclass(frozen=True)
class FaultKind:
    """A fault that can be planted."""

    name: str
    """Its name."""
    title: str
    """What is planted."""
    found_by: str
    """Name of the check that must find it."""
    bags: bool
    """Whether it can be planted in bags."""
    datasets: bool
    """Whether it can be planted in datasets."""


def fault_kinds() -> dict[str, FaultKind]:
    """Return every fault that can be planted, by name."""
    found = [
        FaultKind("clock", "a tick that is 4 ms late", "clock", bags=True, datasets=False),
        FaultKind("duplicate", "an episode twice", "duplicate", bags=True, datasets=True),
        FaultKind("split_leak", "a training episode in val, too", "split_leak", bags=False, datasets=True),
    ]
    for name in DATASET_FAULTS:
        edit = DATASET_FAULTS[name]
        found.append(FaultKind(name, edit.title, edit.found_by, bags=edit.keeps_length, datasets=True))
    for name in SIMULATED_FAULTS:
        fault = SIMULATED_FAULTS[name]
        found.append(FaultKind(name, fault.title, fault.found_by, bags=True, datasets=False))
    return {kind.name: kind for kind in sorted(found, key=lambda kind: kind.name)}


@dataclass(frozen=True, kw_only=True)
class Corrupted:
    """A copy with planted faults."""

    path: Path
    """The copy."""
    listing: Path
    """The file that lists what was planted."""
    planted: dict[str, str] = field(default_factory=dict)
    """Episode, as an audit of the copy names it, to what was planted in it."""
    refused: tuple[str, ...] = ()
    """Episodes of the source that do not allow the fault."""


def corrupt(
    source: Path | str,
    out: Path | str,
    fault: str,
    rate: float,
    *,
    seed: int = 0,
    link: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> Corrupted:
    """Copy bags or a dataset and plant a fault in a share of the episodes.

    Args:
        source: A run, a folder of bags, or a dataset of a registered format.
        out: Folder of the copy; it must not exist.
        fault: One of `fault_kinds`.
        rate: Share of the episodes, above 0 and at most 1; at least one.
        seed: Seed of the choice of episodes and of every plant.
        link: Whether bags without the fault are hard links, which take no space, instead of copies; bags are never
            changed in place. Where the file system has no links, they are copied.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set; the unfinished copy is removed.

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: On an unknown fault, or one that this kind of source cannot have.
        InvalidRequestError: On a rate out of range, or when no episode allows the fault.
        RecorderError: When the copy exists, the source is damaged, or the copy cannot be written.
    """
    source, out = expanded(source), path_as_given(out)
    kinds = fault_kinds()
    if fault not in kinds:
        raise ConfigError(f"unknown fault '{fault}'; {one_of(kinds, fault)}")
    of_bags = holds_bags(source) if source.exists() else False
    if not (kinds[fault].bags if of_bags else kinds[fault].datasets):
        kind, other = ("bags", "a dataset") if of_bags else ("a dataset", "bags")
        raise ConfigError(
            f"fault '{fault}' cannot be planted in {kind}, only in {other}"
            + ("" if of_bags else "; plant it in the bags and export them")
        )
    if not 0.0 < rate <= 1.0:
        raise InvalidRequestError(f"the rate must be above 0 and at most 1, got {rate:g}")
    if out.exists():
        raise RecorderError(f"{out} exists; choose another folder", ErrorCode.EXPORT_REFUSED)
    try:
        reporter = Reporter(on_event, cancellation)
        with reporter.resumable("nothing is left; the same call or command starts again"):
            planter = _Planting(fault=fault, rate=rate, seed=seed, link=link, reporter=reporter)
            planted, refused = planter.bags(source, out.absolute()) if of_bags else planter.dataset(source, out)
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise
    listing = out.with_name(f"{out.name}-planted.json")
    facts = {
        "source": str(source), "fault": fault, "found_by": kinds[fault].found_by, "rate": rate, "seed": seed,
        "planted": planted, "refused": refused,
    }  # fmt: skip
    listing.write_text(json.dumps(facts, indent=2) + "\n")
    return Corrupted(path=out, listing=listing, planted=planted, refused=tuple(refused))


@dataclass(kw_only=True)
class _Planting:
    """One corruption."""

    fault: str
    rate: float
    seed: int
    link: bool
    reporter: Reporter

    def _choose(
        self, names: Sequence[str], plant: Callable[[str, np.random.Generator], str]
    ) -> tuple[dict[str, str], list[str]]:
        done = 0

        def counted(name: str, rng: np.random.Generator) -> str:
            nonlocal done
            text = plant(name, rng)
            done += bool(text)
            progress(done)
            return text

        with self.reporter.stage("planting", max(1, round(self.rate * len(names))), "episodes") as progress:
            chosen = choose(names, self.rate, self.seed, counted)
        return chosen.done, chosen.refused

    # -------------------------------------------------------------- bags

    def bags(self, source: Path, out: Path) -> tuple[dict[str, str], list[str]]:
        """Copy bags; those without the fault stay byte for byte."""
        bags = {path.name: path for path in run_bags(source).paths}
        if self.fault in SIMULATED_FAULTS:
            planted, refused = self._simulated(bags, out)
        elif self.fault == "duplicate":
            planted, refused = self._choose(list(bags), lambda name, rng: _duplicate(bags[name], out))
            planted = {f"{name}-copy": text for name, text in planted.items()}
        elif self.fault == "clock":
            planted, refused = self._choose(list(bags), lambda name, rng: _uneven_clock(bags[name], out, rng))
        else:
            planted, refused = self._edited(bags, out)
        for name, path in bags.items():
            if name not in planted:
                shutil.copytree(path, out / PLACES["keep"] / name, copy_function=_linked if self.link else shutil.copy2)
        return planted, refused

    def _simulated(self, bags: dict[str, Path], out: Path) -> tuple[dict[str, str], list[str]]:
        fault = SIMULATED_FAULTS[self.fault]()
        with Reenactor(out) as sim:

            def plant(name: str, rng: np.random.Generator) -> str:
                recorded = Recorded.of(bags[name])
                for plan in fault.plans(recorded, sim, rng):
                    if fault.suits(recorded, plan, sim):
                        sim.record(recorded, plan.scene, plan.acts)
                        return plan.text
                return ""

            return self._choose(list(bags), plant)

    def _edited(self, bags: dict[str, Path], out: Path) -> tuple[dict[str, str], list[str]]:
        fault = DATASET_FAULTS[self.fault]()
        episodes = {name: episode_of_bag(path)[0] for name, path in bags.items()}

        def plant(name: str, rng: np.random.Generator) -> str:
            before, after = EditableEpisode.of(episodes[name]), EditableEpisode.of(episodes[name])
            others = [episode for other, episode in episodes.items() if other != name]
            text = fault.edit(after, others, rng)
            if text:
                _apply(bags[name], out, before, after)
            return text

        return self._choose(list(bags), plant)

    # -------------------------------------------------------------- datasets

    def dataset(self, source: Path, out: Path) -> tuple[dict[str, str], list[str]]:
        """Write a dataset of the same format with edited or additional episodes."""
        dataset = open_dataset(source)
        if dataset.description.features.depth or dataset.description.features.segmentation:
            raise InvalidRequestError("datasets with depth or segmentation images cannot be corrupted; export without")
        splits = list(dataset.splits)
        names = [f"{split}/{index}" for split in splits for index in range(dataset.splits[split])]
        edited: dict[str, Episode] = {}
        more: dict[str, list[Episode]] = {split: [] for split in splits}
        if self.fault in ("duplicate", "split_leak"):
            planted, refused = self._repeated(dataset, names, more)
        else:
            planted, refused = self._choose(names, _edit_of(dataset, DATASET_FAULTS[self.fault](), edited))
        facts = {"fault": self.fault, "rate": self.rate, "seed": self.seed, "planted": len(planted)}
        _write(dataset, out, edited, more, facts)
        return planted, refused

    def _repeated(
        self, dataset: Dataset, names: list[str], more: dict[str, list[Episode]]
    ) -> tuple[dict[str, str], list[str]]:
        """Add episodes a second time: to their own split, or those of the first split to the second one."""
        splits = list(dataset.splits)
        leak = self.fault == "split_leak"
        if leak and len(splits) < 2:
            raise InvalidRequestError(f"the dataset has the one split {splits}; a leak needs two")
        texts: dict[str, str] = {}

        def plant(name: str, rng: np.random.Generator) -> str:
            split, index = _place(name)
            target = splits[1] if leak else split
            new = f"{target}/{dataset.splits[target] + len(more[target])}"
            more[target].append(dataset.read(split, index))
            texts[new] = f"it is '{name}'"
            return texts[new]

        candidates = [name for name in names if _place(name)[0] == splits[0]] if leak else names
        _, refused = self._choose(candidates, plant)
        return texts, refused


def _place(name: str) -> tuple[str, int]:
    split, _, index = name.rpartition("/")
    return split, int(index)


def _edit_of(
    dataset: Dataset, fault: DatasetFault, edited: dict[str, Episode]
) -> Callable[[str, np.random.Generator], str]:
    """Return the function that plants a fault in an episode of a dataset, by name."""
    every = list(dataset.episodes())

    def plant(name: str, rng: np.random.Generator) -> str:
        episode = EditableEpisode.of(dataset.read(*_place(name)))
        text = fault.edit(episode, every, rng)
        if text:
            edited[name] = episode.as_episode()
        return text

    return plant


def _write(
    dataset: Dataset, out: Path, edited: dict[str, Episode], more: dict[str, list[Episode]], facts: Mapping[str, Any]
) -> None:
    """Write a dataset like another one, with some of its episodes edited and more of them."""
    made, options = FORMATS[dataset.format](), options_like(dataset)
    files = files_beside([dataset], format=dataset.format, how="corrupt", options=options, **facts)
    with made.create(out, dataset.description, options, identity="", overwrite=False) as writer:
        for split, count in dataset.splits.items():
            for index in range(count):
                writer.add(split, edited.get(f"{split}/{index}") or dataset.read(split, index))
            for episode in more[split]:
                writer.add(split, episode)
        writer.complete(files)
    write_card(made.open(made.path(out, options)))


def _linked(source: str, target: str) -> None:
    """Link a file, or copy it where that is not possible."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


# ------------------------------------------------------------------ edits of bags


def _apply(bag: Path, out: Path, before: EditableEpisode, after: EditableEpisode) -> None:
    """Copy a bag with the differences of two versions of its episode."""
    changed: dict[str, np.ndarray[Any, Any]] = {}
    for name, first, second in (
        ("label", before.actions, after.actions),
        ("executed", before.executed, after.executed),
        ("joints", before.proprio.get("joint_positions"), after.proprio.get("joint_positions")),
    ):
        if first is not None and second is not None and not np.array_equal(first, second):
            changed[name] = second
    images = {
        topics.image_topic(camera): after.images[camera]
        for camera in after.images
        if any(
            a is not b and not np.array_equal(a, b)
            for a, b in zip(before.images[camera], after.images[camera], strict=True)
        )
    }
    edited = set(images)
    edited |= {topics.STEP} if {"label", "executed"} & changed.keys() else set()
    edited |= {topics.STATE} if {"joints", "executed"} & changed.keys() else set()
    edited |= {topics.INFO, topics.RESULT} if before.instruction != after.instruction else set()
    seen: dict[str, int] = {}

    def edit(topic: str, message: Any) -> None:
        if topic == topics.INFO:
            message.task.instruction = after.instruction
        elif topic == topics.RESULT:
            message.instruction = after.instruction
        elif topic == topics.STEP and 1 <= message.seq <= len(after):
            for name, attribute in (("label", "action_label"), ("executed", "action_executed")):
                if name in changed:
                    setattr(message, attribute, changed[name][message.seq - 1].astype(np.float64))
        elif topic == topics.STATE:
            if "joints" in changed and message.seq < len(after):
                message.robot.joint_positions = changed["joints"][message.seq].astype(np.float64)
            if "executed" in changed and 1 <= message.seq <= len(after):
                message.action_executed = changed["executed"][message.seq - 1].astype(message.action_executed.dtype)
        elif topic in images:
            index = seen.get(topic, 0)
            seen[topic] = index + 1
            if index < len(after):
                message.data = np.ascontiguousarray(images[topic][index]).reshape(-1)

    copy_edited(bag, out, edited, edit)


def _duplicate(bag: Path, out: Path) -> str:
    """Copy a bag under another id, beside the first one."""
    name = f"{bag.name}-copy"

    def edit(topic: str, message: Any) -> None:
        if hasattr(message, "episode_id"):
            message.episode_id = name
        if hasattr(message, "bag"):
            message.bag = bag_path(name, "keep")

    copy_edited(bag, out, (topics.INFO, topics.RESULT, topics.STEP, topics.STATE), edit, episode_id=name)
    return f"a copy of {bag.name}"


def _uneven_clock(bag: Path, out: Path, rng: np.random.Generator) -> str:
    """Copy a bag with one late tick."""
    late = int(rng.integers(2, max(3, len(BagReader(bag)) // 2)))

    def edit(topic: str, message: Any) -> None:
        if topic == topics.NOTICE and message.seq == late:
            message.stamp.nanosec += 4_000_000

    copy_edited(bag, out, (), edit)
    return f"tick {late} is 4 ms late"
