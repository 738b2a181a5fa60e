"""Hashes of the files that an experiment's file refers to: tasks, scenes, cameras and models.

A stage's inputs contain them. An edit of such a file changes how episodes are drawn or judged, so a folder with
episodes refuses other definitions.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboxim_core.config import digest, load_config, load_yaml
from roboxim_core.config_folders import named_config
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec
from roboxim_eval.experiments import Design, mix_of
from roboxim_eval.experiments.config import TASK
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.policies.specs import PolicySpec, find_policies
from roboxim_runs.storage.folder import RunFolder
from roboxim_tasks.components.cameras import CamerasResetConfig
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
    """Return the hashes of all tasks, scenes, cameras and models of an experiment, e.g. ``{"task pick_up": ...}``.

    A file's hash is that of its parsed content: a comment does not change it. A model's is also that of its meshes.

    Args:
        design: The experiment.

    Raises:
        ConfigError: When a file is missing or invalid.
    """
    library = ModelLibrary()
    tasks = [task for cell_tasks in tasks_of(design).values() for task in cell_tasks]
    scenes = {name: load_config(named_config("scenes", name), SceneSpec) for name in {task.scene for task in tasks}}
    cameras = {name for task in tasks for name in _cameras(task)}
    models = {scene.robot.model for scene in scenes.values()}
    models |= {task.robot for task in tasks if task.robot}
    models |= {entity.model for scene in scenes.values() for entity in scene.entities}
    models |= {model for task in tasks for model in _models(task)}
    files = {"tasks": list(map(str, design.config.factors[TASK])), "scenes": scenes, "cameras": cameras}
    return {
        **{
            f"{kind.removesuffix('s')} {name}": digest(load_yaml(named_config(kind, name)))
            for kind, names in files.items()
            for name in sorted(names)
        },
        **{f"model {name}": library.digest(name) for name in sorted(models)},
    }


def _cameras(task: TaskConfig) -> set[str]:
    config = task.reset.get("cameras")
    if not isinstance(config, CamerasResetConfig):
        return set()
    views = {str(name) for choice in config.views.values() for name in choice.values}
    return {*config.names, *views}


def _models(task: TaskConfig) -> set[str]:
    """Return the models that a scene of a task can have."""
    named = {str(model) for one in task.objects.values() for model in one.models.values}
    some = task.distractors
    return {*named, *some.always, *(map(str, some.models.values) if some.maximum else ())}


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
