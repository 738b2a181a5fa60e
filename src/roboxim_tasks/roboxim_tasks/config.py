"""Task configuration: which tasks are drawn and how their scenes are reset.

Skills and reset components bring configurations of their own (``parameters``, ``reset``); they are checked here,
against the class that the named skill or component declares, so that a wrong key is refused with its line before
anything runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, MutableMapping
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from string import Formatter
from typing import Any

from roboxim_core.config import from_plain, load_yaml, named_config, parse_yaml
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL, ModifierModel
from roboxim_core.specs import Scalar
from roboxim_tasks.choices import Choice
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.skills import SKILLS, Role
from roboxim_tasks.visible import VisibleConfig

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
    stay_m: float = 0.0
    """An episode has failed once a distractor was moved further than this [m]; 0: they may be moved."""

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ConfigError: When it is empty or too large.
        """
        if self.stay_m < 0:
            raise ConfigError(f"stay_m must be >= 0, got {self.stay_m:g}")
        if not 0 <= self.minimum <= self.maximum <= MAX_DISTRACTORS:
            raise ConfigError(
                f"needs 0 <= minimum <= maximum <= {MAX_DISTRACTORS} distractors, got {self.minimum} and {self.maximum}"
            )


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """A YAML file of ``config/tasks`` that describes one skill; see `TaskMix` for several."""

    skill: str = "pick_up"
    """Registered skill."""
    parameters: Any = None
    """The skill's own parameters and thresholds, as demonstrations must meet them."""
    lenient: Any = None
    """Parameters that differ where a policy is evaluated (purpose ``eval``)."""
    arguments: dict[str, Choice] = field(default_factory=dict)
    """Parameters that vary from episode to episode, e.g. ``{drawer: {values: [top, middle], order: in_order}}``."""
    templates: Choice | None = None
    """Instruction templates with roles in braces, e.g. ``Pick up the {target}``; none: the skill's."""
    paraphrases: bool = False
    """Without templates: whether all of the skill's are used, or the first alone."""
    objects: dict[str, ObjectConfig] = field(default_factory=dict)
    """Role of the skill to the objects that may fill it."""
    exclude: tuple[dict[str, dict[str, Scalar]], ...] = ()
    """Combinations of objects that are never drawn: role to ``model`` and modifiers, all of which agree."""
    distractors: DistractorConfig = DistractorConfig()
    """Further objects."""
    scene: str = "empty_table"
    """Name of a scene in ``config/scenes``."""
    reset: dict[str, Any] = field(default_factory=dict)
    """Reset component to its configuration; the skill's own components need not be named."""
    visible: VisibleConfig = VisibleConfig()
    """What the cameras that are fixed in the world must see of the objects that the instruction names."""
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

    def at(self, index: int) -> tuple[TaskConfig, int]:
        """Return the configuration of an episode and the number that its ordered lists go by: as given."""
        return self, index


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
    for number, combination in enumerate(config.exclude):
        for role in combination:
            _require(source, data, ("exclude",), role, skill.roles, f"exclude[{number}]")
    _check_templates(source, data, config, (*skill.roles, *skill.words))
    parameters: Any = from_plain(_section(data, "parameters"), skill.Parameters, source=f"{source}: parameters")
    given = _section(data, "reset")
    reset: dict[str, Any] = {}
    for name in dict.fromkeys((*skill.components, *given)):
        section = _completed(_section(given, name), skill.reset.get(name, {}))
        reset[name] = from_plain(section, COMPONENTS[name].Config, source=f"{source}: reset.{name}")
    lenient = {**_section(data, "parameters"), **_section(data, "lenient")}
    _check_arguments(source, data, config, parameters)
    objects = {
        name: config.objects.get(name) or ObjectConfig(models=Choice(values=role.models))
        for name, role in skill.roles.items()
    }
    return replace(
        config,
        parameters=parameters,
        lenient=from_plain(lenient, skill.Parameters, source=f"{source}: lenient"),
        reset=reset,
        objects=objects,
        templates=config.templates or Choice(values=skill.templates[: None if config.paraphrases else 1]),
        max_steps=config.max_steps or skill.max_steps,
    )


def _check_objects(source: str, data: Any, config: TaskConfig, library: ModelLibrary) -> None:
    """Check every model and modifier that may be drawn, so that a typo does not surface at the hundredth episode.

    A modifier must be one that some of the models take, and a value one that some of them allow; a model is drawn
    without what it does not take.
    """
    roles = SKILLS[config.skill].roles
    places: list[tuple[tuple[str, ...], ObjectConfig | DistractorConfig, Role]] = [
        (("objects", name), objects, roles[name]) for name, objects in config.objects.items()
    ]
    for path, objects, role in [*places, (("distractors",), config.distractors, Role())]:
        models = [str(model) for model in objects.models.values]
        for model in models:
            _require(source, data, (*path, "models"), model, library.object_ids)
            if path[0] == "objects" and not role.suits(library.object(model)):
                suited = [name for name in library.object_ids if role.suits(library.object(name))]
                raise ConfigError(
                    f"{source} is not valid: {_at(data, (*path, 'models'))}: a {model} cannot be the {path[1]} of "
                    f"{config.skill}, which must be {role.affordance or 'smaller'}; {one_of(suited, model)}"
                )
        for name, choice in objects.modifiers.items():
            where = (*path, "modifiers", name)
            takers = [taken[name] for taken in map(library.object_modifiers, models) if name in taken]
            if name in PHYSICAL:
                takers = [PHYSICAL[name]]
            if not takers:
                known = sorted({kind for model in models for kind in library.object_modifiers(model)} | set(PHYSICAL))
                _require(source, data, where, name, known)
            for value in choice.ends:
                if not any(_allows(taker, name, value) for taker in takers):
                    takers[0].check(f"{source} is not valid: {_at(data, where)}", name, value)


def _allows(modifier: ModifierModel, kind: str, value: Scalar) -> bool:
    try:
        modifier.check("", kind, value)
    except ConfigError:
        return False
    return True


def _check_arguments(source: str, data: Any, config: TaskConfig, parameters: Any) -> None:
    """Check that what varies are parameters of the skill, and each value is one that it takes."""
    for name, choice in config.arguments.items():
        _require(source, data, ("arguments",), name, asdict(parameters), f"arguments.{name}")
        for value in choice.ends:
            plain = asdict(parameters) | {name: value}
            from_plain(plain, type(parameters), source=f"{source}: {_at(data, ('arguments', name))}")


def _check_templates(source: str, data: Any, config: TaskConfig, roles: Iterable[str]) -> None:
    """Check that instructions speak of the skill's roles only."""
    for template in config.templates.values if config.templates else ():
        try:
            named = [name for _, name, _, _ in Formatter().parse(str(template)) if name is not None]
        except ValueError as error:
            raise ConfigError(f"{source} is not valid: {_at(data, ('templates',))}: '{template}': {error}") from None
        for name in named:
            _require(source, data, ("templates",), name, roles)


def _require(source: str, data: Any, path: tuple[str, ...], name: str, known: Iterable[str], place: str = "") -> None:
    """Refuse an unknown name, with its place.

    Raises:
        ConfigError: Listing the known names.
    """
    names = tuple(known)
    if name not in names:
        raise ConfigError(
            f"{source} is not valid: {place or _at(data, path)}: unknown name '{name}'; {one_of(names, name)}"
        )


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


@dataclass(frozen=True, kw_only=True)
class CellConfig:
    """Part of a mix: every combination of its tasks and models is a cell with a number of episodes of its own."""

    tasks: tuple[str, ...]
    """Names in ``config/tasks``, or files, each of one skill."""
    models: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Role to object models, each of which makes a cell of its own; roles left out vary as the task says."""
    exclude: tuple[dict[str, str], ...] = ()
    """Cells that are left out: ``task`` and roles, all of which agree, e.g. ``{task: pick_up, target: apple}``."""
    episodes: int = 1
    """Episodes of each cell."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys of the task that are replaced, e.g. ``{reset: {cameras: {names: [right]}}}``."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When there is no episode or no task.
        """
        if self.episodes < 1 or not self.tasks:
            raise ConfigError(f"a cell needs episodes >= 1 and at least one task, got {self.episodes}, {self.tasks}")


@dataclass(frozen=True, kw_only=True)
class MixConfig:
    """A YAML file of ``config/tasks`` with several tasks: a dataset with exact counts."""

    cells: tuple[CellConfig, ...]
    """The parts."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys that are replaced in every task."""


@dataclass(frozen=True, kw_only=True)
class TaskMix:
    """Several task configurations, each with an exact number of episodes.

    Cells take turns in proportion to their counts, so that any beginning of the dataset is balanced as well. The order
    is a function of the index; after all episodes it starts again.
    """

    cells: tuple[TaskConfig, ...]
    """One configuration per cell."""
    counts: tuple[int, ...]
    """Episodes of each."""

    @property
    def order(self) -> tuple[tuple[int, int], ...]:
        """Cell, and number within it, of each episode."""
        return _turns(self.counts)

    def at(self, index: int) -> tuple[TaskConfig, int]:
        """Return the configuration of an episode and its number within its cell."""
        rounds, place = divmod(index, sum(self.counts))
        cell, number = self.order[place]
        return self.cells[cell], rounds * self.counts[cell] + number


@lru_cache(maxsize=8)
def _turns(counts: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    slots = [((k + 0.5) / count, cell, k) for cell, count in enumerate(counts) for k in range(count)]
    return tuple((cell, k) for _, cell, k in sorted(slots))


def task_mix(data: Any, *, source: str = "task mix") -> TaskMix:
    """Build a mix from plain data.

    Raises:
        ConfigError: Listing every wrong key with its path, line and what is allowed.
    """
    mix = from_plain(data, MixConfig, source=source)
    cells, counts = [], []
    used = {name for cell in mix.cells for name in cell.tasks}
    tasks = {name: to_builtin(load_yaml(named_config("tasks", name))) for name in sorted(used)}
    for number, cell in enumerate(mix.cells):
        for task, *models in itertools.product(cell.tasks, *cell.models.values()):
            names = dict(zip(cell.models, models, strict=True))
            if any((names | {"task": task}).items() >= excluded.items() for excluded in cell.exclude):
                continue
            plain = tasks[task]
            for change in (
                mix.set,
                cell.set,
                {"objects": {role: {"models": {"values": [m]}} for role, m in names.items()}},
            ):
                plain = merged(plain, change)
            cells.append(task_config(plain, source=f"{source}: cells[{number}], task '{task}'"))
            counts.append(cell.episodes)
    if not cells:
        raise ConfigError(f"{source} is not valid: every cell is excluded")
    return TaskMix(cells=tuple(cells), counts=tuple(counts))


def merged(base: Any, change: Any) -> Any:
    """Return plain data with keys replaced, mapping by mapping; a list or a choice is replaced as a whole."""
    if not isinstance(base, Mapping) or not isinstance(change, Mapping) or "values" in change or "lower" in change:
        return change
    return {**base, **{key: merged(base.get(key), value) for key, value in change.items()}}


def to_builtin(data: Any) -> Any:
    """Return YAML data without the line numbers that its containers carry."""
    if isinstance(data, Mapping):
        return {str(key): to_builtin(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [to_builtin(value) for value in data]
    return data


def any_task_config(data: Any, *, source: str) -> TaskConfig | TaskMix:
    """Build a task configuration, or a mix when there are ``cells``; see `task_config` and `task_mix`."""
    return (
        task_mix(data, source=source)
        if isinstance(data, Mapping) and "cells" in data
        else task_config(data, source=source)
    )


def load_task_config(name: str = DEFAULT_TASK) -> TaskConfig | TaskMix:
    """Load ``config/tasks/<name>.yaml``, or a path to a YAML file.

    Raises:
        ConfigError: When there is no such file or it is wrong.
    """
    path = named_config("tasks", name)
    return any_task_config(load_yaml(path), source=str(path))


def parse_task_config(text: str) -> TaskConfig | TaskMix:
    """Parse a task configuration given as YAML text (what a service request carries).

    Raises:
        ConfigError: When it is wrong.
    """
    return any_task_config(parse_yaml(text, source="task configuration"), source="task configuration")
