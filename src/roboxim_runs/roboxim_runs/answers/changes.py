"""Counterfactual changes of an episode, each of one property."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from roboxim_core.episode import EpisodeInfo
from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import color_word
from roboxim_core.models.visuals import camera_parent
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, PhysicalObject, SceneSpec, TaskSpec
from roboxim_core.vision.cameras import load_camera
from roboxim_tasks.files import named
from roboxim_tasks.meaning import canonical_instruction
from roboxim_tasks.roles import description, task_distractors, task_objects

Apply = Callable[[TaskSpec, SceneSpec, int], tuple[TaskSpec, SceneSpec]]
MIN_SHIFT_M = 0.05
"""Distance from the middle of the table from which moving an object there is a change [m]."""
EDGE_M = 0.06
"""Least distance of a moved object from the table's edge [m]."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """A change of one thing."""

    name: str
    """Its name, e.g. ``distractors``."""
    words: str
    """What it does, e.g. ``without the 2 distractors``."""
    apply: Apply
    """Return the changed task and scene; the number is that of the run, for changes with several values."""


NAMES = ("distractors", "color", "camera", "light", "surfaces", "physics", "words", "start", "place")
"""All changes."""


def changes_of(info: EpisodeInfo, library: ModelLibrary) -> tuple[Change, ...]:
    """Return the changes that are one for an episode: what is nominal already is left out."""
    task, scene, nominal = info.task, info.scene, nominal_scene(info)
    found: list[Change] = [*_without_distractors(task), *_other_colors(task, library), *_nominal_cameras(info, library)]
    if (scene.look.lights, scene.look.ambient) != (nominal.look.lights, nominal.look.ambient):
        light: dict[str, Any] = {"lights": nominal.look.lights, "ambient": nominal.look.ambient}
        found.append(_of_scene("light", "in the nominal light", _looking(light)))
    parts = ("table", "floor", "wall", "background", "backdrop")
    surfaces = {part: getattr(nominal.look, part) for part in parts}
    if any(getattr(scene.look, part) != value for part, value in surfaces.items()):
        found.append(_of_scene("surfaces", "on the nominal table and room", _looking(surfaces)))
    found += [*_nominal_physics(scene, nominal), *_first_words(task, library)]
    home = library.robot(scene.robot.model).home
    if (scene.robot.joint_positions or home) != home or scene.robot.gripper_opening != 1.0:
        robot = replace(scene.robot, joint_positions=tuple(home), gripper_opening=1.0)
        found.append(_of_scene("start", "from the robot's home", lambda s: replace(s, robot=robot)))
    found += _in_the_middle(task, scene)
    return tuple(found)


def nominal_scene(info: EpisodeInfo) -> SceneSpec:
    """Return the scene that an episode's task varies: the one that its configuration names, else the empty table."""
    try:
        name = str(json.loads(info.config_json)["task"]["scene"])
    except (ValueError, KeyError, TypeError):
        name = "empty_table"
    try:
        return named("scenes", name, SceneSpec)
    except ConfigError:
        return SceneSpec()


def both(first: Change, second: Change) -> Change:
    """Return two changes as one."""

    def apply(task: TaskSpec, scene: SceneSpec, run: int) -> tuple[TaskSpec, SceneSpec]:
        return second.apply(*first.apply(task, scene, run), run)

    return Change(name=f"{first.name}+{second.name}", words=f"{first.words} and {second.words}", apply=apply)


def _looking(parts: dict[str, Any]) -> Callable[[SceneSpec], SceneSpec]:
    return lambda scene: replace(scene, look=replace(scene.look, **parts))


def _of_scene(name: str, words: str, change: Callable[[SceneSpec], SceneSpec]) -> Change:
    return Change(name=name, words=words, apply=lambda task, scene, _: (task, change(scene)))


def _without_distractors(task: TaskSpec) -> Iterator[Change]:
    gone = {thing.entity for thing in task_distractors(task)}
    if not gone:
        return

    def apply(task: TaskSpec, scene: SceneSpec, _: int) -> tuple[TaskSpec, SceneSpec]:
        objects = {role: thing for role, thing in task.objects.items() if thing.entity not in gone}
        kept = tuple(entity for entity in scene.entities if entity.name not in gone)
        return replace(task, objects=objects), replace(scene, entities=kept)

    words = f"without the {len(gone)} distractors" if len(gone) > 1 else "without the distractor"
    yield Change(name="distractors", words=words, apply=apply)


def _other_colors(task: TaskSpec, library: ModelLibrary) -> Iterator[Change]:
    """Yield the change of the first object's colour: its usual one, or one after the other if it has it already."""
    role, thing = next(iter(task.objects.items()))
    known = library.object_modifiers(thing.model).get("color")
    if known is None:
        return
    now = str(thing.modifiers.get("color", known.default))
    taken = {color_word(library.object_modifiers(one.model), one.modifiers) for one in task.objects.values()}
    usual = str(known.default)
    others = [usual] if usual != now and usual not in taken else [c for c in known.colors if c not in {now, *taken}]
    if not others:
        return

    def apply(task: TaskSpec, scene: SceneSpec, run: int) -> tuple[TaskSpec, SceneSpec]:
        color = others[run % len(others)]
        painted = replace(thing, modifiers={**thing.modifiers, "color": color})
        entities = tuple(
            replace(e, modifiers={**e.modifiers, "color": color}) if e.name == thing.entity else e
            for e in scene.entities
        )
        return (
            _told(replace(task, objects={**task.objects, role: painted}), thing, painted),
            replace(scene, entities=entities),
        )

    words = f"with a {others[0]} {thing.name}" if len(others) == 1 else f"with a {thing.name} of other colours"
    yield Change(name="color", words=words, apply=apply)


def _told(task: TaskSpec, thing: PhysicalObject, painted: PhysicalObject) -> TaskSpec:
    """Return a task whose instruction, and those of its steps, name an object by another colour."""
    if "color" not in thing.modifiers:
        return task

    def told(text: str) -> str:
        return text.replace(description(thing), description(painted))

    arguments = {
        name: told(value) if name.endswith(".instruction") and isinstance(value, str) else value
        for name, value in task.arguments.items()
    }
    return replace(task, instruction=told(task.instruction), arguments=arguments)


def _nominal_cameras(info: EpisodeInfo, library: ModelLibrary) -> Iterator[Change]:
    cameras, views = info.scene.cameras, _views(info)
    arm = ArmKinematics(library.robot(info.scene.robot.model))
    nominal = tuple(_nominal_camera(camera, views.get(camera.name, camera.name), arm) for camera in cameras)
    if nominal != cameras:
        yield _of_scene("camera", "with the nominal cameras", lambda s: replace(s, cameras=nominal))


def _views(info: EpisodeInfo) -> dict[str, str]:
    """Return the cameras that an episode's task shows from another place than that of their name, to that place."""
    try:
        views: dict[str, Any] = json.loads(info.config_json)["task"]["reset"]["cameras"]["views"]
        places = {name: [str(place) for place in choice["values"]] for name, choice in views.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {name: listed[0] for name, listed in places.items() if listed and name not in listed}


def _nominal_camera(camera: CameraSpec, view: str, arm: ArmKinematics) -> CameraSpec:
    try:
        known = load_camera(view)
        known = replace(known, parent=camera_parent(known, arm))
    except ConfigError:
        return camera
    keep = ("name", "width", "height", "depth", "segmentation")
    found = replace(known, **{name: getattr(camera, name) for name in keep})
    noise = replace(found.noise, seed=camera.noise.seed)
    return replace(found, noise=noise)


def _nominal_physics(scene: SceneSpec, nominal: SceneSpec) -> Iterator[Change]:
    def plain(entity: EntitySpec) -> EntitySpec:
        return replace(entity, modifiers={k: v for k, v in entity.modifiers.items() if k not in ("mass", "friction")})

    entities = tuple(plain(entity) for entity in scene.entities)
    if entities != scene.entities or scene.table.friction != nominal.table.friction:
        yield _of_scene("physics", "with nominal friction and masses", lambda s: replace(
            s, entities=tuple(plain(e) for e in s.entities), table=replace(s.table, friction=nominal.table.friction)
        ))  # fmt: skip


def _first_words(task: TaskSpec, library: ModelLibrary) -> Iterator[Change]:
    canonical = canonical_instruction(task, library)
    if canonical and canonical != task.instruction:
        yield Change(
            name="words", words=f"told '{canonical}'", apply=lambda t, s, _: (replace(t, instruction=canonical), s)
        )  # fmt: skip


def _in_the_middle(task: TaskSpec, scene: SceneSpec) -> Iterator[Change]:
    """Yield the change of place: all loose objects are moved together, so that the first one lies in the middle."""
    thing = task_objects(task)[0]
    free = [entity for entity in scene.entities if not entity.fixed]
    named_entity = next((entity for entity in free if entity.name == thing.entity), None)
    if named_entity is None:
        return
    (x, y, _), (at_x, at_y, _) = scene.table.center, named_entity.pose.position
    if max(abs(x - at_x), abs(y - at_y)) < MIN_SHIFT_M:
        return

    def moved(entity: EntitySpec) -> EntitySpec:
        px, py, pz = entity.pose.position
        return replace(entity, pose=Pose(position=(px + x - at_x, py + y - at_y, pz), quat_xyzw=entity.pose.quat_xyzw))

    def on_table(entity: EntitySpec) -> bool:
        px, py, _ = moved(entity).pose.position
        return abs(px - x) < scene.table.size[0] / 2 - EDGE_M and abs(py - y) < scene.table.size[1] / 2 - EDGE_M

    if len(free) == len(scene.entities) and all(map(on_table, free)):
        yield _of_scene(
            "place", f"with the {thing.name} in the middle of the table",
            lambda s: replace(s, entities=tuple(moved(e) for e in s.entities)),
        )  # fmt: skip
