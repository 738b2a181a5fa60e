"""The edited task: a given scene with roles and an instruction, its YAML, and steps back and forth.

The document is a `FixedTask` of `roboxim_tasks`; editing returns another one. What is saved is what ``generate`` and
``evaluate`` read, and the scene's hash is the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from typing import Any

import yaml

from roboxim_core.config import digest, from_plain, to_plain
from roboxim_core.episode import Draw, EpisodeInfo
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.poses import Pose
from roboxim_core.rates import DEFAULT_RATE_HZ, ticks
from roboxim_core.specs import CameraSpec, EntitySpec, LookSpec, RobotSpec, Scalar, SceneSpec, TaskSpec
from roboxim_tasks.fixed_scene import FixedScene, FixedTask, FixedTaskConfig, fixed_task_config
from roboxim_tasks.limits import limits_of
from roboxim_tasks.roles import DISTRACTOR, GENERAL, STAY
from roboxim_tasks.sequences.steps import is_sequence
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.task_config import VisibleConfig

MAX_STEPS = 200
"""Largest number of edits that can be undone."""
DEFAULT_DIGITS = 6
"""Digits of positions that a person drags [decimal places of metres]: what is shown is what is stored."""


def from_draw(draw: Draw) -> FixedTask:
    """Return a drawn episode's task and scene as a document; arguments and exceptions of `from_episode`."""
    return from_episode(draw.task, draw.scene, parse_json(draw.config_json, source="the task's configuration"))


def from_info(info: EpisodeInfo) -> FixedTask:
    """Return a recorded episode's task and scene as a document; exceptions of `from_episode`."""
    recorded = parse_json(info.config_json, source=f"the configuration of {info.episode_id}")
    config = recorded.get("task") if isinstance(recorded, Mapping) else None
    return from_episode(info.task, info.scene, config if isinstance(config, Mapping) else {})


def from_episode(task: TaskSpec, scene: SceneSpec, config: Mapping[str, Any]) -> FixedTask:
    """Return a task and its scene as a document.

    Args:
        task: The task; its limits, and its arguments where the configuration does not say more, are the document's.
        scene: The scene.
        config: Plain data of the resolved configuration that the task was drawn from: what holds for the other purpose
            too, the required visibility and the step limit; empty: not known.

    Raises:
        ConfigError: When the task has several steps, or the configuration is not valid.
    """
    if is_sequence(task.skill):
        raise ConfigError(f"'{task.instruction}' has several steps; only a task of one skill has a given scene")
    skill = SKILLS[task.skill]
    defaults = skill.Parameters()
    demanded, eased, drawn = (config.get(key) or {} for key in ("parameters", "lenient", "arguments"))
    own = {name: value for name, value in task.arguments.items() if name not in GENERAL}
    own |= {name: value for name, value in demanded.items() if name in own and name not in drawn}
    changed = {name: value for name, value in own.items() if value != getattr(defaults, name)}
    lenient = {n: v for n, v in eased.items() if n in own and n not in drawn and v != own[n]}
    roles = {role: thing.entity for role, thing in task.objects.items()}
    limits, max_steps = limits_of(task), int(config.get("max_steps", 0))
    return FixedTask(
        skill=task.skill,
        fixed=FixedScene(
            instruction=task.instruction, roles=roles, scene=scene, stay_m=float(task.arguments.get(STAY, 0.0))
        ),
        parameters=changed or None,
        lenient=lenient or None,
        visible=from_plain(config.get("visible") or {}, VisibleConfig, source="the task's configuration"),
        limits=None if limits is None else replace(limits, robot=""),
        max_steps=0 if max_steps == ticks(skill.max_steps / DEFAULT_RATE_HZ, scene.control_rate_hz) else max_steps,
    )


def as_yaml(document: FixedTask) -> str:
    """Return a document as the YAML text of a task; keys that have their default are left out."""
    options = {"sort_keys": False, "allow_unicode": True, "width": 110, "default_flow_style": None}
    return str(yaml.dump(_short(document), Dumper=_Dumper, **options))


def checked(document: FixedTask, library: ModelLibrary) -> FixedTaskConfig:
    """Return the document as a complete task.

    Raises:
        ConfigError: When a role, a model or a parameter is wrong.
    """
    return fixed_task_config(_short(document), source="the task", library=library)


def scene_hash(document: FixedTask) -> str:
    """Return the scene's hash, as state records and reports name it."""
    return digest(document.fixed.scene)


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """Writes numbers so that they are read as the same numbers, and never refers to a value by an anchor."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _number(dumper: yaml.SafeDumper, value: float) -> yaml.ScalarNode:
    text = repr(value)
    if "e" in text and "." not in text:  # YAML 1.1 reads 1e-05 as a text
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


_Dumper.add_representer(float, _number)


def _short(value: Any) -> Any:
    """Return plain data of a dataclass, without fields that have their default."""
    if is_dataclass(value) and not isinstance(value, type):
        kept = {}
        for item in fields(value):
            found = getattr(value, item.name)
            default = item.default if item.default_factory is MISSING else item.default_factory()
            if default is MISSING or found != default:
                kept[item.name] = _short(found)
        return kept
    if isinstance(value, Mapping):
        return {str(key): _short(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_short(item) for item in value]
    return to_plain(value)


# ---------------------------------------------------------------- edits: each returns another document


def with_scene(document: FixedTask, scene: SceneSpec) -> FixedTask:
    """Return the document with another scene."""
    return replace(document, fixed=replace(document.fixed, scene=scene))


def with_entity(document: FixedTask, entity: EntitySpec) -> FixedTask:
    """Return the document with an entity of the same name replaced.

    Raises:
        InvalidRequestError: When the scene has none of that name.
    """
    scene = document.fixed.scene
    scene.entity(entity.name)
    entities = tuple(entity if one.name == entity.name else one for one in scene.entities)
    return with_scene(document, replace(scene, entities=entities))


def moved(document: FixedTask, name: str, pose: Pose) -> FixedTask:
    """Return the document with an entity at another pose, rounded to micrometres."""
    x, y, z = (round(value, DEFAULT_DIGITS) for value in pose.position)
    norm = math.sqrt(sum(part * part for part in pose.quat_xyzw))
    a, b, c, d = (part / norm for part in pose.quat_xyzw)
    entity = document.fixed.scene.entity(name)
    return with_entity(document, replace(entity, pose=Pose(position=(x, y, z), quat_xyzw=(a, b, c, d))))


def modified(document: FixedTask, name: str, modifier: str, value: Scalar | None, library: ModelLibrary) -> FixedTask:
    """Return the document with another colour, scale, ... of an entity, which keeps resting on what it rests on.

    Args:
        document: The document.
        name: The entity.
        modifier: The modifier.
        value: Its value; None: the model's default.
        library: Library of the models.

    Raises:
        ConfigError: When the model does not take the modifier or the value; lists what it takes.
    """
    entity = document.fixed.scene.entity(name)
    modifiers = {key: old for key, old in entity.modifiers.items() if key != modifier}
    if value is not None:
        modifiers[modifier] = value
    before, after = library.entity_model(entity), library.object(entity.model, modifiers)
    x, y, z = entity.pose.position
    z += after.rest_height - before.rest_height
    pose = Pose(position=(x, y, round(z, DEFAULT_DIGITS)), quat_xyzw=entity.pose.quat_xyzw)
    return with_entity(document, replace(entity, modifiers=modifiers, pose=pose))


def added(
    document: FixedTask, model: str, library: ModelLibrary, position: tuple[float, float] = (0.5, 0.0)
) -> FixedTask:
    """Return the document with one more object at rest on the table, as a distractor.

    Raises:
        ConfigError: When there is no such model.
    """
    scene, roles = document.fixed.scene, document.fixed.roles
    found = library.object(model)
    names = {entity.name for entity in scene.entities}
    number = next(n for n in range(1, len(names) + 2) if f"{DISTRACTOR}_{n}" not in names | roles.keys())
    name = f"{DISTRACTOR}_{number}"
    z = scene.table.center[2] + found.rest_height
    entity = EntitySpec(
        name=name, model=model, pose=Pose(position=(*position, round(z, DEFAULT_DIGITS))), fixed=bool(found.joints)
    )
    fixed = replace(
        document.fixed, roles={**roles, name: name}, scene=replace(scene, entities=(*scene.entities, entity))
    )
    return replace(document, fixed=fixed)


def removed(document: FixedTask, name: str) -> FixedTask:
    """Return the document without an entity.

    Raises:
        ConfigError: When the skill's role needs it.
        InvalidRequestError: When the scene has no such entity.
    """
    scene = document.fixed.scene
    scene.entity(name)
    needed = [r for r, entity in document.fixed.roles.items() if entity == name and r in SKILLS[document.skill].roles]
    if needed:
        raise ConfigError(f"'{name}' is the task's {needed[0]}; give this role to another object first")
    roles = {role: entity for role, entity in document.fixed.roles.items() if entity != name}
    entities = tuple(entity for entity in scene.entities if entity.name != name)
    return replace(document, fixed=replace(document.fixed, roles=roles, scene=replace(scene, entities=entities)))


def with_role(document: FixedTask, role: str, name: str) -> FixedTask:
    """Return the document with another entity in a role; the one that had it takes the other's place.

    Raises:
        InvalidRequestError: When the scene has no such entity.
    """
    document.fixed.scene.entity(name)
    roles = dict(document.fixed.roles)
    before = roles.get(role, "")
    other = next((key for key, entity in roles.items() if entity == name), "")
    roles[role] = name
    if other and other != role:
        if before:
            roles[other] = before
        else:
            del roles[other]
    return replace(document, fixed=replace(document.fixed, roles=roles))


def with_instruction(document: FixedTask, instruction: str) -> FixedTask:
    """Return the document with another instruction."""
    return replace(document, fixed=replace(document.fixed, instruction=instruction))


def with_camera(document: FixedTask, camera: CameraSpec) -> FixedTask:
    """Return the document with a camera of the same name replaced, or one more."""
    scene = document.fixed.scene
    names = [one.name for one in scene.cameras]
    cameras = (
        tuple(camera if one.name == camera.name else one for one in scene.cameras)
        if camera.name in names
        else (*scene.cameras, camera)
    )
    return with_scene(document, replace(scene, cameras=cameras))


def without_camera(document: FixedTask, name: str) -> FixedTask:
    """Return the document without a camera.

    Raises:
        ConfigError: When there is none of that name.
    """
    scene = document.fixed.scene
    names = [camera.name for camera in scene.cameras]
    if name not in names:
        raise ConfigError(f"no camera '{name}' in the scene; {one_of(names, name)}")
    return with_scene(document, replace(scene, cameras=tuple(one for one in scene.cameras if one.name != name)))


def with_look(document: FixedTask, look: LookSpec) -> FixedTask:
    """Return the document with another appearance of the room."""
    return with_scene(document, replace(document.fixed.scene, look=look))


def with_robot(document: FixedTask, robot: RobotSpec) -> FixedTask:
    """Return the document with another start of the robot."""
    return with_scene(document, replace(document.fixed.scene, robot=robot))


@dataclass
class History:
    """A document with its earlier and undone versions."""

    now: FixedTask
    """The document."""
    _before: list[FixedTask] = field(default_factory=list)
    _after: list[FixedTask] = field(default_factory=list)

    @property
    def edited(self) -> bool:
        """Whether there are edits that can be undone."""
        return bool(self._before)

    def change(self, document: FixedTask) -> bool:
        """Make an edit; returns whether it changed anything."""
        if document == self.now:
            return False
        self._before = [*self._before[-(MAX_STEPS - 1) :], self.now]
        self._after = []
        self.now = document
        return True

    def undo(self) -> bool:
        """Go back one edit; returns whether there was one."""
        if not self._before:
            return False
        self._after.append(self.now)
        self.now = self._before.pop()
        return True

    def redo(self) -> bool:
        """Make an undone edit again; returns whether there was one."""
        if not self._after:
            return False
        self._before.append(self.now)
        self.now = self._after.pop()
        return True
