"""What the command line says of a task, as the YAML text that the task node gets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import yaml

from roboxim_core.config import config_dirs, named_config
from roboxim_core.errors import ConfigError, one_of

DEFAULT_TASK = "pick_cube"


def task_text(
    task: str = "", *, skill: str = "", objects: Sequence[str] = (), distractors: str = "", colors: str = ""
) -> str:
    """Return a task configuration as YAML text, with the command line's overrides.

    Args:
        task: Name in ``config/tasks`` or a file; empty: that of the skill, or the default one.
        skill: A skill, whose own configuration is ``config/tasks/<skill>.yaml`` if there is one.
        objects: ``[ROLE=]MODEL[,MODEL]``, the role ``target`` unless it is given.
        distractors: Number or range of distractors, e.g. ``1-3``; empty: as configured.
        colors: Comma-separated colours of the target; empty: as configured.

    Raises:
        ConfigError: When there is no such task or skill, or the result is not valid.
    """
    from roboxim_tasks.config import parse_task_config

    text = _base(task, skill)
    parse_task_config(text)
    if not (objects or distractors or colors):
        return text
    data: dict[str, Any] = yaml.safe_load(text) or {}
    changed = data
    if "cells" in data:
        if objects:
            raise ConfigError(f"'{task}' is a mix of tasks with objects of its own; --object needs a task of one skill")
        changed = data.setdefault("set", {})
    for item in objects:
        _set_models(changed, item)
    if distractors:
        found = re.fullmatch(r"(\d+)(?:-(\d+))?", distractors)
        if not found:
            raise ConfigError(f"--distractors must be a number or a range such as 1-3, got '{distractors}'")
        low = int(found[1])
        changed.setdefault("distractors", {}).update(minimum=low, maximum=int(found[2] or low))
    if colors:
        target = changed.setdefault("objects", {}).setdefault("target", {})
        target.setdefault("modifiers", {})["color"] = {"values": [color.strip() for color in colors.split(",")]}
    text = yaml.safe_dump(data, sort_keys=False)
    parse_task_config(text)
    return text


def _base(task: str, skill: str) -> str:
    from roboxim_tasks.skills import SKILLS

    if task and skill:
        raise ConfigError(f"give either --task {task} or --skill {skill}: a task has a skill of its own")
    if not skill:
        return named_config("tasks", task or DEFAULT_TASK).read_text()
    if skill not in SKILLS:
        raise ConfigError(f"unknown skill '{skill}'; {one_of(SKILLS, skill)}")
    files = (folder / "tasks" / f"{skill}.yaml" for folder in config_dirs())
    return next((file.read_text() for file in files if file.is_file()), f"skill: {skill}\n")


def _set_models(data: dict[str, Any], item: str) -> None:
    """Set the models of a role, and drop the modifiers that none of them takes."""
    from roboxim_core.models.library import ModelLibrary

    library = ModelLibrary()
    role, _, models = item.rpartition("=")
    names = [name.strip() for name in models.split(",")]
    for name in names:
        if name not in library.object_ids:
            raise ConfigError(f"--object {item}: unknown object '{name}'; {one_of(library.object_ids, name)}")
    config = data.setdefault("objects", {}).setdefault(role or "target", {}) or {}
    taken = {kind for name in names for kind in library.object_modifiers(name)}
    config["models"] = {"values": names}
    config["modifiers"] = {kind: choice for kind, choice in config.get("modifiers", {}).items() if kind in taken}
    data["objects"][role or "target"] = config
