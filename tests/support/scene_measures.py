"""Numbers and words that describe a drawn scene: by which planted policies fail."""

from __future__ import annotations

import math

from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.vision.cameras import load_camera
from roboxim_tasks.meaning import canonical_instruction
from roboxim_tasks.roles import task_distractors, task_objects

MEASURES = {
    "x": "position of the first object along x of the world [m]",
    "y": "position of the first object along y of the world [m]",
    "yaw": "yaw of the first object [rad]",
    "color": "colour of the first object",
    "friction": "friction of the table, times the factor of the first object",
    "mass": "factor of the mass of the first object",
    "distractors": "number of distractors",
    "near": "distance of the first object from the nearest distractor [m]",
    "light": "intensity of all lights together",
    "camera": "largest distance of a camera from its nominal place [m]",
    "start": "largest angle of an arm joint from the robot's home [rad]",
    "paraphrased": "1 if the instruction is not the skill's first wording, else 0",
}
"""Measure to what it is."""


def scene_measures(task: TaskSpec, scene: SceneSpec, library: ModelLibrary) -> dict[str, float | str]:
    """Return the measures of a scene; those that it does not have are left out."""
    thing = task_objects(task)[0]
    entity = scene.entity(thing.entity)
    x, y, _ = entity.pose.position
    qx, qy, qz, qw = entity.pose.quat_xyzw
    found: dict[str, float | str] = {
        "x": x, "y": y, "yaw": math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)),
        "friction": scene.table.friction * float(entity.modifiers.get("friction", 1.0)),
        "mass": float(entity.modifiers.get("mass", 1.0)),
        "light": float(sum(light.intensity for light in scene.look.lights)),
        "start": _from_home(scene, library),
    }  # fmt: skip
    colors = library.object_modifiers(thing.model).get("color")
    if colors is not None:
        found["color"] = str(thing.modifiers.get("color", colors.default))
    others = [scene.entity(other.entity).pose.position for other in task_distractors(task)]
    found["distractors"] = float(len(others))
    if others:
        found["near"] = min(math.hypot(px - x, py - y) for px, py, _ in others)
    shifts = [shift for camera in scene.cameras if (shift := _shift(camera.name, camera.pose.position)) is not None]
    if shifts:
        found["camera"] = max(shifts)
    canonical = canonical_instruction(task, library)
    found["paraphrased"] = float(bool(canonical) and canonical != task.instruction)
    return found


def _from_home(scene: SceneSpec, library: ModelLibrary) -> float:
    home = library.robot(scene.robot.model).home
    joints = scene.robot.joint_positions or home
    return max(abs(q - h) for q, h in zip(joints, home, strict=False))


def _shift(name: str, position: tuple[float, ...]) -> float | None:
    try:
        return math.dist(load_camera(name).pose.position, position)
    except ConfigError:
        return None


__all__ = ["MEASURES", "scene_measures"]
