"""Shared parts of the placing skills: goals on surfaces and in containers, and conditions of success."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import ObjectModel, Region
from roboxim_core.poses import Pose
from roboxim_core.state import StateRecord
from roboxim_tasks.handling import DROP_M, let_go, not_tossed, set_down
from roboxim_tasks.measures import Condition, at_rest, fallen_off, lowest_lift
from roboxim_tasks.motion import TABLE, ExpertScene, Grasp, Stage, grasps_of
from roboxim_tasks.script import Script

GOAL_YAWS = (0.0, math.pi / 2, -math.pi / 2, math.pi / 4, -math.pi / 4, math.pi)
GRASPS_TRIED = 8
PLACES = (0.0, 1.0, -1.0, 0.5, -0.5)
"""Places in a container's interior on each axis, as shares of the room that an object has there."""
MAX_PLACES = 4
ABOVE_M = 0.05
"""Distance of an object's origin from the interior at which it still lies inside [m]."""


def region_of(model: ObjectModel, kind: str, name: str = "") -> Region:
    """Return a model's best region of a kind.

    Raises:
        ConfigError: When the model has no region of that kind and name.
    """
    found = [region for region in model.regions if region.kind == kind]
    for region in found:
        if not name or region.name == name:
            return region
    raise ConfigError(
        f"object '{model.id}' has no {kind} '{name}'; {one_of([r.name for r in found], name)}"
        if found
        else f"object '{model.id}' has no {kind} to put things on or into"
    )


def region_pose(scene: ExpertScene, entity: str, region: Region) -> Pose:
    """Return the pose of an entity's region in the base, at its present joint positions."""
    state, model = scene.state.entity(entity), scene.model_of(entity)
    links = object_link_poses(model, dict(zip(state.joint_names, state.joint_positions, strict=True)))
    return scene.pose_of(entity) @ links[region.link or model.links[0].name] @ region.pose


def contents(scene: ExpertScene, container: str, region: Region) -> list[str]:
    """Return the entities whose origin lies in an interior of a container and that the gripper does not hold."""
    floor, half = region_pose(scene, container, region), np.array(region.size[:2]) / 2
    found = []
    for entity in scene.state.entities:
        if entity.name not in (container, scene.held):
            x, y, z = (floor.inverse() @ scene.pose_of(entity.name)).position
            if abs(x) < half[0] and abs(y) < half[1] and -ABOVE_M < z < region.size[2] + ABOVE_M:
                found.append(entity.name)
    return found


def free_places(scene: ExpertScene, target: str, container: str, region: Region, floor: Pose) -> list[Pose]:
    """Return where in a container's interior an object has room, best first: the middle if nothing lies inside yet.

    Args:
        scene: The scene.
        target: The object.
        container: The container.
        region: Its interior.
        floor: Pose of the interior's floor in the base.

    Returns:
        Poses of the floor, moved sideways; those farthest from what lies inside come first. Empty: there is no room.
    """
    radius = math.hypot(*scene.model_of(target).size[:2]) / 2
    half = np.array(region.size[:2]) / 2
    taken = []
    for name in contents(scene, container, region):
        if name != target:
            x, y, _ = (floor.inverse() @ scene.pose_of(name)).position
            taken.append((x, y, math.hypot(*scene.model_of(name).size[:2]) / 2))
    if not taken:
        return [floor]
    room = np.maximum(half - radius, 0.0)
    spots = [(x * room[0], y * room[1]) for x in PLACES for y in PLACES]
    gaps = {spot: min(math.dist(spot, other[:2]) - other[2] - radius for other in taken) for spot in spots}
    best = sorted((spot for spot in spots if gaps[spot] >= 0.0), key=lambda spot: -gaps[spot])
    return [floor @ Pose(position=(float(x), float(y), 0.0)) for x, y in best[:MAX_PLACES]]


def fits(model: ObjectModel, region: Region) -> bool:
    """Return whether an object fits into a region at every yaw."""
    return math.hypot(*model.size[:2]) <= min(region.size[:2])


def upright(pose: Pose, position: Sequence[float], yaw_rad: float) -> Pose:
    """Return a pose turned about the vertical by an angle and moved to a position."""
    from scipy.spatial.transform import Rotation

    return Pose.from_arrays(position, Rotation.from_euler("z", yaw_rad) * pose.rotation)


def levelled(pose: Pose) -> Pose:
    """Return a pose turned minimally until its most upright axis is vertical; corrects sag in the hand."""
    from scipy.spatial.transform import Rotation

    axes = pose.quaternion.matrix().T
    up = max(axes, key=lambda axis: abs(axis[2]))
    up = up * np.sign(up[2])
    away = np.cross(up, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(away))
    turn = away * (math.asin(min(1.0, sine)) / sine if sine > 1e-9 else 1.0)
    return Pose.from_arrays(pose.position, Rotation.from_rotvec(turn) * pose.rotation)


def put(
    scene: ExpertScene, target: str, goals: Iterable[Pose], *, onto: str = TABLE, drops_m: Sequence[float] = (0.002,)
) -> Iterator[tuple[Stage, ...]]:
    """Yield candidates that pick up an entity and put it at one of several poses.

    Args:
        scene: The scene.
        target: Entity to move.
        goals: Poses of the entity in the base, best first.
        onto: Entity that the target may touch at the goal.
        drops_m: Heights above the goal at which the gripper releases the target, best first [m].
    """
    wanted = [levelled(goal) for goal in goals] if scene.lifted else list(goals)
    grasps: list[Grasp | None] = [None] if scene.held == target else list(grasps_of(scene, target))
    for grasp in grasps[: GRASPS_TRIED * 2]:
        for goal in wanted:
            for drop_m in drops_m:
                script = Script(scene)
                script.pick(target, grasp)
                script.place(goal, onto=onto, drop_m=drop_m)
                yield script.stages


def lies_still(
    target: str,
    initial: StateRecord,
    conditions: Sequence[Condition],
    reference: str = "",
    drop_m: float = DROP_M,
    *,
    may_bounce: bool = False,
) -> tuple[Condition, ...]:
    """Return the conditions of a placed object.

    - Nothing fell off the table.
    - The skill's own conditions hold.
    - The object was neither dropped nor tossed.
    - The robot has let go of it, and it is at rest.

    Args:
        target: The object.
        initial: State of tick 0.
        conditions: The skill's own conditions.
        reference: Another object that must not fall off the table; empty: none.
        drop_m: Largest free fall of the object [m].
        may_bounce: Whether it may fall against walls, which make it fast, as in a container.
    """
    fallen = [fallen_off(lowest_lift((target,), initial))]
    if reference:
        gain = lowest_lift((reference,), initial, "reference_lift_m")
        fallen.append(fallen_off(gain, "reference_not_fallen"))
    handled = (set_down(target, drop_m), not_tossed(target, may_bounce=may_bounce))
    return (*fallen, *conditions, *handled, *let_go(target), *at_rest(target))


def raised(pose: Pose, height_m: float) -> Pose:
    """Return a pose with another height in its parent frame [m]."""
    return replace(pose, position=(*pose.position[:2], height_m))
