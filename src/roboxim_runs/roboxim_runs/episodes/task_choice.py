"""Conversion of the command line's task options to the YAML text for the task node."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from math import gcd
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from roboxim_core.config import config_dirs, named_config, parse_yaml
from roboxim_core.config_folders import config_dir, config_names, is_path
from roboxim_core.errors import ConfigError, counted, one_of
from roboxim_core.plain_data import yaml_text
from roboxim_core.plain_data.documents import read_text
from roboxim_core.plain_data.merging import merged
from roboxim_core.plain_data.pictures import load_with_textures, texture_name
from roboxim_core.seeds import CELL

if TYPE_CHECKING:
    from roboxim_core.models.library import ModelLibrary
    from roboxim_tasks.config import TaskMix
    from roboxim_tasks.task_config import TaskConfig

DEFAULT_TASK = "pick_cube"
SEEN_WHOLE = {"workspace": "whole", "workspace_side": "whole_side"}
"""Views of the built-in tasks, which published experiments use, to those that crop neither the hand nor an object."""
FROM_AFAR = "{cameras: {names: [workspace, wrist], views: {workspace: whole}}}"
"""Reset of a skill without a task's file: the camera ``workspace`` sees the whole hand."""
CELLS_SHOWN = 8
"""Number of cells of a mix whose episodes are listed one by one."""


def task_text(
    task: str = "",
    *,
    skill: str = "",
    suite: str = "",
    objects: Sequence[str] = (),
    distractors: str = "",
    colors: str = "",
    cameras: Sequence[str] = (),
    lights: Sequence[str] = (),
    textures: Sequence[str] = (),
    look: str = "",
    robot: str = "",
) -> str:
    """Return a task configuration as YAML text, with the command line's overrides.

    Args:
        task: Name in ``config/tasks`` or a file; empty: the skill's task, or the default task.
        skill: A skill, whose own configuration is ``config/tasks/<skill>.yaml`` if there is one; several, separated by
            commas, share the episodes equally.
        suite: A suite of ``config/suites``, or a YAML file.
        objects: ``[ROLE=]MODEL[,MODEL]``, the default role is ``target``.
        distractors: Number or range of distractors, e.g. ``1-3``; empty: as configured.
        colors: Comma-separated colours of the target; empty: as configured.
        cameras: ``NAME[=VIEW]``: the cameras, each at the pose of its own file of ``config/cameras`` or of another one;
            none: those of the task. A built-in task of one skill, named and not given as a file, is then seen whole
            (`SEEN_WHOLE`), unless its look brings a view.
        lights: Names in ``config/lights``; several: one is drawn for each episode.
        textures: ``SURFACE=NAME`` for table, floor or wall; several of one surface: one is drawn for each episode.
        look: Set of looks in ``config/looks``, one of which is drawn for each episode, or ``SET/LOOK``.
        robot: Arm in ``config/robots``; empty: the scene's.

    Raises:
        ConfigError: When the task or skill is unknown, or the result is not valid.
    """
    from roboxim_tasks.config import any_task_config

    text, source = _base(task, _words(skill), suite, whole=not cameras, by_look=bool(look))
    task_data = parse_yaml(text, source=source)
    any_task_config(task_data, source=source)
    reset = _reset_changes(cameras, lights, textures, look)
    if not cameras and not is_path(task) and _is_built_in(source):
        reset = merged(_whole_view(task_data, by_look=bool(look)), reset)
    if not (objects or distractors or colors or reset or robot):
        return text
    data: dict[str, Any] = yaml_text.plain(task_data)
    changed = data
    if "cells" in data:
        if objects:
            raise ConfigError(
                f"'{suite or task or skill}' is a mix with objects of its own; --object needs a task of one skill"
            )
        changed = data.setdefault("set", {})
    for item in objects:
        _set_models(changed, item)
    if distractors:
        found = re.fullmatch(r"(\d{1,6})(?:-(\d{1,6}))?", distractors)
        if not found:
            raise ConfigError(f"--distractors must be a number or a range such as 1-3, got '{distractors}'")
        low = int(found[1])
        drawn = changed.setdefault("distractors", {})
        drawn.update(minimum=low, maximum=int(found[2] or low))
        if "cells" not in data:  # of a mix each task has its own
            drawn.setdefault("models", {"values": _graspable_models()})
    if colors:
        target = changed.setdefault("objects", {}).setdefault("target", {})
        target.setdefault("modifiers", {})["color"] = {"values": [color.strip() for color in colors.split(",")]}
    if robot:
        changed["robot"] = robot
    if reset:
        changed["reset"] = merged(changed.get("reset") or {}, reset)
    comments = "".join(f"{line}\n" for line in text.splitlines() if line.startswith("# ") and ": sha256 " in line)
    text = comments + str(yaml.safe_dump(data, sort_keys=False))
    any_task_config(data, source=f"{source} with the command line's options")
    return text


def named_task(name: str, *, others: Sequence[str] = (), **changes: Any) -> tuple[str, Path | None]:
    """Return the configuration of a task, a suite or a skill as YAML text, and its file.

    Args:
        name: Name in ``config/tasks`` or ``config/suites``, a YAML file, a skill, or the file of a skill.
        others: Further names that the user may have meant.
        **changes: What changes it, see `task_text`.

    Raises:
        ConfigError: When there is no such thing, or it is not valid.
    """
    from roboxim_tasks.skills import SKILLS
    from roboxim_tasks.skills.from_file import is_skill_file

    if is_skill_file(name):
        return task_text(skill=name, **changes), None
    for kind in ("tasks", "suites"):
        if is_path(name) or name in config_names(kind):
            file = named_config(kind, name)
            return task_text(name if kind == "tasks" else str(file), **changes), file
    if name in SKILLS:
        return task_text(skill=name, **changes), None
    known = {*config_names("tasks"), *config_names("suites"), *SKILLS, *others}
    raise ConfigError(f"there is no '{name}'; {one_of(known, name)}")


def _reset_changes(
    cameras: Sequence[str], lights: Sequence[str], textures: Sequence[str], look: str
) -> dict[str, dict[str, Any]]:
    """Return the sections of reset components that the options set."""
    changes: dict[str, dict[str, Any]] = {}
    if cameras:
        given = camera_words(cameras)
        views = {name: {"values": [view]} for name, view in given.items() if view}
        changes["cameras"] = {"names": list(given), **({"views": views} if views else {})}
    if look:
        looks, _, name = look.partition("/")
        changes["look"] = {"set": looks, **({"names": {"values": [name]}} if name else {})}
    if lights:
        changes.setdefault("look", {})["lights"] = {"values": list(lights)}
    for word in textures:
        surface, equals, name = word.partition("=")
        if not equals:
            raise ConfigError(f"--texture is SURFACE=NAME, e.g. table=marble, got '{word}'")
        texture = texture_name(name, Path.cwd())
        section = changes.setdefault("surfaces", {}).setdefault(surface, {"texture": {"values": []}})
        section["texture"]["values"].append(texture)
    return changes


def camera_words(words: Iterable[str]) -> dict[str, str]:
    """Parse ``CAMERA[=VALUE]`` words; returns camera to value, empty where none is given.

    Raises:
        ConfigError: When a camera is named twice, or a side of ``=`` is empty, like an unset variable.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = (part.strip() for part in word.partition("="))
        if not name or (equals and not value):
            raise ConfigError(f"--camera is NAME or NAME=VALUE, neither of them empty, got '{word}'")
        if name in found:
            raise ConfigError(f"--camera names '{name}' twice; it has one value")
        found[name] = value
    return found


def _is_built_in(source: str) -> bool:
    """Return whether a task's source is a file of RoboXim's own ``config/tasks``."""
    return Path(source).parent == config_dir() / "tasks"


def _whole_view(task: Any, *, by_look: bool) -> dict[str, Any]:
    """Return the change that makes the camera ``workspace`` see the hand and all objects; empty: the task decides.

    Args:
        task: The task's plain data.
        by_look: Whether a look chooses the view, unless the task has its own view.
    """
    cameras = (task.get("reset") or {}).get("cameras") or {}
    views = cameras.get("views") or {}
    own = (views.get("workspace") or {}).get("values", ["workspace"])
    if "workspace" not in cameras.get("names", ()) or len(own) != 1 or own[0] not in SEEN_WHOLE:
        return {}
    if by_look and not views:
        return {}
    return {"cameras": {"views": {"workspace": {"values": [SEEN_WHOLE[own[0]]]}}}}


def mix_of(task_config: str) -> TaskMix | None:
    """Return the mix that a task configuration's text describes; none: it has one skill."""
    from roboxim_tasks.config import TaskMix, parse_task_config

    config = parse_task_config(task_config)
    return config if isinstance(config, TaskMix) else None


def cells_of(task_config: str) -> Sequence[TaskConfig]:
    """Return the tasks of a configuration: the cells of a mix, or the task itself."""
    from roboxim_tasks.config import TaskMix, parse_task_config

    config = parse_task_config(task_config)
    return config.cells if isinstance(config, TaskMix) else (config,)


def shares_text(mix: TaskMix, episodes: int) -> str:
    """Return how many of a run's episodes each cell of a mix has, in a sentence.

    Args:
        mix: The mix.
        episodes: Number of episodes of the run.
    """
    counts = Counter(mix.drawn(index)[CELL] for index in range(episodes))
    cells = dict.fromkeys(mix.keys, 0) | dict(counts)
    if len(set(cells.values())) == 1:
        return f"{counted(episodes, 'episode')}: {counts[mix.keys[0]]} of each of {counted(len(cells), 'cell')}"
    shares = [f"{count} of {name}" for name, count in list(cells.items())[:CELLS_SHOWN]]
    more = [counted(len(cells) - CELLS_SHOWN, "more cell")] if len(cells) > CELLS_SHOWN else []
    unit = sum(mix.counts) // gcd(*mix.counts)
    hint = "" if episodes % unit == 0 else f"; a multiple of {unit} gives every cell its share"
    return f"{counted(episodes, 'episode')}: {', '.join([*shares, *more])}{hint}"


def _digest_of(spec: str) -> str:
    """Return the hash of a skill's file, and load it, so that its mistakes are found at once."""
    from roboxim_tasks.skills.from_file import load_skill_file, skill_path

    load_skill_file(spec)
    return hashlib.sha256(skill_path(spec).read_bytes()).hexdigest()


def _words(text: str) -> list[str]:
    return list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def _base(task: str, skills: Sequence[str], suite: str, *, whole: bool, by_look: bool) -> tuple[str, str]:
    """Return a task configuration's text and its source; ``whole`` and ``by_look`` choose the view of several."""
    from roboxim_tasks.skills import SKILLS
    from roboxim_tasks.skills.from_file import is_skill_file, placed

    if suite:
        if task or skills:
            raise ConfigError(f"give either --suite {suite} or a task: a suite has tasks of its own")
        return _read(named_config("suites", suite))
    if task and skills:
        raise ConfigError(f"give either --task {task} or --skill {','.join(skills)}: a task has a skill of its own")
    if not skills:
        return _read(named_config("tasks", task or DEFAULT_TASK))
    for skill in skills:
        if skill not in SKILLS and not is_skill_file(skill):
            raise ConfigError(f"unknown skill '{skill}'; {one_of(SKILLS, skill)}")
    files = {skill: placed(skill) for skill in skills if is_skill_file(skill)}
    digests = "".join(f"# {name}: sha256 {_digest_of(name)}\n" for name in files.values())  # a changed one: another run
    skills = [files.get(skill, skill) for skill in skills]
    if len(skills) > 1:
        mix = {"cells": _cells_by_view(skills, by_look=by_look) if whole else [{"tasks": list(skills)}]}
        return digests + str(yaml.safe_dump(mix)), f"skills {', '.join(skills)}"
    [skill] = skills
    own = (folder / "tasks" / f"{skill}.yaml" for folder in config_dirs()) if not files else ()
    view = f"reset: {FROM_AFAR}\n" if whole and not by_look else ""
    alone = f"{digests}skill: {skill}\n{view}", f"skill '{skill}'"
    return next((_read(file) for file in own if file.is_file()), alone)


def _cells_by_view(skills: Sequence[str], *, by_look: bool) -> list[dict[str, Any]]:
    """Return cells of skills that share the episodes, each seen whole as it would be alone."""
    groups: dict[str, dict[str, Any]] = {}
    for skill in skills:
        file = config_dir() / "tasks" / f"{skill}.yaml"
        if file.is_file():
            view = _whole_view(parse_yaml(read_text(file), source=str(file)), by_look=by_look)
        else:
            view = {} if by_look else yaml_text.parse(FROM_AFAR)
        cell = groups.setdefault(str(view), {"tasks": [], **({"set": {"reset": view}} if view else {})})
        cell["tasks"].append(skill)
    return list(groups.values())


def _read(file: Path) -> tuple[str, str]:
    from roboxim_tasks.config import require_content

    text, data = read_text(file), load_with_textures(file)
    require_content(data, source=str(file))
    if data != parse_yaml(text):  # images are named relative to the file, which the text alone does not tell
        text = yaml_text.dump(yaml_text.plain(data))
    return text, str(file)


def _set_models(data: dict[str, Any], item: str) -> None:
    """Set the models of a role as ``[ROLE=]MODEL[,MODEL]`` says."""
    from roboxim_core.models.library import ModelLibrary

    library = ModelLibrary()
    role, _, models = item.rpartition("=")
    names = [name.strip() for name in models.split(",")]
    for name in names:
        if name not in library.known_objects and name not in library.object_sets:
            raise ConfigError(f"--object {item}: unknown object '{name}'; {library.objects_like(name)}")
    config = data.setdefault("objects", {}).setdefault(role or "target", {}) or {}
    set_models(config, names, library)
    data["objects"][role or "target"] = config


def _graspable_models() -> list[str]:
    """Return the objects that distractors are drawn from where a task does not say it."""
    from roboxim_core.models.library import ModelLibrary

    library = ModelLibrary()
    return [name for name in library.object_ids if "graspable" in library.object(name).affordances]


def set_models(section: dict[str, Any], names: Sequence[str], library: ModelLibrary) -> None:
    """Set the models of a role's section, or of the distractors'. Drop modifiers and values that none of them supports.

    Args:
        section: Plain data of the section, which is changed.
        names: Ids of the models.
        library: Library of the models.

    Raises:
        ConfigError: When a model is unknown.
    """
    from roboxim_core.models.modifiers import PHYSICAL
    from roboxim_tasks.choices import Choice

    section["models"] = {"values": list(names)}
    modifiers = {}
    for kind, given in (section.get("modifiers") or {}).items():
        choice = given if isinstance(given, dict) else Choice.from_short(given)
        taken_by = map(library.object_modifiers, library.expanded(names))
        takers = [taken[kind] for taken in taken_by if kind in taken]
        kept = choice
        if kind != "scale" and kind not in PHYSICAL:
            kept = _only(choice, {word for taker in takers for word in taker.words(kind)})
        if kind in PHYSICAL or (takers and kept):
            modifiers[kind] = kept
    section["modifiers"] = modifiers


def _only(choice: dict[str, Any], allowed: Collection[Any]) -> dict[str, Any]:
    """Return the allowed values of a choice with their weights; empty when none is allowed."""
    places = [i for i, value in enumerate(choice["values"]) if value in allowed]
    lists = {key: [choice[key][i] for i in places] for key in ("values", "weights") if choice.get(key)}
    return {**choice, **lists} if places else {}
