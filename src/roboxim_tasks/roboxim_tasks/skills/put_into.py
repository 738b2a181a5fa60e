"""Put an object into a container: a bowl, a tray, a mug, an open drawer.

Randomisation: which objects and colours; where both lie and at what yaw; where the end effector starts; distractors.

Success: the object's origin is inside the container's interior, the object does not touch the table, it fell by no more
than ``drop_m``, the hand has left it, and it lies still for ``hold_s``.

Non-obvious:
    - The generator writes the interior's pose and size, and its motion with a drawer, into the task's arguments.
    - Objects that do not fit into the interior at every yaw are never drawn.
    - A drawer must be open at the start: the reset component ``joints`` opens it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import joint_motion, object_link_poses
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Array
from roboxim_core.specs import Scalar, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions, Measure, table_force
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import downward_reachable, graspable, start_clear
from roboxim_tasks.roles import description
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import (
    GOAL_YAWS,
    fits,
    free_places,
    lies_still,
    put,
    raised,
    region_of,
    region_pose,
    upright,
)
from roboxim_tasks.standing import nothing_else_put, rests_on, stays_upright, upright_arguments

DROPS_M = (0.01, 0.03, 0.05)
RIM_M = 0.01
"""Largest height of the origin of an object inside above the rim [m]."""
LEVEL = 0.999
"""Smallest cosine of an angle that counts as none."""
OPEN_SHARE = 0.5
"""Share of its travel by which a drawer must be open for putting an object into it."""


@dataclass(frozen=True, kw_only=True)
class PutIntoParameters:
    """Thresholds of success, and geometry of the container's interior."""

    drop_m: float = 0.15
    """Largest free fall [m]: a fall from a hand's width above the rim down to the floor is allowed."""
    hold_s: float = 0.3
    """Time that the object must lie still [s]."""
    drawer: str = ""
    """Name of the interior, where the container has several, e.g. ``top``."""
    floor_x_m: float = 0.0
    """Middle of the interior's floor in the container's base, with all joints at 0 [m]; set by the generator."""
    floor_y_m: float = 0.0
    """As ``floor_x_m``."""
    floor_z_m: float = 0.0
    """As ``floor_x_m``."""
    depth_m: float = 0.0
    """Height of the interior's rim above its floor [m]; set by the generator."""
    half_x_m: float = 0.0
    """Half of the interior's extent along the container's x [m]; set by the generator."""
    half_y_m: float = 0.0
    """Half of the interior's extent along the container's y [m]; set by the generator."""
    joint: str = ""
    """Joint that moves the interior; empty: none; set by the generator."""
    axis_x: float = 0.0
    """Motion of the interior in the container's base per unit of the joint's position; set by the generator."""
    axis_y: float = 0.0
    """As ``axis_x``."""
    axis_z: float = 0.0
    """As ``axis_x``."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if self.hold_s < 0:
            raise ConfigError(f"needs hold_s >= 0, got {self}")


@register
class PutInto(Skill):
    """Generator, resetter, executor and evaluator of ``put_into``."""

    name = "put_into"
    roles = {"container": Role(affordance="container", models=("bowl",)), "target": Role(affordance="graspable")}
    templates = (
        "Put the {target} into the {container}",
        "Place the {target} in the {container}",
        "Drop the {target} into the {container}",
    )
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    moving_fingers = 2
    max_steps = 200
    Parameters = PutIntoParameters

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:
        """Refuse a drawer that one of the models lacks."""
        for model in models["container"]:
            region_of(model, "interior", parameters.drawer)

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return why a target does not fit: too long for the interior at every yaw, or standing out of it."""
        target, container = models["target"], models["container"]
        interior = region_of(container, "interior", parameters.drawer)
        if not fits(target, interior):
            return f"the {target.name} is too long for the {container.name}"
        if target.rest_height > interior.size[2] + RIM_M:
            return f"the {target.name} sticks out of the {container.name}"
        return ""

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a target that fits into the container, and record the interior's geometry."""
        task = generate_task(context)
        container = task.objects["container"]
        model = context.library.object(container.model, container.modifiers)
        interior = interior_arguments(model, context.parameters.drawer)
        instruction = task.instruction
        if joint := interior["joint"]:
            interior["drawer"] = region_of(model, "interior", context.parameters.drawer).name
            whole = description(container)
            instruction = instruction.replace(
                f"the {whole}", f"the {interior['drawer'] or joint} drawer of the {whole}"
            )
        arguments = task.arguments | interior | upright_arguments(task, context.library)
        return replace(task, arguments=arguments, instruction=instruction)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm reaches the target, and into the container."""
        parameters: PutIntoParameters = parameters_of(context.task, PutIntoParameters)
        container = context.task.objects["container"].entity

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(container)
            floor = floor_of(parameters, spec.joint_positions.get(parameters.joint, 0.0))
            inside = (scene.robot.pose.inverse() @ spec.pose).apply(floor) + (0.0, 0.0, parameters.depth_m)
            return downward_reachable(context, inside.tolist())

        def open_enough(scene: SceneSpec) -> bool:
            spec = scene.entity(container)
            joints = {joint.name: joint for joint in context.library.entity_model(spec).joints}
            if parameters.joint not in joints:
                return True
            return spec.joint_positions.get(parameters.joint, 0.0) >= OPEN_SHARE * joints[parameters.joint].upper

        return (
            Constraint(name="container_open", holds=open_enough),
            graspable(context, "target"),
            Constraint(name="container_reachable", holds=reachable),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick up the object, lower it into the middle or what is free of it, let go as low as the hand fits."""
        target, container = (scene.task.objects[role].entity for role in ("target", "container"))
        parameters: PutIntoParameters = parameters_of(scene.task, PutIntoParameters)
        floor = region_pose(scene, container, region_of(scene.model_of(container), "interior", parameters.drawer))
        height = floor.position[2] + scene.model_of(target).rest_height
        inside = region_of(scene.model_of(container), "interior", parameters.drawer)
        places = [raised(place, height).position for place in free_places(scene, target, container, inside, floor)]
        yaws = GOAL_YAWS if len(places) == 1 else GOAL_YAWS[:2]
        goals = [upright(scene.pose_of(target), position, yaw) for position in places for yaw in yaws]
        return put(scene, target, goals, onto=container, drops_m=DROPS_M)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: inside, off the table, let go and at rest."""
        parameters: PutIntoParameters = parameters_of(task, PutIntoParameters)
        target, container = (task.objects[role].entity for role in ("target", "container"))

        def inside(state: StateRecord) -> Array:
            holder = state.entity(container)
            joints = dict(zip(holder.joint_names, holder.joint_positions, strict=True))
            position = holder.pose.inverse().apply(state.entity(target).pose.position)
            return position - floor_of(parameters, joints.get(parameters.joint, 0.0))

        def sideways(state: StateRecord) -> float:
            x, y, _ = inside(state)
            return float(max(abs(x) / parameters.half_x_m, abs(y) / parameters.half_y_m))

        depth = Measure(name="above_floor_m", of=lambda state: float(inside(state)[2]))
        placed = (
            Condition(name="inside", measure=Measure(name="sideways_share", of=sideways), most=1.0),
            Condition(name="below_rim", measure=depth, least=0.0, most=parameters.depth_m + RIM_M, reason="not_inside"),
            Condition(name="off_table", measure=table_force(target), most=0.0, reason="touches_table"),
            *stays_upright(task, initial),
            nothing_else_put(task, initial, lambda state, name: rests_on(state, name, container)),
        )
        return Conditions(
            lies_still(target, initial, placed, container, parameters.drop_m, may_bounce=True),
            hold_s=parameters.hold_s,
        )


def interior_arguments(model: ObjectModel, name: str) -> dict[str, Scalar]:
    """Return the geometry of a container's interior as scalars: floor, size, and the sliding joint that moves it."""
    interior = region_of(model, "interior", name)
    link = interior.link or model.links[0].name
    here = object_link_poses(model, {})[link] @ interior.pose
    joint = next((j for j in model.joints if j.child == link), None)
    axis = np.zeros(3)
    if joint is not None:
        if joint.kind != "prismatic":
            raise ConfigError(
                f"object '{model.id}': the interior '{name}' turns with a joint; put_into needs a sliding one"
            )
        frame = object_link_poses(model, {})[joint.parent] @ joint.pose
        axis = frame.rotation.apply(joint_motion(joint, 1.0).position)
    x, y, depth_m = interior.size
    along = here.rotation.apply([1.0, 0.0, 0.0])
    if max(abs(along[0]), abs(along[1])) < LEVEL or here.rotation.apply([0.0, 0.0, 1.0])[2] < LEVEL:
        raise ConfigError(
            f"object '{model.id}': the interior '{name}' is turned; its sides must be along x and y of the object, its "
            "floor level"
        )
    if abs(along[1]) > abs(along[0]):  # by a quarter turn
        x, y = y, x
    return {
        "floor_x_m": here.position[0], "floor_y_m": here.position[1], "floor_z_m": here.position[2],
        "depth_m": depth_m, "half_x_m": x / 2, "half_y_m": y / 2, "joint": joint.name if joint else "",
        "axis_x": float(axis[0]), "axis_y": float(axis[1]), "axis_z": float(axis[2]),
    }  # fmt: skip


def floor_of(parameters: PutIntoParameters, joint_m: float) -> Array:
    """Return the middle of the interior's floor in the container's base [m], at a position of its joint [m]."""
    floor = np.array([parameters.floor_x_m, parameters.floor_y_m, parameters.floor_z_m])
    return floor + joint_m * np.array([parameters.axis_x, parameters.axis_y, parameters.axis_z])
