"""Push an object over the table to the left, to the right, forward or back.

Randomisation: which object and colour; where it stands and at what yaw; where the end effector starts; distractors.

Success: the object has moved by at least ``least_m`` in the direction and by less than ``lateral_ratio`` of that to the
side. It stands still on the table, as upright as before, and the hand has left it, for ``hold_s``. It must never have
been lifted, nor have moved while it was gripped or off the table.

Non-obvious:
    - Directions are those of the robot's base, seen from the robot: left = +y, forward = away from its base.
    - The gripper pushes with the flat sides of both fingers, a little apart, so that the object does not turn away.
    - The gripper leans back from an object that is taller than the fingers are long.
    - A drawn scene has room for the object along its path.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import not_carried
from roboxim_tasks.measures import Condition, Conditions, Measure, above, lift, table_force, tilt
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, shifted
from roboxim_tasks.reach import reaches_in_lines, start_clear
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.sampling.placement import Room
from roboxim_tasks.script import APPROACH_M, SLOW, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import lies_still

DIRECTIONS = {
    "to the left": (0.0, 1.0),
    "to the right": (0.0, -1.0),
    "forward": (1.0, 0.0),
    "back": (-1.0, 0.0),
}
"""Words of the instruction to the direction in the robot's base."""
WAY_M = 0.11
STANDOFF_M = 0.02
BACK_OFF_M = 0.03
FINGER_M = 0.014
"""Distance from the tool centre point to the first contact, the flat sides of two fingers [m]."""
FINGERS_M = 0.026
"""The same distance with the tool turned by 90 degrees, to the back of a finger of the closed gripper [m]."""
HEIGHT_M = 0.02
LIFTED_M = 0.03
TILTED_RAD = 0.35
DWELL_S = 0.2
SPREAD = 0.6
"""Opening between the fingers as a fraction of the object's width."""
OPENING_M = 0.08
PALM_M = 0.035
"""Height above the tool centre point above which the palm of an upright tool would hit the object [m]."""
LEANS = (0.0, math.radians(35), math.radians(45), math.radians(25))
"""Angles at which the hand leans back from the object, best first [rad]."""


@dataclass(frozen=True, kw_only=True)
class PushObjectParameters:
    """Direction of the push, and thresholds of success."""

    direction: str = "to the left"
    """``to the left``, ``to the right``, ``forward`` or ``back``, seen from the robot."""
    least_m: float = 0.08
    """Smallest displacement in the direction [m]."""
    lateral_ratio: float = 0.4
    """Largest displacement to the side, as a fraction of the one in the direction."""
    hold_s: float = 0.3
    """Time that the object must stand still [s]."""
    direction_x: float = 0.0
    """The direction in the world; set by the generator."""
    direction_y: float = 0.0
    """The direction in the world; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When the direction is unknown or a number is out of range.
        """
        if self.direction not in DIRECTIONS:
            raise ConfigError(f"unknown direction '{self.direction}'; {one_of(DIRECTIONS, self.direction)}")
        if not 0 < self.least_m <= 0.1 or self.lateral_ratio <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < least_m <= 0.1, lateral_ratio > 0 and hold_s >= 0, got {self}")


@register
class PushObject(Skill):
    """Generator, resetter, executor and evaluator of ``push_object``."""

    name = "push_object"
    roles = {"target": Role(affordance="pushable")}
    words = ("direction",)
    templates = ("Push the {target} {direction}", "Slide the {target} {direction}", "Nudge the {target} {direction}")
    moving_fingers = 2
    max_steps = 100
    Parameters = PushObjectParameters

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task, and note the direction in the world."""
        task = generate_task(context, words={"direction": context.parameters.direction})
        robot = context.config.base_scene().robot.pose
        x, y, _ = robot.rotation.apply((*DIRECTIONS[str(task.arguments["direction"])], 0.0))
        return replace(task, arguments=task.arguments | {"direction_x": float(x), "direction_y": float(y)})

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a free path on the table for the object, and an arm that reaches from behind it to the path's end."""
        entity = context.task.objects["target"].entity
        parameters: PushObjectParameters = parameters_of(context.task, PushObjectParameters)
        direction = np.array([parameters.direction_x, parameters.direction_y, 0.0])

        def way_free(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            farthest = way_m(context.library.entity_model(spec), spec.pose, direction)
            others = replace(scene, entities=tuple(e for e in scene.entities if e.name != entity))
            room = Room.of(others, context.library, 0.01)
            places = (Pose.from_arrays(spec.pose.position + direction * way, spec.pose.rotation)
                      for way in np.linspace(0.0, farthest, 5))  # fmt: skip
            return not any(room.refusal(replace(spec, pose=place)) for place in places)

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            base = scene.robot.pose.inverse()
            toward = base.rotation.apply(direction)
            model, pose = context.library.entity_model(spec), base @ spec.pose
            way = way_m(model, pose, toward) + STANDOFF_M
            return any(
                reaches_in_lines(context, shifted(begin, APPROACH_M), begin, _along(begin, toward, way))
                for begin, _ in pushing_poses(model, pose, toward)
            )

        return (
            Constraint(name="way_free", holds=way_free, room=True),
            Constraint(name="target_reachable", holds=reachable),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Descend behind the object, push, withdraw, rise."""
        entity = scene.task.objects["target"].entity
        parameters: PushObjectParameters = parameters_of(scene.task, PushObjectParameters)
        in_world = np.array([parameters.direction_x, parameters.direction_y, 0.0])
        toward = scene.scene.robot.pose.rotation.inv().apply(in_world)
        pose = scene.pose_of(entity)
        way = way_m(scene.model_of(entity), pose, toward)
        touching = fingers_touch(scene, entity)
        for begin, opening in pushing_poses(scene.model_of(entity), pose, toward):
            script = Script(scene, opening=opening)
            script.move(shifted(begin, APPROACH_M), name="approach", free=True)
            script.move(begin, name="descend", speed=SLOW)
            script.set_entity(entity, pose=_along(pose, toward, way))
            script.move(_along(begin, toward, way + STANDOFF_M), name="push", speed=SLOW, touching=touching)
            script.wait(DWELL_S, name="dwell")
            script.move(_along(script.pose, toward, -BACK_OFF_M), name="back_off", touching=touching)
            script.move(shifted(script.pose, APPROACH_M), name="rise", touching=touching)
            yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: far enough in the direction, never lifted, upright, on the table, let go and at rest."""
        parameters: PushObjectParameters = parameters_of(task, PushObjectParameters)
        entity = task.objects["target"].entity
        direction = np.array([parameters.direction_x, parameters.direction_y])
        start = np.array(initial.entity(entity).pose.position[:2])
        up = tuple(initial.entity(entity).pose.rotation.inv().apply([0.0, 0.0, 1.0]).tolist())
        height = lift(entity, initial)
        highest = [0.0]
        others = {e.name: e.pose.position[:2] for e in initial.entities if e.name != entity}

        def moved(state: StateRecord) -> Array:
            return np.asarray(np.subtract(state.entity(entity).pose.position[:2], start), dtype=float)

        def sideways(state: StateRecord) -> float:
            along = float(moved(state) @ direction)
            return float(np.linalg.norm(moved(state) - along * direction)) / max(along, 1e-6)

        def pushed_along(state: StateRecord) -> float:
            ways = (np.subtract(state.entity(n).pose.position[:2], at) @ direction for n, at in others.items())
            return max(map(float, ways), default=0.0)

        def highest_lift(state: StateRecord) -> float:
            highest[0] = max(highest[0], height.of(state))
            return highest[0]

        pushed = (
            not_carried(entity, initial),
            Condition(
                name="not_lifted", measure=Measure(name="highest_lift_m", of=highest_lift), most=LIFTED_M,
                reason="lifted", fatal=True,
            ),
            Condition(name="pushed", measure=Measure(name="along_m", of=lambda s: float(moved(s) @ direction)),
                      least=parameters.least_m),
            Condition(name="others_left", measure=Measure(name="others_along_m", of=pushed_along),
                      most=parameters.least_m, reason="pushed_another_too"),
            Condition(name="straight", measure=Measure(name="lateral_ratio", of=sideways),
                      most=parameters.lateral_ratio),
            Condition(name="upright", measure=tilt(entity, up), most=TILTED_RAD, reason="toppled"),
            Condition(name="on_table", measure=table_force(entity), least=above(0.0)),
        )  # fmt: skip
        return Conditions(lies_still(entity, initial, pushed), hold_s=parameters.hold_s)


def way_m(model: ObjectModel, pose: Pose, direction: Array) -> float:
    """Return the distance to push [m]; it is longer if the object will turn its flat side to the fingers.

    Args:
        model: The object.
        pose: Its pose.
        direction: Horizontal unit vector in the frame of the pose, shape (3,).
    """
    return WAY_M + max(0.0, extent(model, pose, -direction) - min(model.size[:2]) / 2)


def pushing_poses(model: ObjectModel, pose: Pose, direction: Array) -> Iterator[tuple[Pose, float]]:
    """Yield tool poses from which to push an object, each with the gripper's opening, best first.

    Args:
        model: The object.
        pose: Its pose in the base.
        direction: Horizontal unit vector in the base, shape (3,).
    """
    from scipy.spatial.transform import Rotation

    across = np.array([-direction[1], direction[0], 0.0])
    behind, half_width = extent(model, pose, -direction), min(extent(model, pose, across), extent(model, pose, -across))
    height = min(HEIGHT_M, model.size[2] / 2)
    heading = math.atan2(direction[1], direction[0])
    spread = min(1.0, SPREAD * 2 * half_width / OPENING_M)
    z = pose.position[2] - model.rest_height + height
    for lean in LEANS if model.size[2] < height + PALM_M else LEANS[1:]:
        for turn, opening in ((0.0, spread), (math.pi, spread), (math.pi / 2, 0.0), (-math.pi / 2, 0.0)):
            reach = FINGER_M if opening else FINGERS_M
            x, y, _ = pose.position - direction * (behind + reach + STANDOFF_M)
            tilt_back = Rotation.from_rotvec(-lean * across)
            rotation = tilt_back * Rotation.from_euler("z", heading + turn) * Rotation.from_euler("x", math.pi)
            yield Pose.from_arrays((x, y, z), rotation), opening


def extent(model: ObjectModel, pose: Pose, direction: Array) -> float:
    """Return the extent of an object's collision shapes from its origin in a direction [m].

    Args:
        model: The object; only its base link is considered.
        pose: Its pose.
        direction: Unit vector in the frame of the pose, shape (3,).
    """
    farthest = 0.0
    for shape in model.links[0].collision:
        placed = pose @ shape.pose
        local = placed.rotation.inv().apply(direction)
        if shape.kind == "box":
            reach = float(np.abs(local) @ np.array(shape.size) / 2)
        elif shape.kind == "sphere":
            reach = shape.size[0]
        elif shape.kind in ("cylinder", "capsule"):
            radius, length = shape.size
            share = 1.0 if shape.kind == "capsule" else math.sqrt(max(0.0, 1.0 - local[2] ** 2))
            reach = radius * share + abs(float(local[2])) * length / 2
        else:
            reach = math.hypot(*model.size[:2]) / 2
        farthest = max(farthest, float(np.subtract(placed.position, pose.position) @ direction) + reach)
    return farthest


def _along(pose: Pose, direction: Array, length_m: float) -> Pose:
    return Pose.from_arrays(pose.position + np.asarray(direction) * length_m, pose.rotation)
