"""Hashes of the files that a task names: scenes, cameras, looks, lights, textures, wordings, skills and models.

An edit of such a file changes how episodes are drawn, shown or judged. So they count in the configuration of a run, and
a folder with episodes refuses other definitions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from roboxim_core.config import digest, parse_yaml
from roboxim_core.config_folders import config_names, is_path, named_config
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.documents import read_text
from roboxim_core.plain_data.pictures import file_of
from roboxim_core.specs import LookSpec
from roboxim_core.vision.looks import LookSet
from roboxim_runs.storage.store import file_sha256
from roboxim_tasks.components.cameras import CamerasResetConfig
from roboxim_tasks.components.look import LookResetConfig
from roboxim_tasks.components.surfaces import SurfacesResetConfig
from roboxim_tasks.files import named
from roboxim_tasks.fixed_scene import FixedTaskConfig
from roboxim_tasks.task_config import TaskConfig

SURFACES = ("table", "floor", "wall")
"""Surfaces with a texture."""


def definitions_of(tasks: Sequence[TaskConfig], names: Iterable[str] = ()) -> dict[str, str]:
    """Return the hashes of the files that tasks name, e.g. ``{"camera wrist": ...}``.

    A YAML file's hash is that of its parsed content: a comment does not change it. A model's is also that of its
    meshes.

    Args:
        tasks: The tasks.
        names: Names of task files.

    Raises:
        ConfigError: When a file is missing or invalid.
    """
    library = ModelLibrary()
    files: set[tuple[str, str]] = {("tasks", name) for name in names}
    content: set[str] = set()
    models: set[str] = set()
    for task in tasks:
        files |= set(_yaml_files(task))
        content |= {path for path in _other_files(task) if path}
        models |= set(_models(task))
    return {
        **{
            f"{kind.removesuffix('s')} {name}": digest(parse_yaml(read_text(named_config(kind, name))))
            for kind, name in sorted(files)
        },
        **{f"file {path}": file_sha256(file_of(path)[0]) for path in sorted(content)},
        **{f"model {name}": library.digest(name) for name in sorted(models)},
    }


def task_files(task_config: str) -> list[str]:
    """Return the names of the task files that a mix names; none for a task of one skill.

    Args:
        task_config: A valid task configuration, YAML.
    """
    data = parse_yaml(task_config)
    cells: Iterable[Mapping[str, Any]] = data.get("cells", ()) if isinstance(data, Mapping) else ()
    found = {str(name) for cell in cells for name in cell["tasks"]}
    known = set(config_names("tasks"))
    return sorted(name for name in found if name in known or (is_path(name) and Path(name).suffix in (".yaml", ".yml")))


def _yaml_files(task: TaskConfig) -> Iterator[tuple[str, str]]:
    """Yield the kind and name of YAML files of ``config/``."""
    if not isinstance(task, FixedTaskConfig):
        yield "scenes", task.scene
    if task.wordings:
        yield "wordings", task.skill
    look, cameras = task.reset.get("look"), task.reset.get("cameras")
    if isinstance(look, LookResetConfig):
        if look.set:
            yield "looks", look.set
            yield from (
                ("cameras", room.view) for room in named("looks", look.set, LookSet).looks.values() if room.view
            )
        yield from (("lights", str(name)) for name in (look.lights.values if look.lights else ()))
    if isinstance(cameras, CamerasResetConfig):
        yield from (("cameras", name) for name in cameras.names if name not in cameras.views)
        yield from (("cameras", str(name)) for choice in cameras.views.values() for name in choice.values)


def _other_files(task: TaskConfig) -> Iterator[str]:
    """Yield the names of other files: the skill's path, and images of textures."""
    yield task.skill_file.rpartition(":")[0]
    yield from pictures_of(task.base_scene().look)
    look, surfaces = task.reset.get("look"), task.reset.get("surfaces")
    if isinstance(look, LookResetConfig) and look.set:
        for room in named("looks", look.set, LookSet).looks.values():
            yield from pictures_of(room.look)
    if isinstance(surfaces, SurfacesResetConfig):
        textures = (getattr(surfaces, surface).texture for surface in SURFACES)
        yield from (picture_of(str(name)) for one in textures if one is not None for name in one.values)


def pictures_of(look: LookSpec) -> Iterator[str]:
    """Yield the names of the images of a look's textures; empty: a built-in texture."""
    yield from (picture_of(getattr(look, surface).texture) for surface in SURFACES)


def picture_of(texture: str) -> str:
    """Return the name of a texture's image, which `file_of` finds; empty: it is a built-in one."""
    return texture.removesuffix(f"#{file_of(texture)[1]}") if "/" in texture else ""


def _models(task: TaskConfig) -> Iterator[str]:
    """Yield the models that a scene of a task can have."""
    scene, some = task.base_scene(), task.distractors
    yield scene.robot.model
    yield from (entity.model for entity in scene.entities)
    yield from (str(model) for one in task.objects.values() for model in one.models.values)
    yield from some.always
    yield from map(str, some.models.values if some.maximum else ())
