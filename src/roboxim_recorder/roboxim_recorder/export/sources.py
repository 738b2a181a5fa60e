"""The bags of an export: whole episodes, trimmed or relabelled ones, and the stretches in which one actor acted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_datasets.episode import PART
from roboxim_datasets.where import Edit, cell_of
from roboxim_recorder import topics
from roboxim_recorder.acted import ActedBy, acted_by, actor_of
from roboxim_recorder.bag import BagReader
from roboxim_ros.messages.conversions import from_msg


@dataclass(frozen=True, kw_only=True)
class Source:
    """A bag to export, with the facts that are known before its ticks are read."""

    path: Path
    """The bag."""
    info: EpisodeInfo
    """Everything needed to reproduce the episode."""
    result: EpisodeResult
    """How the episode ended."""
    part: tuple[int, int] | None = None
    """First and last step to export, both included; None: all."""
    suffix: str = ""
    """What follows the episode's id if it becomes several episodes."""
    relabelled: str = ""
    """Another instruction than the recorded one; empty: none."""
    actors: tuple[ActedBy, ...] = ()
    """Who acted at each step of the whole episode; empty: the dataset does not say it."""
    shared: bool = False
    """Whether the bag says at each action who acted."""
    solved_at_end: bool | None = None
    """Whether the task is solved after the last step of the part; None: as the whole episode ended."""

    @property
    def cell(self) -> str:
        """Cell of the episode."""
        return cell_of(self.info.task)

    @property
    def episode_id(self) -> str:
        """Id of the episode in the dataset."""
        return self.info.episode_id + self.suffix

    @property
    def instruction(self) -> str:
        """Instruction of the episode in the dataset."""
        return self.relabelled or self.info.task.instruction

    @property
    def step_words(self) -> tuple[str, ...]:
        """Words of the task's steps in the dataset; empty: it has one step, or other words than the recorded ones."""
        return () if self.relabelled else self.info.task.step_words

    @property
    def first(self) -> int:
        """First step to export."""
        return self.part[0] if self.part else 0

    @property
    def steps(self) -> int:
        """Number of steps to export."""
        return self.part[1] - self.part[0] + 1 if self.part else self.result.steps

    @property
    def solved(self) -> bool:
        """Whether the task is solved after the last step."""
        return self.result.outcome == "success" if self.solved_at_end is None else self.solved_at_end

    def only(self, first: int, last: int, suffix: str = "") -> Source:
        """Return a part of the source, by its first and last step, both included."""
        if (first, last) == (0, self.result.steps - 1):
            return self
        whole = last == self.result.steps - 1
        solved = None if whole else _solved_after(self.path, last + 1)
        return replace(self, part=(first, last), suffix=suffix, solved_at_end=solved)


def edited(source: Source, edit: Edit | None) -> Source:
    """Return a source with an edit applied.

    Raises:
        InvalidRequestError: When the episode has fewer steps than it keeps.
    """
    if edit is None:
        return source
    return replace(source.only(*edit.require_within(source.result.steps)), relabelled=edit.instruction)


def stating_actors(sources: Sequence[Source]) -> list[Source]:
    """Return sources that say at each step who acted, if several actors share an episode of any of them.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when a bag does not say it for each action.
    """
    if not any(source.shared for source in sources):
        return list(sources)
    return [replace(source, actors=_actors(source)) for source in sources]


def by_actor(source: Source, actor: ActedBy) -> tuple[Source, ...]:
    """Return the stretches of a source in which one actor acted, in order; the whole source if nobody else did."""
    actors = source.actors or _actors(source)
    found: list[tuple[int, int]] = []
    steps = range(source.first, source.first + source.steps)
    for acting, group in groupby(steps, key=actors.__getitem__):
        stretch = list(group)
        if acting == actor:
            found.append((stretch[0], stretch[-1]))
    if found == [(source.first, source.first + source.steps - 1)]:
        return (source,)
    return tuple(source.only(first, last, f"{PART}{number}") for number, (first, last) in enumerate(found))


def _actors(source: Source) -> tuple[ActedBy, ...]:
    if source.shared:
        return acted_by(BagReader(source.path, info=source.info))
    return (actor_of(source.info),) * source.result.steps


def _solved_after(bag: Path, tick: int) -> bool:
    """Return whether the task was solved at a tick of a bag."""
    for _, _, message in BagReader(bag).messages((topics.STEP,)):
        if message.seq == tick:
            return bool(from_msg(message, EpisodeStep).verdict.success)
    return False
