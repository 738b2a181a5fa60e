"""Shared parts of the drawer skills: handles, drawer paths and drawer positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.episode.start import SPEED_M_S
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import Handle, JointModel, ObjectModel
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import let_go
from roboxim_tasks.measures import Condition, Measure, joint_position, seconds_between, with_last
from roboxim_tasks.motion import ExpertScene, retreated
from roboxim_tasks.reach import reaches_in_lines
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.sampling.placement import footprint, overlap
from roboxim_tasks.skills.placing import contents

APPROACH_M = 0.08
OVERSHOOT_M = 0.02
OTHERS_M = 0.02
CLEARANCE_M = 0.02
PITCHES = tuple(math.radians(angle) for angle in (0, -6, 6, -12, 12))
CABINET_PLACES: Mapping[str, Any] = {
    "area": {"lower": [0.66, -0.22], "upper": [0.78, 0.22]},
    "yaw_rad": {"lower": math.pi - 0.5, "upper": math.pi + 0.5},
}
"""Placement of the cabinet: behind the middle of the table, its front towards the robot."""


def generate_drawer_task(context: GenerationContext) -> TaskSpec:
    """Draw a task about the configured drawer, and record the name of its joint.

    Raises:
        ConfigError: When the object has no such drawer.
    """
    task = generate_task(context, words={"drawer": context.parameters.drawer})
    target = task.objects["target"]
    handle = handle_of(context.library.object(target.model, target.modifiers), str(task.arguments["drawer"]))
    return replace(task, arguments=task.arguments | {"joint": handle.joint})


def handle_of(model: ObjectModel, drawer: str) -> Handle:
    """Return the handle of a drawer.

    Raises:
        ConfigError: When no handle has that name.
    """
    for handle in model.handles:
        if handle.name == drawer:
            return handle
    raise ConfigError(
        f"object '{model.id}' has no drawer '{drawer}'; {one_of([h.name for h in model.handles], drawer)}"
    )


def joint_of(model: ObjectModel, handle: Handle) -> JointModel:
    """Return the joint that a handle moves."""
    return next(joint for joint in model.joints if joint.name == handle.joint)


def link_pose(model: ObjectModel, base: Pose, joints: Mapping[str, float], link: str) -> Pose:
    """Return a link's pose in the frame of the object's base pose."""
    return base @ object_link_poses(model, dict(joints))[link]


def opening_axis(model: ObjectModel, handle: Handle, base: Pose) -> Array:
    """Return the unit vector along which a drawer opens, in the frame of the object's base pose, shape (3,)."""
    joint = joint_of(model, handle)
    parent = link_pose(model, base, {}, joint.parent)
    axis = (parent @ joint.pose).rotation.apply(joint.axis)
    return np.asarray(axis / np.linalg.norm(axis))


def handle_grasps(model: ObjectModel, handle: Handle, base: Pose, joints: Mapping[str, float]) -> Iterator[Pose]:
    """Yield tool poses that grasp a handle, best first: as annotated, then with slightly different pitches."""
    from scipy.spatial.transform import Rotation

    link = link_pose(model, base, joints, handle.link)
    for pitch in PITCHES:
        for grasp in handle.grasps:
            for flip in (0.0, math.pi):
                turn = Rotation.from_euler("z", flip) * Rotation.from_euler("y", pitch)
                yield link @ grasp.pose @ Pose.from_arrays((0.0, 0.0, 0.0), turn)


def moved_by(pose: Pose, vector: Array) -> Pose:
    """Return a pose moved along a vector of its parent frame [m]."""
    return Pose.from_arrays(np.add(pose.position, vector), pose.rotation)


def drawer_contents(scene: ExpertScene, cabinet: str, drawer: str) -> tuple[str, ...]:
    """Return the entities whose origin lies in a drawer, which move with it.

    Args:
        scene: The scene.
        cabinet: Entity of the cabinet.
        drawer: Name of the drawer, which is the name of its interior.
    """
    regions = [r for r in scene.model_of(cabinet).regions if r.kind == "interior" and r.name == drawer]
    return tuple(name for region in regions[:1] for name in contents(scene, cabinet, region))


def way_clear(context: ResetContext, role: str, open_m: float = 0.0) -> Constraint:
    """Return the constraint that no object stands in a drawer's path.

    Args:
        context: The reset.
        role: Role of the cabinet.
        open_m: Distance by which the drawer will be opened, from its initial position [m].
    """
    entity = context.task.objects[role].entity
    joint = str(context.task.arguments["joint"])

    def holds(scene: SceneSpec) -> bool:
        spec = scene.entity(entity)
        model = context.library.entity_model(spec)
        handle = next(h for h in model.handles if h.joint == joint)
        start = spec.joint_positions.get(joint, 0.0)
        corners, lowest = _swept(model, handle, spec, (0.0, max(start, open_m)))
        others = [other for other in scene.entities if other.name != entity]
        return not any(
            _top(context, other) > lowest - CLEARANCE_M and overlap(corners, footprint(other, context.library))
            for other in others
        )

    return Constraint(name="way_clear", holds=holds)


def not_there_already(context: ResetContext, role: str, there: Callable[[float], bool]) -> Constraint:
    """Return the constraint that a drawer is not yet at its goal.

    Args:
        context: The reset.
        role: Role of the cabinet.
        there: Returns whether a position of the drawer is at the goal, 0 = shut [m].
    """
    entity = context.task.objects[role].entity
    joint = str(context.task.arguments["joint"])
    return Constraint(
        name="not_there_already", holds=lambda scene: not there(scene.entity(entity).joint_positions.get(joint, 0.0))
    )


def handle_reachable(context: ResetContext, role: str, position_m: float, before_m: float = 0.0) -> Constraint:
    """Return the constraint that the arm reaches a drawer's handle and moves it.

    Args:
        context: The reset.
        role: Role of the cabinet.
        position_m: Goal position of the drawer, 0 = shut [m].
        before_m: Initial distance of the tool in front of the handle [m].
    """
    entity = context.task.objects[role].entity
    joint = str(context.task.arguments["joint"])

    def holds(scene: SceneSpec) -> bool:
        spec = scene.entity(entity)
        model = context.library.entity_model(spec)
        handle = next(h for h in model.handles if h.joint == joint)
        base = scene.robot.pose.inverse() @ spec.pose
        axis = opening_axis(model, handle, base)
        way = axis * (position_m - spec.joint_positions.get(joint, 0.0))
        grasps = (moved_by(g, axis * before_m) for g in handle_grasps(model, handle, base, spec.joint_positions))
        return any(
            reaches_in_lines(context, retreated(grasp, APPROACH_M), grasp, moved_by(grasp, way)) for grasp in grasps
        )

    return Constraint(name=f"{role}_reachable", holds=holds)


def drawer_rests(task: TaskSpec, initial: StateRecord, goal: Condition) -> tuple[Condition, ...]:
    """Return the conditions of a moved drawer: at its goal, still and let go, the other drawers not moved.

    Args:
        task: The task.
        initial: State of tick 0.
        goal: The condition on the drawer's position.
    """
    cabinet, joint = task.objects["target"].entity, str(task.arguments["joint"])
    return (
        goal,
        Condition(name="others_stayed", measure=_others_moved(cabinet, joint, initial), most=OTHERS_M,
                  reason="moved_other_drawer"),
        *let_go(cabinet),
        Condition(name="at_rest", measure=_joint_speed(cabinet, joint, initial), most=SPEED_M_S),
    )  # fmt: skip


def drawer_position(task: TaskSpec) -> Measure:
    """Measure the opening of the task's drawer [m]."""
    return joint_position(task.objects["target"].entity, str(task.arguments["joint"]), "drawer_m")


def _others_moved(cabinet: str, joint: str, initial: StateRecord) -> Measure:
    start = initial.entity(cabinet)
    others = [i for i, name in enumerate(start.joint_names) if name != joint]

    def moved(state: StateRecord) -> float:
        now = state.entity(cabinet).joint_positions
        return max((abs(now[i] - start.joint_positions[i]) for i in others), default=0.0)

    return Measure(name="others_moved_m", of=moved)


def _joint_speed(cabinet: str, joint: str, initial: StateRecord) -> Measure:
    number = initial.entity(cabinet).joint_names.index(joint)

    def speed(state: StateRecord, before: StateRecord | None) -> float:
        if before is None:
            return 0.0
        travel = state.entity(cabinet).joint_positions[number] - before.entity(cabinet).joint_positions[number]
        return abs(travel) / seconds_between(before, state)

    return Measure(name="drawer_speed_m_s", of=with_last(speed))


def _swept(model: ObjectModel, handle: Handle, spec: EntitySpec, positions: Sequence[float]) -> tuple[Array, float]:
    """Return the rectangle on the table that a drawer sweeps, shape (4, 2), and its lowest height [m]."""
    link = next(link for link in model.links if link.name == handle.link)
    points = []
    for position in positions:
        pose = link_pose(model, spec.pose, {**spec.joint_positions, handle.joint: position}, handle.link)
        for shape in link.collision:
            half = np.array(shape.size) / 2
            signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
            points.append((pose @ shape.pose).apply(signs * half))
    cloud = np.concatenate(points)
    along = opening_axis(model, handle, spec.pose)[:2]
    frame = np.array([along, [-along[1], along[0]]])
    (a, b), (c, d) = (cloud[:, :2] @ frame.T).min(axis=0), (cloud[:, :2] @ frame.T).max(axis=0)
    return np.array([(c, d), (a, d), (a, b), (c, b)]) @ frame, float(cloud[:, 2].min())


def _top(context: ResetContext, entity: EntitySpec) -> float:
    model = context.library.entity_model(entity)
    return entity.pose.position[2] + max(model.size[2] - model.rest_height, max(model.size[:2]) / 2)
