"""Constraints that many skills share: quick checks of a drawn scene, before planning."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Array, Pose, distance
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.motion import grasp_poses, retreated, shifted
from roboxim_tasks.script import APPROACH_M, LIFT_M

START_CLEARANCE_M = 0.08
HAND_CLEARANCE_M = 0.03
HAND = ((0.0, 0.0, 0.0), (0.0, 0.1, -0.05), (0.0, -0.1, -0.05), (0.0, 0.1, -0.1), (0.0, -0.1, -0.1), (0.0, 0.0, -0.15))
"""The tool centre point and points around the hand, in the tool's frame [m]."""
LIMIT_MARGIN_RAD = 0.03
LINE_STEP_M, LINE_STEP_RAD = 0.08, 0.5
BESIDE_M = 0.03
YAWS = (0.0, math.pi / 4, -math.pi / 4, math.pi / 2)


def graspable(context: ResetContext, role: str, lift_m: float = LIFT_M) -> Constraint:
    """Return the constraint that the arm can execute a grasp of a role's object, from approach to lift."""
    entity, one_jaw = context.task.objects[role].entity, context.arm.model.gripper.one_jaw

    def grasps_of(scene: SceneSpec) -> tuple[Pose, Sequence[Pose]]:
        """Return the object's pose in the robot's base, and its grasps there."""
        spec = scene.entity(entity)
        home = context.arm.fk(context.arm.model.home)
        pose_object = scene.robot.pose.inverse() @ spec.pose
        return pose_object, grasp_poses(context.library.entity_model(spec), pose_object, home, one_jaw=one_jaw)

    def holds(scene: SceneSpec) -> bool:
        _, grasps = grasps_of(scene)
        return any(reaches(context, retreated(g, APPROACH_M), g, shifted(g, lift_m)) for g in grasps)

    def why(scene: SceneSpec) -> str:
        pose_object, grasps = grasps_of(scene)
        missing = [
            max(context.arm.ik_near(p, context.arm.model.home).position_error_m for p in (g, shifted(g, lift_m)))
            for g in grasps
        ]
        x, y, z = pose_object.position
        nearest = 1000.0 * min(missing, default=0.0)
        text = f"the nearest of {len(missing)} grasps stays {nearest:.0f} mm short"
        if nearest < 1.0:
            text = f"none of {len(missing)} grasps keeps {LIMIT_MARGIN_RAD:g} rad from the joints' limits all the way"
        return f"{text}, with the object at ({x:.2f}, {y:.2f}, {z:.2f}) in the robot's base"

    return Constraint(name=f"{role}_reachable", holds=holds, why=why)


def start_clear(context: ResetContext) -> Constraint:
    """Return the constraint that the gripper does not start too close to an object."""

    def holds(scene: SceneSpec) -> bool:
        tcp = scene.robot.pose @ context.arm.fk(scene.robot.joint_positions)
        return all(_apart(context, tcp, other) for other in scene.entities)

    return Constraint(name="start_clear", holds=holds, each=True)


def reaches(context: ResetContext, *poses: Pose) -> bool:
    """Return whether the arm reaches poses of the tool centre point in its base, with a margin to its limits."""
    return follows(context.arm, *poses)


def follows(arm: ArmKinematics, *poses: Pose) -> bool:
    """Return whether an arm reaches poses of the tool centre point in its base, with a margin to its limits."""
    joints = np.array(arm.model.home)
    for pose in poses:
        found = arm.ik_near(pose, joints)
        if not found.converged or not arm.within_limits(found.joints, LIMIT_MARGIN_RAD):
            return False
        joints = found.joints
    return True


def reaches_in_lines(context: ResetContext, *poses: Pose) -> bool:
    """Return whether the arm follows straight lines from its home through poses, as the delta controller does."""
    from scipy.spatial.transform import Rotation

    here, way = context.arm.fk(context.arm.model.home), []
    for pose in poses:
        shift_m, angle_rad = distance(here, pose)
        count = max(1, math.ceil(max(shift_m / LINE_STEP_M, angle_rad / LINE_STEP_RAD)))
        turn = (pose.rotation * here.rotation.inv()).as_rotvec()
        for share in (step / count for step in range(1, count)):
            position = (1.0 - share) * np.array(here.position) + share * np.array(pose.position)
            way.append(Pose.from_arrays(position, Rotation.from_rotvec(share * turn) * here.rotation))
        way.append(pose)
        here = pose
    return follows(context.arm, *way)


def _apart(context: ResetContext, tcp: Pose, entity: EntitySpec) -> bool:
    distances = [
        np.linalg.norm(np.maximum(np.abs(pose.inverse().apply(tcp.apply(HAND))) - half, 0.0), axis=1)
        for pose, half in _boxes(context.library.entity_model(entity), entity)
    ]
    nearest = np.min(distances, axis=0)
    return bool(nearest[0] > START_CLEARANCE_M and nearest.min() > HAND_CLEARANCE_M)


def _boxes(model: ObjectModel, entity: EntitySpec) -> list[tuple[Pose, Array]]:
    """Return boxes around an object in the world with half their sizes: one if it is rigid, else one per shape."""
    if not model.joints:
        middle = Pose(position=(0.0, 0.0, model.size[2] / 2 - model.rest_height))
        return [(entity.pose @ middle, np.array(model.size) / 2)]
    links = object_link_poses(model, entity.joint_positions)
    boxes = []
    for link in model.links:
        for shape in link.collision:
            half = np.array(shape.size) if shape.kind == "box" else np.array((2 * shape.size[0],) * 2 + shape.size[-1:])
            boxes.append((entity.pose @ links[link.name] @ shape.pose, half / 2))
    return boxes


def downward_reachable(context: ResetContext, position: Sequence[float]) -> bool:
    """Return whether the tool, pointing down, reaches a position in the base from above at some yaw [m]."""
    from scipy.spatial.transform import Rotation

    x, y, z = position
    for yaw in YAWS:
        rotation = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", math.pi)
        pose = Pose.from_arrays((x, y, z), rotation)
        if reaches(context, shifted(pose, APPROACH_M), pose):
            return True
    return False


def above_reachable(context: ResetContext, role: str) -> Constraint:
    """Return the constraint that the tool, pointing down, reaches just above a role's object at some yaw."""
    entity = context.task.objects[role].entity

    def holds(scene: SceneSpec) -> bool:
        spec = scene.entity(entity)
        model = context.library.entity_model(spec)
        x, y, z = (scene.robot.pose.inverse() @ spec.pose).position
        return downward_reachable(context, (x, y, z + model.size[2] - model.rest_height + BESIDE_M))

    return Constraint(name=f"{role}_reachable", holds=holds)
