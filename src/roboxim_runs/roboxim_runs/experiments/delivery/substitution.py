"""Judges failed held-out episodes again by other instructions of the training: what did the policy do instead?"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.seeds import CELL
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_datasets.dataset import Dataset
from roboxim_recorder.bag import BagReader
from roboxim_runs.experiments.delivery.demands import task_mix_of
from roboxim_tasks.judging import Judge
from roboxim_tasks.meaning import read_instruction


def training_instructions(dataset: Dataset) -> dict[str, str]:
    """Return the instructions of a dataset, each with the cell of its first episode.

    Args:
        dataset: A dataset that was exported from bags.

    Raises:
        ConfigError: When an episode does not name its task.
    """
    found: dict[str, str] = {}
    for episode in dataset.episodes():
        task: Any = parse_json(str(episode.metadata.get("task", "")), source=f"the task of {episode.episode_id}")
        drawn = task.get("drawn", {}) if isinstance(task, Mapping) else {}
        if CELL not in drawn:
            raise ConfigError(
                f"episode '{episode.episode_id}' of {dataset.path} does not name its cell; export it again"
            )
        found.setdefault(episode.instruction, str(drawn[CELL]))
    return found


def satisfied(
    bag: Path, instructions: Mapping[str, str], library: ModelLibrary, templates: Mapping[str, Sequence[str]]
) -> tuple[str, ...]:
    """Return the cells whose instructions an episode satisfies at its end, the episode's own instruction left out.

    Args:
        bag: The episode's bag.
        instructions: Instruction to its cell.
        library: The models.
        templates: Skill to templates beside its own.

    Raises:
        RoboximError: When the bag is damaged.
    """
    reader = BagReader(bag)
    info = reader.info
    states: list[StateRecord] = [tick.state for tick in reader.ticks(cameras=())]
    found = set()
    for text, cell in instructions.items():
        if text == info.task.instruction:
            continue
        tasks = read_instruction(text, info.scene, library, templates).tasks
        if any(_solved(task, states) for task in tasks):
            found.add(cell)
    return tuple(sorted(found))


def _solved(task: TaskSpec, states: Sequence[StateRecord]) -> bool:
    """Return whether a task is solved at the end, and was not at the start."""
    judge = Judge(task)
    verdict = first = judge.start(states[0])
    for state in states[1:]:
        verdict = judge.step(state)
    return verdict.success and not first.success


@dataclass(frozen=True, kw_only=True)
class Judging:
    """What the workers need besides the bags."""

    instructions: dict[str, str]
    """Instruction of the training to its cell."""
    templates: dict[str, list[str]]
    """Skill to the templates of the experiment's tasks."""

    @staticmethod
    def of(dataset: Dataset, mix: Any) -> Judging:
        """Return the instructions of a training.

        Args:
            dataset: Its dataset.
            mix: Task mix of all cells, as plain data.

        Raises:
            ConfigError: When an episode of the dataset does not name its task.
        """
        templates: dict[str, list[str]] = {}
        for cell in task_mix_of(json.dumps(mix)).cells:
            if cell.templates is not None:
                templates.setdefault(cell.skill, []).extend(map(str, cell.templates.values))
        return Judging(instructions=training_instructions(dataset), templates=templates)


class SubstitutionWorker:
    """Judges one bag per job, which is its path; see `roboxim_runs.executors`."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Load the models.

        Args:
            settings: ``instructions`` and ``templates``, as in `Judging`.
            number: The worker's number.
        """
        self._settings = settings
        self._library = ModelLibrary()

    def run(self, job: str, note: Callable[[Any], None]) -> list[str]:
        """Return the cells whose instructions the episode satisfies."""
        given = self._settings
        return list(satisfied(Path(job), given["instructions"], self._library, given["templates"]))

    def close(self) -> None:
        """Free nothing."""
