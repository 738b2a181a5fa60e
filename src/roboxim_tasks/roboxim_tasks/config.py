"""Task configuration: which tasks are drawn and how their scenes are reset.

Skills and reset components bring configurations of their own (``parameters``, ``reset``); they are checked here,
against the class that the named skill or component declares, so that a wrong key is refused with its line before
anything runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableMapping
from copy import copy
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

from roboxim_core.config import from_plain, load_yaml, named_config, parse_yaml
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_tasks.choices import Choice
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.skills import SKILLS

DEFAULT_TASK = "pick_cube"
MAX_DISTRACTORS = 8


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """Which objects may fill a role."""

    models: Choice = Choice(values=("cube",))
    """Ids of object models."""
    modifiers: dict[str, Choice] = field(default_factory=dict)
    """Modifier name to its values, e.g. ``color`` or ``scale``; those left out take the model's default."""


@dataclass(frozen=True, kw_only=True)
class DistractorConfig:
    """Objects that the task is not about; none of them fits the description of an object of the task."""

    minimum: int = 0
    """Fewest distractors."""
    maximum: int = 0
    """Most distractors."""
    models: Choice = Choice(values=("cube",))
    """Ids of object models."""
    modifiers: dict[str, Choice] = field(default_factory=dict)
    """Modifier name to its values."""

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ConfigError: When it is empty or too large.
        """
        if not 0 <= self.minimum <= self.maximum <= MAX_DISTRACTORS:
            raise ConfigError(
                f"needs 0 <= minimum <= maximum <= {MAX_DISTRACTORS} distractors, got {self.minimum} and {self.maximum}"
            )


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """A YAML file of ``config/tasks``."""

    skill: str = "pick_up"
    """Registered skill."""
    parameters: Any = None
    """The skill's own parameters and thresholds."""
    templates: Choice | None = None
    """Instruction templates with roles in braces, e.g. ``Pick up the {target}``; none: the skill's."""
    paraphrases: bool = False
    """Without templates: whether all of the skill's are used, or the first alone."""
    objects: dict[str, ObjectConfig] = field(default_factory=dict)
    """Role of the skill to the objects that may fill it."""
    distractors: DistractorConfig = DistractorConfig()
    """Further objects."""
    scene: str = "empty_table"
    """Name of a scene in ``config/scenes``."""
    reset: dict[str, Any] = field(default_factory=dict)
    """Reset component to its configuration; the skill's own components need not be named."""
    rate_hz: float = 10.0
    """Control rate [Hz]."""
    max_steps: int = 0
    """Actions after which an episode has failed; 0: the skill's."""
    max_draws: int = 100
    """Draws of a placement after which the reset is infeasible."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: On a number out of range.
        """
        if self.rate_hz <= 0 or self.max_steps < 0 or self.max_draws < 1:
            raise ConfigError("needs rate_hz > 0, max_steps >= 0 and max_draws >= 1")


def task_config(data: Any, *, source: str = "task configuration", library: ModelLibrary | None = None) -> TaskConfig:
    """Build a task configuration from plain data, complete with the defaults of its skill and components.

    Args:
        data: As `roboxim_core.config.parse_yaml` or `to_plain` gives; none: all defaults.
        source: What the data is, for messages.
        library: Where objects and their modifiers are looked up; none: RoboXim's own.

    Raises:
        ConfigError: Listing every wrong key with its path, line and what is allowed.
    """
    if data is None:
        data = {}
    if not isinstance(data, Mapping):
        raise ConfigError(f"{source} is not valid: expected a mapping of keys, got {type(data).__name__}")
    config = from_plain(data, TaskConfig, source=source)
    _require(source, data, ("skill",), config.skill, SKILLS)
    skill = SKILLS[config.skill]
    for role in config.objects:
        _require(source, data, ("objects", role), role, skill.roles)
    for name in config.reset:
        _require(source, data, ("reset", name), name, COMPONENTS)
    _check_objects(source, data, config, library or ModelLibrary())
    _check_templates(source, data, config, skill.roles)
    parameters: Any = from_plain(_section(data, "parameters"), skill.Parameters, source=f"{source}: parameters")
    given = _section(data, "reset")
    reset: dict[str, Any] = {}
    for name in dict.fromkeys((*skill.components, *given)):
        section = _completed(_section(given, name), skill.reset.get(name, {}))
        reset[name] = from_plain(section, COMPONENTS[name].Config, source=f"{source}: reset.{name}")
    objects = {
        name: config.objects.get(name) or ObjectConfig(models=Choice(values=role.models))
        for name, role in skill.roles.items()
    }
    return replace(
        config,
        parameters=parameters,
        reset=reset,
        objects=objects,
        templates=config.templates or Choice(values=skill.templates[: None if config.paraphrases else 1]),
        max_steps=config.max_steps or skill.max_steps,
    )


def _check_objects(source: str, data: Any, config: TaskConfig, library: ModelLibrary) -> None:
    """Check every model and modifier that may be drawn, so that a typo does not surface at the hundredth episode."""
    places: list[tuple[tuple[str, ...], ObjectConfig | DistractorConfig]] = [
        (("objects", role), objects) for role, objects in config.objects.items()
    ]
    for path, objects in [*places, (("distractors",), config.distractors)]:
        for model in objects.models.values:
            _require(source, data, (*path, "models"), str(model), library.object_ids)
            allowed = library.object_modifiers(str(model))
            for name, choice in objects.modifiers.items():
                where = (*path, "modifiers", name)
                _require(source, data, where, name, allowed)
                for value in choice.values or (choice.lower, choice.upper):
                    assert value is not None
                    allowed[name].check(f"{source} is not valid: {_at(data, where)}", name, value)


def _check_templates(source: str, data: Any, config: TaskConfig, roles: Iterable[str]) -> None:
    """Check that instructions speak of the skill's roles only."""
    for template in config.templates.values if config.templates else ():
        try:
            named = [name for _, name, _, _ in Formatter().parse(str(template)) if name is not None]
        except ValueError as error:
            raise ConfigError(f"{source} is not valid: {_at(data, ('templates',))}: '{template}': {error}") from None
        for name in named:
            _require(source, data, ("templates",), name, roles)


def _require(source: str, data: Any, path: tuple[str, ...], name: str, known: Iterable[str]) -> None:
    """Refuse an unknown name, with its place.

    Raises:
        ConfigError: Listing the known names.
    """
    names = tuple(known)
    if name not in names:
        raise ConfigError(f"{source} is not valid: {_at(data, path)}: unknown name '{name}'; {one_of(names, name)}")


def _at(data: Any, path: tuple[str, ...]) -> str:
    """Return a key's path, with its line when the data came from YAML text."""
    line = ""
    for key in path:
        positions = getattr(data, "lc", None)
        if not isinstance(data, Mapping) or key not in data:
            break
        if positions is not None and key in (positions.data or {}):
            line = f" (line {positions.data[key][0] + 1})"
        data = data[key]
    return ".".join(path) + line


def _completed(section: Any, defaults: Mapping[str, Any]) -> Any:
    """Return a section with a skill's defaults for what it leaves out; it keeps its line numbers."""
    if not isinstance(section, MutableMapping):
        return section
    completed = copy(section)
    for key, value in defaults.items():
        completed.setdefault(key, value)
    return completed


def _section(data: Mapping[str, Any], key: str) -> Any:
    value = data.get(key)
    return {} if value is None else value


def load_task_config(name: str = DEFAULT_TASK) -> TaskConfig:
    """Load ``config/tasks/<name>.yaml``, or a path to a YAML file.

    Raises:
        ConfigError: When there is no such file or it is wrong.
    """
    path = named_config("tasks", name)
    return task_config(load_yaml(path), source=str(path))


def parse_task_config(text: str) -> TaskConfig:
    """Parse a task configuration given as YAML text (what a service request carries).

    Raises:
        ConfigError: When it is wrong.
    """
    return task_config(parse_yaml(text, source="task configuration"))
