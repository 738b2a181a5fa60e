"""Checks of a task's configuration when it is loaded: a typo must not surface at the hundredth episode.

Every error names the file, the key, its line if known, and the allowed values.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any, get_type_hints

from roboxim_core.config import complaint_at, from_plain, section_of
from roboxim_core.errors import ConfigError, RoboximError, one_of
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL, ModifierModel
from roboxim_core.plain_data.wordings import names_in
from roboxim_core.specs import Scalar
from roboxim_tasks.arms import check_grasped, check_skills
from roboxim_tasks.choices import Choice
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.roles import SPOKEN, Role
from roboxim_tasks.sampling.exclusions import MODEL, all_excluded
from roboxim_tasks.sequences.skill import skill_of
from roboxim_tasks.skills import SKILLS, Skill
from roboxim_tasks.task_config import DistractorConfig, ObjectConfig, StepConfig, TaskConfig

MAX_COMBINATIONS = 1000
"""Largest number of combinations of arguments that are all checked."""

Path = tuple[str | int, ...]


@dataclass(frozen=True)
class Document:
    """Plain data with its source, for messages."""

    source: str
    """Name of the data's source, e.g. a file."""
    data: Any
    """All data, as returned by `roboxim_core.config.parse_yaml`."""

    def error(self, path: Path, problem: object) -> ConfigError:
        """Return the error of a key: ``task.yaml is not valid: objects.target (line 3): ...``.

        Args:
            path: The key, or the section that a class refused.
            problem: The problem; if it concerns a key of the section, the text begins with that key.
        """
        section, line = section_of(self.data, path)
        at, line = complaint_at(str(problem), section, ".".join(map(str, path)), line)
        return ConfigError(f"{self.source} is not valid: {f'{at} ({line})' if line else at}: {problem}")

    @contextmanager
    def section(self, path: Path) -> Iterator[None]:
        """Add the location of the section, or of the key that the message begins with, to errors of a check.

        Raises:
            ConfigError: When the check fails; replaces the check's error.
        """
        try:
            yield
        except RoboximError as error:
            raise self.error(path, error) from None

    def require(self, path: Path, name: str, known: Iterable[str]) -> None:
        """Refuse an unknown name.

        Raises:
            ConfigError: When the name is unknown; lists the known names.
        """
        names = tuple(known)
        if name not in names:
            raise self.error(path, f"unknown name '{name}'; {one_of(names, name)}")

    def build(self, data: Any, cls: Any, path: Path) -> Any:
        """Build a value of a dataclass from a part of the data, or from the completed part.

        Raises:
            ConfigError: When keys are wrong; lists all of them.
        """
        line = section_of(self.data, path)[1]
        return from_plain(data, cls, source=self.source, path=".".join(map(str, path)), line=line)


def check_scene(document: Document, config: TaskConfig) -> None:
    """Check the base scene of a task.

    Raises:
        ConfigError: When scene or arm are unknown, the file is invalid, or the control rate does not suit it.
    """
    with document.section(("scene",)):
        scene = config.base_scene()
    with document.section(("robot",)):
        library = ModelLibrary()
        if config.robot and config.robot not in library.robot_ids:
            raise ConfigError(f"unknown robot '{config.robot}'; {one_of(library.robot_ids, config.robot)}")
    with document.section(("rate_hz",)):
        replace(scene, control_rate_hz=config.rate_hz)


def check_arm(document: Document, config: TaskConfig, library: ModelLibrary) -> None:
    """Check that the arm can perform the skill and grasp what may be drawn.

    Raises:
        ConfigError: Saying what the arm lacks, and what it can do.
    """
    robot = library.robot(config.base_scene().robot.model)
    with document.section(("robot",)):
        check_skills(config, robot)
    for name, role in skill_of(config).roles.items():
        with document.section(("objects", name)):
            check_grasped(role, config.objects[name], robot, library)


def check_objects(document: Document, config: TaskConfig, library: ModelLibrary) -> None:
    """Check every model and modifier that may be drawn.

    At least one of the models must take each modifier and allow each value. A model is drawn without the modifiers that
    it does not take.

    Raises:
        ConfigError: On the first invalid model or modifier.
    """
    roles, known = skill_of(config).roles, library.known_objects
    places: list[tuple[Path, ObjectConfig | DistractorConfig, Role]] = [
        (("objects", name), objects, roles[name]) for name, objects in config.objects.items()
    ]
    for path, objects, role in [*places, (("distractors",), config.distractors, Role())]:
        with document.section(path):
            objects.models.require_words("models", "ids of object models")
        for model in objects.always if isinstance(objects, DistractorConfig) else ():
            document.require((*path, "always"), model, known)
        models = [str(model) for model in objects.models.values]
        for model in models:
            document.require((*path, "models"), model, known)
            if path[0] == "objects":
                _check_role(document, (*path, "models"), model, str(path[1]), role, library)
        for name, choice in objects.modifiers.items():
            where = (*path, "modifiers", name)
            takers = _takers(name, models, library)
            if not takers:
                document.require(where, name, _kinds(models, library))
            for value in choice.ends:
                _check_value(document, where, name, value, takers)


def check_arguments(document: Document, config: TaskConfig, library: ModelLibrary) -> None:
    """Check that arguments are parameters of the skill, and that all values are valid, alone and together.

    Args:
        document: The task's data.
        config: The task, complete.
        library: Library of the models.

    Raises:
        ConfigError: On the first invalid argument.
    """
    models = {
        role: [library.object(str(model)) for model in objects.models.values]
        for role, objects in config.objects.items()
    }
    for number, step in enumerate(config.steps):
        own = {role: models[filled] for role, filled in step.roles.items()}
        _check_arguments(document, ("steps", number), SKILLS[step.skill], step, own)
    if not config.steps:
        _check_arguments(document, (), skill_of(config), config, models)
    elif reason := _mismatch(skill_of(config), config.parameters, models):
        raise document.error(("objects",), reason)


def _check_arguments(
    document: Document,
    path: Path,
    skill: Skill,
    given: TaskConfig | StepConfig,
    models: Mapping[str, Sequence[ObjectModel]],
) -> None:
    """Check the parameters, lenient parameters and arguments of a task of one skill, or of a step."""
    hints = get_type_hints(skill.Parameters)
    for name, choice in given.arguments.items():
        document.require((*path, "arguments", name), name, asdict(given.parameters))
        with document.section((*path, "arguments", name)):
            if hints[name] is float:
                choice.require_numbers("values")
            elif wrong := [value for value in choice.ends if type(value) is not hints[name]]:
                raise ConfigError(f"expected {hints[name].__name__}, got {wrong[0]!r}")
    for key, base in (("parameters", given.parameters), ("lenient", given.lenient)):
        for drawn in _combinations(given.arguments):
            where = ("arguments", *drawn)[:2] if len(drawn) == 1 else ("arguments",) if drawn else (key,)
            with document.section((*path, *where)):
                parameters = replace(base, **drawn)
                skill.check(parameters, models)
            if reason := _mismatch(skill, parameters, models):
                raise document.error(path or ("objects",), reason)


def _mismatch(skill: Skill, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> str:
    """Return why no combination of models is valid; empty if one is."""
    reasons: dict[str, None] = {}
    for combination in itertools.product(*models.values()):
        if not (reason := skill.mismatch(parameters, dict(zip(models, combination, strict=True)))):
            return ""
        reasons[reason] = None
    return "; ".join(reasons)


def _combinations(arguments: Mapping[str, Choice]) -> Iterator[dict[str, Scalar]]:
    """Yield values of arguments, for ranges their ends: all combinations or, if they are too many, one by one."""
    if math.prod(len(choice.ends) for choice in arguments.values()) <= MAX_COMBINATIONS:
        for values in itertools.product(*(choice.ends for choice in arguments.values())):
            yield dict(zip(arguments, values, strict=True))
    else:
        for name, choice in arguments.items():
            yield from ({name: value} for value in choice.ends)


def check_reset(document: Document, config: TaskConfig) -> None:
    """Check that the reset components of a complete task suit its skill.

    Raises:
        ConfigError: On the first component that does not.
    """
    for name, section in config.reset.items():
        with document.section(("reset", name)):
            COMPONENTS[name].check(section, tuple(skill_of(config).roles), config)


def check_templates(document: Document, config: TaskConfig) -> None:
    """Check that instructions name only the skill's roles and words.

    Raises:
        ConfigError: On the first template that names others.
    """
    given: list[tuple[Path, Choice | None, Skill]] = [((), config.templates, skill_of(config))]
    given += [(("steps", n), step.templates, SKILLS[step.skill]) for n, step in enumerate(config.steps)]
    for path, templates, skill in given:
        if templates is None:
            continue
        with document.section(path):
            templates.require_words("templates", "instructions with roles in braces")
        with document.section((*path, "templates")):
            for template in map(str, templates.values):
                check_names(template, skill)


def check_names(template: str, skill: Skill) -> None:
    """Check that a template names only a skill's roles and words.

    Raises:
        ConfigError: When it names others, or its braces are wrong.
    """
    for name in names_in(template):
        if name not in (known := (*skill.roles, *skill.words)):
            raise ConfigError(f"'{template}': unknown name '{name}'; {one_of(known, name)}")


def check_exclusions(document: Document, config: TaskConfig, library: ModelLibrary) -> None:
    """Check that excluded combinations are possible, and leave something to draw.

    Args:
        document: The task's data.
        config: The task, complete: with an entry for each role.
        library: Library of models and modifiers.

    Raises:
        ConfigError: On the first invalid combination.
    """
    roles = skill_of(config).roles
    for number, combination in enumerate(config.exclude):
        for role, wanted in combination.items():
            path: Path = ("exclude", number, role)
            document.require(path, role, roles)
            models = list(library.object_ids)
            if MODEL in wanted:
                document.require((*path, MODEL), str(wanted[MODEL]), library.known_objects)
                _check_role(document, (*path, MODEL), str(wanted[MODEL]), role, roles[role], library)
                models = [str(wanted[MODEL])]
            models = [model for model in models if roles[role].suits(library.object(model))]
            for name, value in wanted.items():
                if name != MODEL:
                    takers = _takers(name, models, library)
                    if not takers:
                        document.require((*path, name), name, (MODEL, *_kinds(models, library)))
                    _check_value(document, (*path, name), name, value, takers)
    if all_excluded(config.objects, config.exclude, library):
        raise document.error(
            ("exclude",),
            "excludes everything that could be drawn; exclude less, or give objects.<role> more models or modifiers",
        )


def _check_role(document: Document, path: Path, model: str, role_name: str, role: Role, library: ModelLibrary) -> None:
    if not role.suits(library.object(model)):
        suited = [name for name in library.object_ids if role.suits(library.object(name))]
        demands = [role.affordance] if role.affordance else []
        if role.max_width_m:
            demands.append(f"at most {100 * role.max_width_m:g} cm wide")
        raise document.error(
            path,
            f"a {model} cannot be the {role_name}, which must be {' and '.join(demands)}; these are: "
            + ", ".join(sorted(suited)),
        )


def _takers(kind: str, models: Iterable[str], library: ModelLibrary) -> list[ModifierModel]:
    """Return the modifiers of a kind that any of the models have."""
    if kind in PHYSICAL:
        return [PHYSICAL[kind]]
    return [taken[kind] for taken in map(library.object_modifiers, models) if kind in taken]


def _kinds(models: Iterable[str], library: ModelLibrary) -> list[str]:
    return sorted({kind for model in models for kind in library.object_modifiers(model)} | set(PHYSICAL))


def _check_value(document: Document, path: Path, kind: str, value: Scalar, takers: list[ModifierModel]) -> None:
    """Refuse a value that none of the modifiers allows."""
    problems = []
    for taker in takers:
        try:
            taker.check("", kind, value)
        except ConfigError as error:
            problems.append(str(error).removeprefix(": "))
        else:
            return
    if kind in SPOKEN:
        words = {word for taker in takers for word in taker.words(kind)}
        raise document.error(path, f"unknown {kind} '{value}'; {one_of(words, str(value))}")
    raise document.error(path, problems[0])
