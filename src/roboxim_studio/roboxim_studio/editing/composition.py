"""A task that is being composed: the plain data of its YAML, and edits of it. Knows no page.

It keeps the file's own data, so keys without an input in the studio are preserved. Every edit is checked as `generate`
would check the file, and refused by the same rules.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import yaml

from roboxim_core.config import parse_yaml
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import ModifierModel
from roboxim_core.plain_data import yaml_text
from roboxim_core.specs import Scalar
from roboxim_runs.episodes.task_choice import set_models, task_text
from roboxim_tasks.choices import Choice
from roboxim_tasks.config import task_config
from roboxim_tasks.fixed_scene import FIXED
from roboxim_tasks.roles import Role
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.task_config import DistractorConfig, ObjectConfig, TaskConfig

DISTRACTORS = "distractors"
"""Name of the distractors where a role is expected."""
KEPT = ("robot", "rate_hz", DISTRACTORS)
"""Keys that a change of the skill keeps."""


@dataclass(frozen=True, kw_only=True)
class Composition:
    """A task of one skill."""

    data: Mapping[str, Any]
    """Plain data of its YAML file."""
    config: TaskConfig
    """The same, complete."""

    @property
    def text(self) -> str:
        """The task's YAML."""
        return str(yaml.safe_dump(dict(self.data), sort_keys=False, allow_unicode=True, default_flow_style=None))

    @property
    def roles(self) -> dict[str, ObjectConfig | DistractorConfig]:
        """Role to the objects that may fill it; the distractors last."""
        return {**self.config.objects, DISTRACTORS: self.config.distractors}

    @property
    def templates(self) -> tuple[str, ...]:
        """Templates of the instruction."""
        assert self.config.templates is not None
        return tuple(map(str, self.config.templates.values))

    def suited(self, role: str, library: ModelLibrary) -> tuple[str, ...]:
        """Return the models that can fill a role."""
        wanted = SKILLS[self.config.skill].roles[role] if role != DISTRACTORS else Role()
        return tuple(name for name in library.object_ids if wanted.suits(library.object(name)))

    def modifiers(self, role: str, library: ModelLibrary) -> dict[str, ModifierModel]:
        """Return the modifiers that a model of a role takes; of several models, each kind as the first takes it."""
        found: dict[str, ModifierModel] = {}
        for model in self.roles[role].models.values:
            found = {**library.object_modifiers(str(model)), **found}
        return found

    def words(self, role: str, kind: str, library: ModelLibrary) -> tuple[str, ...]:
        """Return the words of a modifier that any model of a role takes."""
        takers = (library.object_modifiers(str(model)) for model in self.roles[role].models.values)
        return tuple(dict.fromkeys(word for taken in takers if kind in taken for word in taken[kind].words(kind)))


def composed(text: str) -> Composition:
    """Return the composition of a task's YAML.

    Raises:
        ConfigError: When it is no valid task, or none of one skill with a scene that is drawn.
    """
    data = parse_yaml(text, source="the task") or {}
    if not isinstance(data, Mapping):
        raise ConfigError(f"the task is not valid: expected a mapping of keys, got {type(data).__name__}")
    for key, why in (("cells", "a mix of tasks"), ("steps", "a task of several steps"), (FIXED, "a given scene")):
        if key in data:
            raise ConfigError(f"this is {why}: it can be drawn here, but not composed; choose a task of one skill")
    if (skill := data.get("skill", "pick_up")) not in SKILLS:
        raise ConfigError(f"the skill '{skill}' is a file's: it can be drawn here, but not composed")
    return _checked(yaml_text.plain(data))


def with_skill(made: Composition, skill: str) -> Composition:
    """Return the task of another skill, as RoboXim ships it, with the same robot and distractors.

    Raises:
        ConfigError: When the skill is unknown, or cannot be used with these distractors.
    """
    if skill not in SKILLS:  # a file of a skill is code
        raise ConfigError(f"unknown skill '{skill}'; {one_of(SKILLS, skill)}")
    kept = {key: made.data[key] for key in KEPT if key in made.data}
    return _checked({**(yaml_text.parse(task_text(skill=skill)) or {}), **copy.deepcopy(kept)})


def with_models(made: Composition, role: str, models: Sequence[str], library: ModelLibrary) -> Composition:
    """Return the task with other models in a role; modifiers that none of them takes are left out.

    Args:
        made: The task.
        role: A role, or ``distractors``.
        models: Ids of the models.
        library: Library of the models.

    Raises:
        ConfigError: When there is none, or one does not suit the role.
    """
    if not models:
        raise ConfigError(f"{role} needs at least one model")
    data = _data(made)
    set_models(_section(data, made, role), models, library)
    return _checked(data)


def with_modifier(made: Composition, role: str, kind: str, choice: Choice | None) -> Composition:
    """Return the task with other values of a modifier.

    Args:
        made: The task.
        role: A role, or ``distractors``.
        kind: The modifier.
        choice: Its values at random, or its range; none: every object has its model's default.

    Raises:
        ConfigError: When a value is not allowed.
    """
    data = _data(made)
    section = _section(data, made, role)
    modifiers = {key: old for key, old in (section.get("modifiers") or {}).items() if key != kind}
    if choice is not None:
        ends = {"values": list(choice.values)} if choice.values else {"lower": choice.lower, "upper": choice.upper}
        modifiers[kind] = ends
    section["modifiers"] = modifiers
    return _checked(data)


def with_templates(made: Composition, templates: Sequence[str]) -> Composition:
    """Return the task with other templates of its instruction; none: the skill's first one.

    Raises:
        ConfigError: When a template names what the skill does not have.
    """
    data = _data(made)
    for key in ("templates", "wordings", "paraphrases"):
        data.pop(key, None)
    if templates:
        data["templates"] = {"values": list(templates)}
    return _checked(data)


def with_distractors(made: Composition, minimum: int, maximum: int) -> Composition:
    """Return the task with another number of distractors.

    Raises:
        ConfigError: When the range is empty or too large.
    """
    data = _data(made)
    _section(data, made, DISTRACTORS).update(minimum=minimum, maximum=maximum)
    return _checked(data)


def with_parameter(made: Composition, name: str, value: Scalar) -> Composition:
    """Return the task with another parameter of its skill.

    Raises:
        ConfigError: When the skill refuses it.
    """
    data = _data(made)
    default = parameter_defaults(made).get(name)
    parameters = {key: old for key, old in (data.get("parameters") or {}).items() if key != name}
    if value != default:
        parameters[name] = value
    data["parameters"] = parameters
    return _checked(data)


def parameter_defaults(made: Composition) -> dict[str, Scalar]:
    """Return the parameters of a task's skill with their defaults."""
    kinds = fields(SKILLS[made.config.skill].Parameters)
    return {item.name: item.default for item in kinds if item.default is not MISSING}


def shown(choice: Choice | None) -> str:
    """Return a choice for reading."""
    if choice is None:
        return "default"
    return ", ".join(map(str, choice.values)) if choice.values else f"{choice.lower:g} to {choice.upper:g}"


def _data(made: Composition) -> dict[str, Any]:
    return copy.deepcopy(dict(made.data))


def _section(data: dict[str, Any], made: Composition, role: str) -> dict[str, Any]:
    """Return a role's part of the data, with the models that it has by default.

    Raises:
        ConfigError: When the skill has no such role.
    """
    if role not in made.roles:
        raise ConfigError(f"'{made.config.skill}' has no role '{role}'; {one_of(made.roles, role)}")
    above = data if role == DISTRACTORS else data.setdefault("objects", {})
    section: dict[str, Any] = above.get(role) or {}
    section.setdefault("models", {"values": list(made.roles[role].models.values)})
    above[role] = section
    return section


def _checked(data: dict[str, Any]) -> Composition:
    return Composition(data=data, config=task_config(data, source="the task"))
