"""An episode that can be edited, and the registry of faults that edit one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.registry import Registry
from roboxim_datasets.episode import Episode, Floats, MetaValue, RGBImage, Step, Wanted, with_words


@dataclass(kw_only=True, eq=False)
class EditableEpisode:
    """All values of an episode, in memory; step k of every list belongs together."""

    episode: Episode
    """The episode that it was read from; its steps are not read again."""
    instruction: str
    """Natural language instruction; another one than the episode's replaces ``words``."""
    words: list[tuple[str, str | None]]
    """Instruction and subtask of each step; a subtask of None: not stated."""
    actions: Floats
    """Labels, shape (T, D)."""
    executed: Floats | None
    """Executed actions, shape (T, D)."""
    proprio: dict[str, Floats]
    """Observed vector to shape (T, n)."""
    signals: dict[str, Floats]
    """Further vector to shape (T, n)."""
    images: dict[str, list[RGBImage]]
    """Camera to T images."""
    rewards: Floats
    """Shape (T,)."""
    metadata: Mapping[str, MetaValue] = field(default_factory=dict)
    """Further metadata."""

    @staticmethod
    def of(episode: Episode) -> EditableEpisode:
        """Read an episode, depth and segmentation images aside.

        Raises:
            RecorderError: When it cannot be read.
        """
        steps = list(episode.steps())
        return EditableEpisode(
            episode=episode,
            instruction=episode.instruction,
            words=[(episode.words(step), step.subtask) for step in steps],
            actions=np.stack([step.action for step in steps]),
            executed=_stacked([step.action_executed for step in steps]),
            proprio={name: np.stack([step.proprio[name] for step in steps]) for name in steps[0].proprio},
            signals={name: np.stack([step.signals[name] for step in steps]) for name in steps[0].signals},
            images={camera: [step.images[camera] for step in steps] for camera in episode.cameras},
            rewards=np.array([step.reward for step in steps], np.float32),
            metadata=episode.metadata,
        )

    def __len__(self) -> int:
        """Count the steps."""
        return len(self.actions)

    def column(self, component: str) -> tuple[str, int] | None:
        """Return the vector and the place of a component of the proprioception, e.g. ``tcp.x``; none: it has none."""
        for vector, names in self.episode.vectors.items():
            if component in names:
                return vector, names.index(component)
        return None

    def take(self, indices: Sequence[int]) -> None:
        """Keep the steps of some indices, in this order; an index may come twice."""
        chosen = np.asarray(indices)
        self.actions, self.rewards = self.actions[chosen], self.rewards[chosen]
        self.executed = None if self.executed is None else self.executed[chosen]
        self.proprio = {name: values[chosen] for name, values in self.proprio.items()}
        self.signals = {name: values[chosen] for name, values in self.signals.items()}
        self.images = {camera: [images[i] for i in chosen] for camera, images in self.images.items()}
        self.words = [self.words[i] for i in chosen]

    def as_episode(self) -> Episode:
        """Return the edited episode, which stays in memory."""
        relabelled = self.instruction != self.episode.instruction
        words = [(self.instruction, None)] * len(self) if relabelled else self.words

        def read(wanted: Wanted) -> Iterator[Step]:
            for index in range(len(self)):
                yield Step(
                    index=index,
                    images={camera: self.images[camera][index] for camera in wanted.cameras},
                    proprio={name: values[index] for name, values in self.proprio.items()},
                    action=self.actions[index],
                    action_executed=None if self.executed is None else self.executed[index],
                    signals={name: values[index] for name, values in self.signals.items()},
                    reward=float(self.rewards[index]),
                    instruction=words[index][0],
                    subtask=words[index][1],
                )

        made = replace(
            self.episode, length=len(self), metadata=self.metadata, depth=(), segmentation=(), read=read
        )  # fmt: skip
        return with_words(made, words)


def _stacked(rows: Sequence[Floats | None]) -> Floats | None:
    there = [row for row in rows if row is not None]
    return np.stack(there) if len(there) == len(rows) else None


class DatasetFault(ABC):
    """A fault that an edit of an episode's values plants."""

    title: ClassVar[str] = ""
    """What is planted, as a short phrase."""
    found_by: ClassVar[str] = ""
    """Name of the check that must find it."""
    keeps_length: ClassVar[bool] = True
    """Whether the number of steps stays; only then can it be planted in bags, whose states cannot be invented."""

    @abstractmethod
    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Plant the fault.

        Args:
            episode: The episode; it is changed.
            others: Episodes of the same dataset.
            rng: The plant's random stream.

        Returns:
            What was planted, in a phrase; empty: the episode does not allow it and is unchanged.
        """


DATASET_FAULTS: Registry[type[DatasetFault]] = Registry("dataset fault")
"""Classes of faults by name; they take no arguments. The entry point group is ``roboxim.dataset_fault``."""


@DATASET_FAULTS.conformance
def says_what_it_plants(name: str, item: type[DatasetFault]) -> None:
    """Refuse a fault that no check must find."""
    assert item.title.strip(), "it has no title"
    assert item.found_by.strip(), "it does not say which check finds it"


@dataclass(kw_only=True)
class Chosen:
    """Items in which a fault is planted."""

    done: dict[str, str] = field(default_factory=dict)
    """Item to what was planted."""
    refused: list[str] = field(default_factory=list)
    """Items that do not allow the fault."""


def choose(names: Sequence[str], rate: float, seed: int, plant: Callable[[str, np.random.Generator], str]) -> Chosen:
    """Plant a fault in a share of items, drawn at random; an item that refuses it is replaced by another one.

    Args:
        names: The items.
        rate: Share of the items, above 0 and at most 1; at least one item is chosen.
        seed: Seed of the draw and of every plant; an item's plant does not depend on the rate.
        plant: Plants the fault in an item, and returns what it planted; empty: the item refuses it.

    Raises:
        InvalidRequestError: On a rate out of range, or when every item refuses the fault.
    """
    if not 0.0 < rate <= 1.0:
        raise InvalidRequestError(f"the rate must be above 0 and at most 1, got {rate:g}")
    wanted = max(1, round(rate * len(names)))
    chosen = Chosen()
    for place in np.random.default_rng(seed).permutation(len(names)).tolist():
        if len(chosen.done) == wanted:
            break
        if text := plant(names[place], np.random.default_rng((seed, place))):
            chosen.done[names[place]] = text
        else:
            chosen.refused.append(names[place])
    if not chosen.done:
        raise InvalidRequestError(f"none of the {len(names)} episodes allows this fault")
    return chosen
