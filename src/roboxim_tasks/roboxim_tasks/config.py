"""Task configuration: the tasks to draw and the reset of their scenes.

Skills and reset components declare the classes of their own sections (``parameters``, ``reset``). This module checks
the sections against those classes, so that a wrong key is refused with its line before anything runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import PurePath
from typing import Any, ClassVar

from roboxim_core import limits
from roboxim_core.config import LocatedMap, line_of, located, named_config, parse_yaml
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.merging import merged
from roboxim_core.plain_data.pictures import load_with_textures
from roboxim_core.plain_data.wordings import KIND as WORDINGS
from roboxim_core.plain_data.wordings import wordings_of
from roboxim_core.rates import DEFAULT_RATE_HZ, ticks
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_tasks.checks import (
    Document,
    Path,
    check_arguments,
    check_arm,
    check_exclusions,
    check_names,
    check_objects,
    check_reset,
    check_scene,
    check_templates,
)
from roboxim_tasks.choices import Choice
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.fixed_scene import FIXED, fixed_task_config
from roboxim_tasks.sequences.configuring import with_steps
from roboxim_tasks.sequences.skill import skill_of
from roboxim_tasks.skills import SKILLS, Skill
from roboxim_tasks.skills.from_file import is_skill_file, load_skill_file, placed
from roboxim_tasks.task_config import ObjectConfig, TaskConfig, with_members

DEFAULT_TASK = "pick_cube"
TASK = "task"
"""Key of a mix's exclusions besides the roles."""
SEED_BY = ("index", "cell")


def task_config(data: Any, *, source: str = "task configuration", library: ModelLibrary | None = None) -> TaskConfig:
    """Build a task configuration from plain data, complete with the defaults of its skill and components.

    Args:
        data: As returned by `roboxim_core.config.parse_yaml` or `to_plain`; none: all defaults.
        source: Name of the data's source, for messages.
        library: Library of the objects and their modifiers; none: RoboXim's library.

    Raises:
        ConfigError: When keys are wrong; lists each with its path, line and the allowed values.
    """
    if data is None:
        data = {}
    if not isinstance(data, Mapping):
        raise ConfigError(f"{source} is not valid: expected a mapping of keys, got {type(data).__name__}")
    document, library = Document(source, data), library or ModelLibrary()
    config: TaskConfig = document.build(data, TaskConfig, ())
    if given := config.skill_file or (config.skill if is_skill_file(config.skill) else ""):
        with document.section(("skill",)):
            config = replace(config, skill=load_skill_file(given), skill_file=placed(given))
    config = with_steps(document, with_members(config, library))
    skill = skill_of(config)
    for role in config.objects:
        document.require(("objects", role), role, skill.roles)
    for name in config.reset:
        document.require(("reset", name), name, COMPONENTS)
    check_scene(document, config)
    check_objects(document, config, library)
    check_templates(document, config)
    parameters = document.build(_section(data, "parameters"), skill.Parameters, ("parameters",))
    lenient = merged(_section(data, "parameters"), _section(data, "lenient"))
    given = _section(data, "reset")
    reset: dict[str, Any] = {}
    for name in _in_order((*skill.components, *given)):
        section = _completed(_section(given, name), skill.reset.get(name, {}))
        reset[name] = document.build(section, COMPONENTS[name].Config, ("reset", name))
    objects = {
        name: config.objects.get(name) or ObjectConfig(models=Choice(values=role.models))
        for name, role in skill.roles.items()
    }
    complete = replace(
        config,
        parameters=parameters,
        lenient=document.build(lenient, skill.Parameters, ("lenient",)),
        reset=reset,
        objects=objects,
        templates=_templates(document, config, skill),
        max_steps=config.max_steps or max(0, ticks(skill.max_steps / DEFAULT_RATE_HZ, config.rate_hz)),
    )
    check_arm(document, complete, library)
    check_arguments(document, complete, library)
    check_exclusions(document, complete, library)
    check_reset(document, complete)
    return complete


def _templates(document: Document, config: TaskConfig, skill: Skill) -> Choice:
    """Return a task's templates: its own, or those of its set of wordings, or its skill's.

    A resolved configuration holds the set's name and its templates, which agree.

    Raises:
        ConfigError: When ``templates`` and ``wordings`` are given and differ, or the set is unknown.
    """
    if not config.wordings:
        return config.templates or Choice(values=skill.templates[: None if config.paraphrases else 1])
    with document.section(("wordings",)):
        worded = wordings_of(config.skill, config.wordings)
        if config.templates and tuple(config.templates.values) != tuple(worded):
            raise ConfigError(
                f"'{config.wordings}' and `templates` both give the instructions: leave one of the two out"
            )
        for template in worded:
            try:
                check_names(template, skill)
            except ConfigError as error:
                raise ConfigError(f"{named_config(WORDINGS, config.skill)} is not valid: {error}") from None
    return Choice(values=worded)


def _in_order(names: Iterable[str]) -> list[str]:
    """Return the names of reset components in the order in which they act."""
    order = list(dict.fromkeys(names))
    for name in [name for name in order if COMPONENTS[name].before in order]:
        order.remove(name)
        order.insert(order.index(COMPONENTS[name].before), name)
    return order


def _completed(section: Any, defaults: Mapping[str, Any]) -> Any:
    """Return a section completed with a skill's defaults; the given keys keep their line numbers."""
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
    """Part of a mix: every combination of its tasks and models is a cell with a fixed number of episodes."""

    tasks: tuple[str, ...]
    """Names in ``config/tasks``, or files; each describes one skill. A skill without a task: its defaults."""
    models: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Role to object models, with one cell per model; omitted roles vary as the task says."""
    exclude: tuple[dict[str, str], ...] = ()
    """Cells to leave out: those where ``task`` and all given roles match, e.g. ``{task: pick_up, target: apple}``."""
    episodes: int = 1
    """Episodes of each cell."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys of the task to replace, e.g. ``{reset: {cameras: {names: [right]}}}``; a null removes a key, which then has
    its default, e.g. ``{objects: {target: {modifiers: {color: null}}}}`` for "Pick up the cube"."""
    key: str = ""
    """Name that distinguishes this part's cells from those of other parts with the same tasks and models."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When there is no task, or the number of episodes is out of range.
        """
        if not self.tasks:
            raise ConfigError("tasks must be names of at least one task, got none")
        if not 1 <= self.episodes <= limits.MIX_EPISODES:
            raise ConfigError(f"episodes must be from 1 to {limits.MIX_EPISODES}, got {self.episodes}")

    def name(self, task: str, models: Mapping[str, str]) -> str:
        """Return the key of a cell, e.g. ``pick_up target=apple``; independent of the order of the roles."""
        roles = (f"{role}={models[role]}" for role in sorted(models))
        return " ".join((PurePath(task).stem, *roles, *([self.key] if self.key else [])))


@dataclass(frozen=True, kw_only=True)
class MixConfig:
    """A YAML file of ``config/tasks`` or ``config/suites`` with several tasks: exact episode counts."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("version",)

    cells: tuple[CellConfig, ...]
    """The parts."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys to replace in every task; a null removes a key."""
    seed_by: str = "index"
    """``index``: an episode depends on its index in the run; ``cell``: on its cell and its number there, so mixes with
    other cells or counts have the same episodes in shared cells."""

    version: int = 0
    """Version of a suite: results of two versions are not compared; 0: no suite."""

    def __post_init__(self) -> None:
        """Check that there is a cell.

        Raises:
            ConfigError: When there is no cell, or ``seed_by`` is unknown.
        """
        if self.seed_by not in SEED_BY:
            raise ConfigError(f"seed_by '{self.seed_by}' is unknown; {one_of(SEED_BY, self.seed_by)}")
        if not self.cells:
            raise ConfigError("cells must hold at least one part, got none")


@dataclass(frozen=True, kw_only=True)
class TaskMix:
    """Several task configurations, each with an exact number of episodes.

    Cells alternate in proportion to their counts, so that any first part of the dataset is balanced too. The order is a
    function of the index; it repeats after all episodes.
    """

    cells: tuple[TaskConfig, ...]
    """One configuration per cell."""
    counts: tuple[int, ...]
    """Episodes of each."""
    keys: tuple[str, ...]
    """Key of each, e.g. ``pick_up target=apple``; recorded as ``drawn["cell"]``."""
    tasks: tuple[str, ...]
    """Name of each one's task; recorded as ``drawn["task"]``."""
    seed_by: str = "index"
    """``index``: an episode is drawn from its index in the run; ``cell``: from its cell's key and its number there."""

    def __post_init__(self) -> None:
        """Check the counts.

        Raises:
            ConfigError: When there are too many cells.
        """
        if len(self.cells) > limits.MIX_CELLS:
            raise ConfigError(f"a mix may have {limits.MIX_CELLS} cells, got {len(self.cells)}")

    @property
    def order(self) -> Iterator[tuple[int, int]]:
        """Cell of each episode, and the episode's number within the cell."""
        return (_turn(self.counts, place) for place in range(sum(self.counts)))

    def at(self, index: int) -> tuple[TaskConfig, int]:
        """Return the configuration of an episode and its number within its cell."""
        rounds, place = divmod(index, sum(self.counts))
        cell, number = _turn(self.counts, place)
        return self.cells[cell], rounds * self.counts[cell] + number

    def drawn(self, index: int) -> dict[str, str]:
        """Return the names that an episode's task records: ``task``, ``cell`` and, if seeds go by cell, the number."""
        cell, _ = _turn(self.counts, index % sum(self.counts))
        names = {TASK: self.tasks[cell], CELL: self.keys[cell]}
        return names | ({CELL_NUMBER: str(self.at(index)[1])} if self.seed_by == "cell" else {})


_SCALE = 2**128
"""Factor that maps fractions with denominators up to 10^12 to integers and keeps different fractions different."""


@lru_cache(maxsize=4096)
def _turn(counts: tuple[int, ...], place: int) -> tuple[int, int]:
    """Return the cell at a place in the order, and the number within the cell, without computing the whole order.

    Episode k of a cell with n episodes has the key (k + 1/2) / n. Episodes are sorted by key, then by cell. A cell is
    at most half an episode ahead of its share or behind it, so it suffices to sort the episodes within as many places
    as there are cells.
    """
    total, slack = sum(counts), len(counts)
    near, skipped = [], 0
    for cell, count in enumerate(counts):
        first = max(0, -((total - 2 * (place - slack) * count) // (2 * total)))
        end = min(count, (2 * (place + slack) * count - total) // (2 * total) + 1)
        skipped += first
        near += [((2 * k + 1) * _SCALE // count, cell, k) for k in range(first, end)]
    _, cell, number = sorted(near)[place - skipped]
    return cell, number


def task_mix(data: Any, *, source: str = "task mix", library: ModelLibrary | None = None) -> TaskMix:
    """Build a mix from plain data; arguments as of `task_config`.

    Raises:
        ConfigError: When keys are wrong; lists each with its path, line and the allowed values. Lines are those of the
            mix, unless the message names a task's file.
    """
    document, library = Document(source, data), library or ModelLibrary()
    mix: MixConfig = document.build(data, MixConfig, ())
    for number, cell in enumerate(mix.cells):
        _check_cell(document, number, cell, library)
    used = {name: (number, place) for number, cell in enumerate(mix.cells) for place, name in enumerate(cell.tasks)}
    tasks = {}
    for name, (number, place) in used.items():
        if is_skill_file(name) or (name in SKILLS and name not in config_names("tasks")):
            tasks[name] = {"skill": name}
            continue
        with document.section(("cells", number, "tasks", place)):
            path = named_config("tasks", name)
        tasks[name] = located(load_with_textures(path), str(path))
        if "cells" in (tasks[name] or {}):
            raise document.error(
                ("cells", number, "tasks", place), f"'{name}' is a mix itself; name tasks of one skill"
            )
    cells, counts, keys, names_of_tasks = [], [], [], []
    for number, cell in enumerate(mix.cells):
        given = data["cells"][number]
        for task, *models in itertools.product(cell.tasks, *map(library.expanded, cell.models.values())):
            names = dict(zip(cell.models, models, strict=True))
            if any((names | {TASK: task}).items() >= excluded.items() for excluded in cell.exclude):
                continue
            plain = tasks[task]
            for change in (_section(data, "set"), _section(given, "set"), _models(given, names)):
                plain = merged(plain, change)
            cells.append(task_config(plain, source=f"{source}: cells.{number}, task '{task}'", library=library))
            counts.append(cell.episodes)
            keys.append(cell.name(task, names))
            names_of_tasks.append(PurePath(task).stem)
            if mix.seed_by == "cell" and keys[-1] in keys[:-1]:
                raise document.error(
                    ("cells", number),
                    f"a second cell '{keys[-1]}' would have the same scenes; give this part a key of its own",
                )
    if not cells:
        raise document.error(("cells",), "every cell is excluded; exclude less")
    return TaskMix(
        cells=tuple(cells), counts=tuple(counts), keys=tuple(keys), tasks=tuple(names_of_tasks), seed_by=mix.seed_by
    )


def _check_cell(document: Document, number: int, cell: CellConfig, library: ModelLibrary) -> None:
    """Check that a cell's exclusions name tasks and models of the cell; a typo would exclude nothing."""
    path: Path = ("cells", number)
    for role, models in cell.models.items():
        if not models:
            raise document.error((*path, "models", role), "needs at least one model, got none")
    for place, excluded in enumerate(cell.exclude):
        for key, value in excluded.items():
            where = (*path, "exclude", place, key)
            document.require(where, key, (TASK, *cell.models))
            document.require(where, value, cell.tasks if key == TASK else library.expanded(cell.models[key]))


def _models(cell: Any, names: Mapping[str, str]) -> Any:
    """Return the changes to a task that give each role of a cell one model, with the lines of the cell's ``models``."""
    given = cell.get("models")
    lines = {role: line_of(given, role) for role in names}
    return (
        LocatedMap(
            {
                "objects": LocatedMap(
                    {
                        role: LocatedMap({"models": {"values": [model]}}, {"models": lines[role]})
                        for role, model in names.items()
                    },
                    lines,
                )
            },
            {"objects": line_of(cell, "models")},
        )
        if names
        else {}
    )


def any_task_config(data: Any, *, source: str, library: ModelLibrary | None = None) -> TaskConfig | TaskMix:
    """Build a task, or a mix if the data has ``cells``, or a task with a given scene if it has ``fixed``."""
    if isinstance(data, Mapping) and FIXED in data:
        return fixed_task_config(data, source=source, library=library or ModelLibrary())
    build = task_mix if isinstance(data, Mapping) and "cells" in data else task_config
    return build(data, source=source, library=library)


def load_task_config(name: str = DEFAULT_TASK, library: ModelLibrary | None = None) -> TaskConfig | TaskMix:
    """Load ``config/tasks/<name>.yaml``, or a path to a YAML file.

    Args:
        name: Name of a task, or a path.
        library: As for `task_config`.

    Raises:
        ConfigError: When the file is missing or invalid.
    """
    path = named_config("tasks", name)
    data = load_with_textures(path)
    require_content(data, source=str(path))
    return any_task_config(data, source=str(path), library=library)


def require_content(data: Any, *, source: str) -> None:
    """Refuse a task file without content, which a crashed editor or a full disk leaves.

    Args:
        data: What the file holds.
        source: The file, for messages.

    Raises:
        ConfigError: When it holds nothing.
    """
    if data is None:
        raise ConfigError(f"{source} is empty; expected a task, at least 'skill: NAME'")


def parse_task_config(text: str) -> TaskConfig | TaskMix:
    """Parse a task configuration given as YAML text, as service requests carry it.

    Raises:
        ConfigError: When the configuration is invalid.
    """
    return any_task_config(parse_yaml(text, source="task configuration"), source="task configuration")
