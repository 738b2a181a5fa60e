"""A dataset as plain values, independent of its format: what readers return and writers take.

`Dataset` is lazy: it knows the number of episodes and the content of their steps, and reads episodes on demand.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError, one_of
from roboxim_core.plain_data.documents import read_json_object
from roboxim_datasets.account import Account
from roboxim_datasets.episode import EXECUTED, METADATA, OWN_FIELDS, Episode, ImageSize, MetaValue, Step, Wanted
from roboxim_datasets.files import file_in

CONVENTION_FILE = "convention.yaml"
"""File beside a dataset with the meaning of its numbers; ``evaluate --option convention=`` takes it."""
EXPORT_FILE = "export.json"
"""File beside every dataset with the source and the settings of its export."""
_FACTS: Mapping[str, type] = {
    "format": str, "how": str, "config": dict, "options": dict, "sources": list, "runs": list, "robots": list,
    "cells": dict, "not_read": list, "where": list, "edits": list,
}  # fmt: skip
SPLITS = ("train", "val", "test")
"""Splits that RoboXim writes, in this order."""
RECORDED: Mapping[str, type[MetaValue]] = {key: kind for key, kind in METADATA.items() if key not in OWN_FIELDS}
"""Metadata of an episode that comes from a bag, key to type."""

UNUSED = "unused"
"""Name of an action's component that a convention has and nothing executes."""


def in_order(splits: Iterable[str]) -> list[str]:
    """Return splits in the order in which they are written: those of `SPLITS`, then others by name."""
    return sorted(splits, key=lambda name: (SPLITS.index(name) if name in SPLITS else len(SPLITS), name))


def gripper_components(names: Iterable[str]) -> list[int]:
    """Return the indices of an action's components named after a gripper: ``gripper``, ``left_gripper.pos``."""
    return [at for at, name in enumerate(names) if "gripper" in re.split(r"[\W_]", name.lower())]


@dataclass(frozen=True, kw_only=True)
class Features:
    """What the steps of a dataset consist of, the same for all of its episodes."""

    cameras: Mapping[str, ImageSize]
    """Camera to the size of its images."""
    keys: Mapping[str, str]
    """Camera to the key of its images in the dataset, e.g. ``image``."""
    lossless: bool = False
    """Whether images are stored without loss."""
    depth: tuple[str, ...] = ()
    """Cameras that have depth images."""
    segmentation: tuple[str, ...] = ()
    """Cameras that have segmentation images."""
    action: tuple[str, ...]
    """Names of the action's components."""
    vectors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Observed vector to the names of its components; trainers read ``state`` by default."""
    signals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Vector that no trainer reads (``sim.``...) to the names of its components; `episode.EXECUTED` is among them if
    the executed actions are stored."""
    subtasks: bool = False
    """Whether each step states its subtask (`Step.subtask`): the words of the step at hand of a longer task."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """What is known of a dataset before its episodes are read; writers take one, readers return one."""

    features: Features
    """What the steps consist of."""
    fps: float = 0.0
    """Steps per second; 0: the dataset does not say."""
    robot: str = ""
    """Id of the robot model, or of several (`BETWEEN_ROBOTS`); empty: the dataset does not say."""
    joint_names: tuple[str, ...] = ()
    """Arm joints in the order of joint vectors; empty: the dataset does not say, or its robots have different ones."""
    semantics: ActionSemantics | None = None
    """Meaning of the actions; None: the dataset does not say."""
    text: str = ""
    """Description in a sentence."""
    skills: tuple[str, ...] = ()
    """Skills of the episodes; empty: the dataset does not say."""
    parts: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict)
    """``state`` and ``action`` to names of ranges of their components (start, end), where a convention names them."""
    outcomes: bool = True
    """Whether every episode says if it solved its task; if not, what a dataset does not say stays unknown."""
    metadata: Mapping[str, type[MetaValue]] = field(default_factory=lambda: RECORDED)
    """Metadata that every episode has (`Episode.metadata`), key to type."""

    def episode(
        self,
        *,
        length: int,
        instruction: str,
        success: bool | None,
        metadata: Mapping[str, Any],
        read: Callable[[Wanted], Iterator[Step]],
        instructions: Sequence[str] = (),
        subtasks: Sequence[str] = (),
        name: str = "",
    ) -> Episode:
        """Return an episode of such a dataset.

        Args:
            length: Number of steps.
            instruction: Instruction.
            success: Whether the task was solved, as far as the format itself says it; None: it does not.
            metadata: What RoboXim's export says of the episode (``episode_id``, ``success``, ``metadata``, and
                ``robot`` in a dataset of several); empty: it is another's dataset.
            read: Reads the steps.
            instructions: All instructions, if it has several.
            subtasks: All subtasks, if its steps state them.
            name: Id of an episode of which no export says anything.
        """
        features = self.features
        solved = metadata.get("success", success)
        return Episode(
            episode_id=str(metadata.get("episode_id", name)),
            length=length,
            instruction=instruction,
            instructions=tuple(instructions) if len(instructions) > 1 else (),
            subtasks=tuple(subtasks),
            semantics=self.semantics,
            cameras=features.cameras,
            success=None if solved is None else bool(solved),
            robot=str(metadata.get("robot", self.robot)),
            joint_names=self.joint_names,
            fps=self.fps,
            vectors=features.vectors,
            signals={name: names for name, names in features.signals.items() if name != EXECUTED},
            depth=features.depth,
            segmentation=features.segmentation,
            metadata=dict(metadata.get("metadata", {})),
            read=read,
        )


class Dataset(ABC):
    """A dataset that is being read. Episodes are numbered through the splits, in the order of `splits`.

    Non-obvious: an episode reads its steps from the files each time; it fails if they have changed by then.
    """

    format: str
    """Registered name of the format."""
    version: str = ""
    """Version of the format, if it has versions."""
    depth_unit_m = 0.0
    """Unit of depth that a user stated of a dataset that does not say it [m]; 0: none was stated."""

    def __init__(self, path: Path) -> None:
        """Open a dataset.

        Args:
            path: Its folder, or its file.
        """
        self.path = path

    @property
    @abstractmethod
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""

    @property
    @abstractmethod
    def description(self) -> Description:
        """What is known of the dataset before its episodes are read."""

    @abstractmethod
    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split.

        Args:
            split: One of `splits`.
            index: Number in the split, from 0, within its range.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """

    @property
    def folder(self) -> Path:
        """The folder that the dataset's files lie in."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def features(self) -> Features:
        """What the steps consist of."""
        return self.description.features

    def __len__(self) -> int:
        """Count the episodes of all splits."""
        return sum(self.splits.values())

    def episode(self, index: int) -> Episode:
        """Read an episode by its number through all splits.

        Raises:
            InvalidRequestError: When there is no such episode.
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        return self.read(*self.place(index))

    def place(self, index: int) -> tuple[str, int]:
        """Return the split of an episode and its number there.

        Raises:
            InvalidRequestError: When there is no such episode.
        """
        at = index
        for split, count in self.splits.items():
            if 0 <= at < count:
                return split, at
            at -= count
        shown = ", then ".join(f"{count} in '{split}'" for split, count in self.splits.items())
        raise InvalidRequestError(f"{self.path}: no episode {index}; there are {len(self)}, from 0: {shown}")

    def episodes(self, split: str | None = None) -> Iterator[Episode]:
        """Yield the episodes of a split in order; None: of all splits.

        Raises:
            InvalidRequestError: When there is no such split.
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        if split is not None and split not in self.splits:
            raise InvalidRequestError(f"{self.path}: no split '{split}'; {one_of(self.splits, split)}")
        for name in self.splits if split is None else (split,):
            for index in range(self.splits[name]):
                yield self.read(name, index)

    def summaries(self) -> Mapping[str, Mapping[str, Sequence[float]]]:
        """Return stored statistics: ``action`` or an observed vector, to statistic (``mean``, ``q01`` ...), to values.

        Empty if the dataset has none.
        """
        return {}

    @property
    def options(self) -> Mapping[str, Any]:
        """Options of the format with which a dataset like this one is written, as far as its files show them."""
        return {}

    @property
    def usage(self) -> str:
        """How the dataset is loaded, in Markdown, for its card; empty: nothing to say."""
        return ""

    @cached_property
    def account(self) -> Account:
        """All parts of the dataset's files and their treatment; this reads through the dataset.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when it cannot be read.
        """
        account = Account()
        self._take_stock(account)
        return account

    def _take_stock(self, account: Account) -> None:  # noqa: B027 - formats of others may have none
        """Note the parts of the files and which of them are read; a format that does not has an empty account."""

    @cached_property
    def facts(self) -> dict[str, Any]:
        """How the dataset was made: the content of ``export.json``; empty if there is none, or another tool's."""
        try:
            found = read_json_object(file_in(self.folder, EXPORT_FILE))
        except (ConfigError, RecorderError):
            return {}
        return found if _are_facts(found) else {}


def _are_facts(found: object) -> bool:
    """Return whether a value has the form of the facts that RoboXim writes."""
    if not isinstance(found, dict) or any(not isinstance(found.get(key, kind()), kind) for key, kind in _FACTS.items()):
        return False
    names = [*found.get("runs", ()), *found.get("robots", ())]
    groups = [*found.get("cells", {}).values(), *found.get("not_read", ()), *found.get("edits", ())]
    texts, objects = all(isinstance(name, str) for name in names), all(isinstance(group, dict) for group in groups)
    return texts and objects and all(map(_are_facts, found.get("sources", ())))


class DatasetWriter(Protocol):
    """Writes one dataset. An interruption leaves it resumable; its folder gets the final name only when it is whole."""

    def resumed(self, split: str) -> int:
        """Return how many leading episodes of a split an interrupted call has already written."""

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode to a split. Callers add the splits one after another, in the order of `SPLITS`."""

    def complete(self, files: Mapping[str, str | bytes]) -> None:
        """Move the dataset to its final place, with further files by name."""


@runtime_checkable
class EncodingWriter(DatasetWriter, Protocol):
    """A writer whose episodes other processes can encode."""

    @property
    def encoder(self) -> Callable[[Episode], bytes]:
        """Return what encodes an episode; it can be pickled."""

    def add_encoded(self, split: str, data: bytes) -> None:
        """Append an episode that the encoder has encoded."""
