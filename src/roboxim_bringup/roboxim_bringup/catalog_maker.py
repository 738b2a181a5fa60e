"""Makes the catalog of `roboxim_bringup.catalog`; imports the rooms. Run as a program, it renews the cache."""

from __future__ import annotations

import importlib
import inspect
import itertools
import re
from typing import Any

from roboxim_bringup.catalog import Catalog, catalog
from roboxim_core.config import named_config
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary


def make_catalog() -> Catalog:
    """Return skills, tasks and policies as plain values; see `roboxim_bringup.catalog.Catalog`.

    Raises:
        ConfigError: When an object's file is wrong.
    """
    tasks, broken = _tasks()
    return {"skills": _skills(), "tasks": tasks, "broken": broken, "policies": _policies()}


def _skills() -> dict[str, Any]:
    from roboxim_tasks.skills import SKILLS

    library = ModelLibrary()
    models = {name: library.object(name) for name in library.object_ids}
    return {name: {"instruction": SKILLS[name].templates[0], "roles": SKILLS[name].suited(models)} for name in SKILLS}


def _tasks() -> tuple[dict[str, Any], dict[str, str]]:
    """Return the tasks' descriptions, and the errors of invalid task files."""
    from roboxim_tasks.config import TaskMix, load_task_config

    tasks: dict[str, Any] = {}
    broken: dict[str, str] = {}
    for name in config_names("tasks"):
        try:
            config = load_task_config(name)
        except ConfigError as error:
            broken[name] = str(error)
            continue
        if isinstance(config, TaskMix):
            about = {"skills": sorted({cell.skill for cell in config.cells}), "episodes": sum(config.counts)}
        else:
            about = {"skills": [config.skill], "episodes": None}
        tasks[name] = {"about": _first_sentence(named_config("tasks", name).read_text()), **about}
    return tasks, broken


def _policies() -> dict[str, Any]:
    importlib.import_module("roboxim_policies.builtin")  # registers the built-in policies
    from roboxim_policies import POLICIES

    return {
        name: {
            "about": (inspect.getdoc(POLICIES[name]) or "").partition("\n")[0],
            "options": {
                option.name: "required" if option.default is option.empty else f"default {option.default!r}"
                for option in inspect.signature(POLICIES[name]).parameters.values()
            },
        }
        for name in POLICIES
    }


def _first_sentence(text: str) -> str:
    """Return the first sentence of a file's leading comment."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("#").strip() for line in lines)
    end = re.search(r"[.!?](?=\s+[A-Z`]|$)", comment)
    return comment[: end.end()] if end else comment


if __name__ == "__main__":
    catalog()
