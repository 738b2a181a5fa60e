"""Skills from one file, ``path/to/file.py:Class``, without a package.

A task's configuration names the file, so every process that parses it has the skill. Other processes, e.g. of a report,
find it by ``ROBOXIM_SKILLS``, a list like ``PATH`` of such names, or by an entry point of an installed package.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, is_dataclass
from pathlib import Path

from roboxim_core.config_folders import place_file, place_name
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.registry import run_file
from roboxim_core.user_folders import expanded
from roboxim_tasks.skills.base import SKILLS, Skill

VARIABLE = "ROBOXIM_SKILLS"
"""Environment variable with skills of files."""
_loaded: dict[tuple[Path, str], str] = {}


@dataclass(frozen=True, kw_only=True)
class NoParameters:
    """Parameters of a skill that has none."""


def is_skill_file(text: str) -> bool:
    """Tell whether a skill is given as ``path/to/file.py:Class`` or by a path without the class."""
    return bool(re.search(r"\.py(:\w+)?$", text))


def skill_path(spec: str) -> Path:
    """Return the file of a skill that is given as ``path/to/file.py:Class``."""
    return expanded(place_file(_parts(spec)[0])).absolute()


def placed(spec: str) -> str:
    """Return how configurations name the skill of a file, the same from every working directory; see `place_name`."""
    return f"{place_name(skill_path(spec))}:{_parts(spec)[1]}"


def load_skill_file(spec: str) -> str:
    """Register the skill of a file, once for each process, and return its name.

    Args:
        spec: ``path/to/file.py:Class``.

    Raises:
        ConfigError: When there is no such file or class, the file raises, or the skill's name is taken.
    """
    path, name = skill_path(spec), _parts(spec)[1]
    if not path.is_file():
        raise ConfigError(f"no such file of a skill: {path}")
    if (path, name) in _loaded:
        return _loaded[path, name]
    before = set(SKILLS)
    try:
        module = run_file(path, f"roboxim_skill_{path.stem}")
    except ConfigError:
        raise
    except Exception as error:  # the file's own code may raise anything
        raise ConfigError(f"the file of the skill {path} raises {type(error).__name__}: {error}") from error
    classes = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Skill) and value.__module__ == module.__name__
    }
    if name not in classes:
        raise ConfigError(f"{path} has no skill '{name}'; name a class of it, {one_of(classes, name)}")
    cls = classes[name]
    if not hasattr(cls, "Parameters"):
        cls.Parameters = NoParameters
    if not is_dataclass(cls.Parameters):
        raise ConfigError(
            f"Parameters of skill '{name}' of {path} must be a frozen dataclass with a field for each threshold, e.g. "
            "hold_s: float = 0.5; leave it out if there are none"
        )
    cls.name = cls.name or re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        raise ConfigError(f"skill '{cls.name}' of {path} has no {', '.join(missing)}; define each as a method")
    if cls.name not in set(SKILLS) - before:
        SKILLS.register(cls.name)(cls())
    _loaded[path, name] = cls.name
    return cls.name


def load_named_by_environment() -> None:
    """Register the skills that `VARIABLE` names.

    Raises:
        ConfigError: See `load_skill_file`.
    """
    for spec in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        load_skill_file(spec)


def _parts(spec: str) -> tuple[str, str]:
    where, _, name = (spec, "", "") if spec.endswith(".py") else spec.rpartition(":")
    return where, name
