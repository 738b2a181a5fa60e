"""Hashes of the files that an experiment's file refers to, by which a folder with episodes refuses edited ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboxim_eval.experiments import Design, mix_of
from roboxim_eval.experiments.config import TASK
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.policies.specs import PolicySpec, find_policies
from roboxim_runs.scenes.definitions import definitions_of
from roboxim_runs.storage.folder import RunFolder
from roboxim_tasks.config import task_mix
from roboxim_tasks.task_config import TaskConfig


def tasks_of(design: Design) -> dict[str, list[TaskConfig]]:
    """Return the configurations of each task in all cells, also as the conditions change them.

    Args:
        design: The experiment.

    Raises:
        ConfigError: When a task file is missing or invalid.
    """
    once = {cell.key: 1 for cell in design.cells}
    changes = [{}, *(condition.set for condition in design.config.conditions.values())]
    found: dict[str, list[TaskConfig]] = {}
    for number, change in enumerate(changes):
        if change not in changes[:number]:
            mix = task_mix(mix_of(design.config, once, change))
            for name, task in zip(mix.tasks, mix.cells, strict=True):
                found.setdefault(name, []).append(task)
    return found


def definitions(design: Design) -> dict[str, str]:
    """Return the hashes of all files that an experiment refers to, see `definitions_of`.

    Args:
        design: The experiment.

    Raises:
        ConfigError: When a file is missing or invalid.
    """
    tasks = [task for cell_tasks in tasks_of(design).values() for task in cell_tasks]
    return definitions_of(tasks, map(str, design.config.factors[TASK]))


def changed_definitions(stored: Mapping[str, Any], now: Mapping[str, str]) -> str:
    """Return which definitions differ, in words; empty: none does, or none was stored."""
    both = [name for name in now if stored.get(name, now[name]) != now[name]]
    return ", ".join(f"the {name} has changed" for name in both)


def changed_policy(policy: PolicySpec, out: Path, stage: str) -> str:
    """Return which files of a policy differ from those that an evaluation ran with, in words; empty: none does.

    Args:
        policy: The policy.
        out: The experiment's folder.
        stage: The evaluation's stage.

    Raises:
        ConfigError: When the policy is unknown.
    """
    run = RunFolder(evaluation_folder(out, stage))
    stored = run.config().get("policy_files", {}) if run.path.exists() else {}
    (chosen,) = find_policies([policy])
    now = chosen.files(run.path)
    return ", ".join(f"{file} has changed" for file in now if stored.get(file, now[file]) != now[file])
