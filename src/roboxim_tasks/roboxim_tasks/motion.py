"""Motions that skills request from the expert: stages, and the grasps to choose from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

from roboxim_core.models.description import ObjectModel, RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose, distance
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import EntityState, StateRecord

GRIPPER = "gripper"
ROBOT = "robot"
TABLE = "table"
FLOOR = "floor"
ANYTHING = ""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One leg of a motion: go somewhere, or stay while the gripper moves. Poses are in the robot's base frame."""

    name: str
    """Name for messages, e.g. ``descend``."""
    pose: Pose | None = None
    """Goal of the tool centre point, reached in a straight line; none: it stays."""
    opening: float = 1.0
    """Commanded opening, 1 = open, 0 = closed."""
    free: bool = False
    """Whether any path will do: the expert may then avoid obstacles, and noise may be injected."""
    exact_m: float = math.inf
    """Distance from ``pose`` [m] within which the exact path matters; farther away some noise may be injected."""
    speed: float = 1.0
    """Fraction of the largest speed of the tool centre point."""
    duration_s: float = 0.0
    """Duration of a stage without a pose [s]."""
    lifts: bool = False
    """Whether the stage lifts the held object off its support: it may then sag, and the expert checks the grasp."""
    touching: tuple[tuple[str, str], ...] = ()
    """Pairs of bodies that may touch: entities, ``table``, ``gripper``."""
    held: str = ""
    """Entity in the gripper; empty: none."""
    held_in_tcp: Pose = Pose()
    """Pose of the held entity in the tool centre point's frame."""
    moved: tuple[EntityState, ...] = ()
    """Entities whose pose or joints differ from the scene by then: placed, or with an open drawer; in the world."""


@dataclass(frozen=True, kw_only=True)
class ExpertScene:
    """Privileged knowledge of an executor."""

    task: TaskSpec
    """The task."""
    scene: SceneSpec
    """The scene; its objects are where they were at the begin of the task, or of the step at hand."""
    state: StateRecord
    """Present state."""
    library: ModelLibrary
    """Robots and objects."""
    held: str = ""
    """Entity that the gripper already holds; empty: none."""
    lifted: bool = False
    """Whether the held entity has been lifted off its support."""
    recovering: bool = False
    """Whether an earlier try failed, so that the gripper may be closed and at any pose."""
    direct: bool = False
    """Whether motions go straight from stage to stage and ignore obstacles."""

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self.library.robot(self.scene.robot.model)

    @property
    def pose_tcp(self) -> Pose:
        """Commanded pose of the tool centre point in the base."""
        return self.in_base(self.state.robot.pose_tcp_commanded)

    def in_base(self, pose_in_world: Pose) -> Pose:
        """Return a pose in the world as a pose in the robot's base."""
        return self.scene.robot.pose.inverse() @ pose_in_world

    def pose_of(self, entity: str) -> Pose:
        """Return the pose of an entity in the base."""
        return self.in_base(self.state.entity(entity).pose)

    def model_of(self, entity: str) -> ObjectModel:
        """Return the model of an entity."""
        return self.library.entity_model(self.scene.entity(entity))


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One way to grasp an object."""

    pose: Pose
    """Pose of the tool centre point in the base."""
    opening: float = 1.0
    """Opening of the gripper on the way there, 1 = open."""
    release_opening: float = 1.0
    """Opening that releases the object without sweeping its surroundings."""
    name: str = ""
    """Name of the annotation."""


def fingers_touch(scene: ExpertScene, entity: str) -> tuple[tuple[str, str], ...]:
    """Return the pairs that may touch when fingers push or hold an entity and the palm must stay clear of it."""
    return tuple((finger, entity) for finger in scene.robot.gripper.links[1:])


RELEASE_CLEARANCE_M = 0.03
DOWN = -0.99995
"""Largest z of the tool's axis with which it points down: within 0.01 rad."""
JAW_CLEARANCE_M = 0.004
"""Gap between the fixed jaw and an object before a gripper with one moving jaw closes [m]."""


def grasps_of(scene: ExpertScene, entity: str, name: str = "") -> list[Grasp]:
    """Return the grasps of an entity in the order of its model's annotations; within each, least rotation first.

    Args:
        scene: Scene with the entity and the tool centre point.
        entity: The entity.
        name: Name of the annotation to use; empty: all.
    """
    model, pose_object, robot = scene.model_of(entity), scene.pose_of(entity), scene.robot
    widest, one_jaw = robot.gripper.max_opening_m, robot.gripper.one_jaw
    found = []
    for annotation in model.grasps:
        if name and annotation.name != name:
            continue
        only = replace(model, grasps=(annotation,))
        release = min(1.0, (annotation.width_m + RELEASE_CLEARANCE_M) / widest)
        # a jaw that turns sweeps the room beside the object, so it opens no farther than it has to
        opening = release if one_jaw else min(1.0, annotation.opening_m / widest)
        found += [
            Grasp(pose=pose, opening=opening, release_opening=release, name=annotation.name)
            for pose in grasp_poses(only, pose_object, scene.pose_tcp, one_jaw=one_jaw)
            if robot.rotations == 3 or points_down(pose)
        ]
    return found


def grasp_poses(model: ObjectModel, pose_object: Pose, pose_tcp: Pose, *, one_jaw: bool = False) -> list[Pose]:
    """Return all poses of the tool centre point that grasp an object, nearest first.

    A grasp repeats with its own symmetry about the object's vertical axis, and with the gripper turned by 180 degrees.
    A gripper with one moving jaw puts the fixed one beside the object.

    Args:
        model: The object.
        pose_object: Its pose.
        pose_tcp: Present pose of the tool centre point in the same frame; grasps are ordered by the rotation from it.
        one_jaw: Whether the gripper has one moving jaw, see `GripperModel.joint_names`.
    """
    found = [pose_object @ pose for pose in _symmetric_grasps(model, one_jaw)]
    return sorted(found, key=lambda pose: (round(distance(pose_tcp, pose)[1], 3), pose.position))


@lru_cache(maxsize=64)
def _symmetric_grasps(model: ObjectModel, one_jaw: bool) -> tuple[Pose, ...]:
    from scipy.spatial.transform import Rotation

    found: list[Pose] = []
    for grasp in model.grasps:
        seen: list[Pose] = []
        count = round(2 * math.pi / grasp.yaw_symmetry_rad) if grasp.yaw_symmetry_rad else 1
        beside = Pose(position=(0.0, -grasp.width_m / 2 - JAW_CLEARANCE_M, 0.0)) if one_jaw else IDENTITY
        for turn in range(count):
            about_z = Pose.from_arrays((0, 0, 0), Rotation.from_euler("z", turn * 2 * math.pi / count))
            for flip in (0.0, math.pi):
                pose = about_z @ grasp.pose @ Pose.from_arrays((0, 0, 0), Rotation.from_euler("z", flip))
                pose = pose @ beside if one_jaw else pose
                if all(distance(pose, other)[1] > 1e-3 or distance(pose, other)[0] > 1e-4 for other in seen):
                    seen.append(pose)
        found += seen
    return tuple(found)


def with_poses(scene: SceneSpec, state: StateRecord) -> SceneSpec:
    """Return a scene with every object where it is in a state."""
    return replace(scene, entities=tuple(replace(e, pose=state.entity(e.name).pose) for e in scene.entities))


def shifted(pose: Pose, z_m: float) -> Pose:
    """Return a pose moved up in its parent frame [m]."""
    x, y, z = pose.position
    return Pose(position=(x, y, z + z_m), quat_xyzw=pose.quat_xyzw)


def points_down(pose: Pose) -> bool:
    """Return whether a tool pose points down in its parent frame."""
    return float(pose.rotation.apply([0.0, 0.0, 1.0])[2]) <= DOWN


def retreated(pose: Pose, distance_m: float) -> Pose:
    """Return a tool pose moved back along the tool's axis, away from its target [m]."""
    return pose @ Pose(position=(0.0, 0.0, -distance_m))
