"""Conversions between messages and the values of this package."""

from __future__ import annotations

import json

from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import PoseStamped
from roboxim_interfaces.msg import (
    AllowedContact,
    AttachedObject,
    CollisionObject,
    MotionRequest,
    NamedValue,
    PlanningScene,
)
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import EntityState
from roboxim_core.surroundings import Surroundings
from roboxim_ros.messages.conversions import fill_pose
from roboxim_tasks.motion import TABLE


def motion_request(robot: str, joints: Array, around: Surroundings, seed: int) -> MotionRequest:
    """Return the part that all planning requests share."""
    msg = MotionRequest(robot=robot, seed=seed, start_state=JointState(position=joints.tolist()))
    msg.scene = planning_scene(around)
    return msg


def planning_scene(around: Surroundings) -> PlanningScene:
    """Return a scene by the name of its revision, or body by body if the simulator has no such state.

    The held object is attached to the gripper, and moved objects are placed at their new poses.
    """
    there = {entity.name: entity for entity in around.state_then.entities}
    given = {entity.name for entity in around.moved}
    msg = PlanningScene(gripper_opening=[float(around.opening)], padding=around.padding_m)
    if around.state.episode_id:
        msg.episode_id, msg.seq = around.state.episode_id, around.state.seq
        msg.ignored_objects = sorted(given | ({around.held} if around.held else set()))
    else:
        given = set(there)
        fill_pose(msg.robot_pose_in_world, around.scene.robot.pose)
        msg.objects.append(_table(around.scene))
    msg.allowed_contacts = [AllowedContact(body_a=a, body_b=b) for a, b in around.touching]
    for entity in around.scene.entities:
        if entity.name in given and entity.name != around.held:
            msg.objects.append(_collision_object(entity, there[entity.name], there[entity.name].pose))
    if around.held:
        entity = around.scene.entity(around.held)
        held = _collision_object(entity, there[around.held], around.held_in_tcp)
        msg.attached = [AttachedObject(object=held)]
    return msg


def _collision_object(entity: EntitySpec, state: EntityState, pose: Pose) -> CollisionObject:
    """Return an entity as a collision object: its model at its joint positions."""
    msg = CollisionObject(name=entity.name, model=entity.model)
    fill_pose(msg.pose, pose)
    msg.modifiers = [KeyValue(key=key, value=json.dumps(value)) for key, value in entity.modifiers.items()]
    joints = zip(state.joint_names, state.joint_positions, strict=True)
    msg.joint_positions = [NamedValue(name=name, value=position) for name, position in joints]
    return msg


def _table(scene: SceneSpec) -> CollisionObject:
    (x, y, z), size = scene.table.center, scene.table.size
    msg = CollisionObject(name=TABLE, primitives=[SolidPrimitive(type=SolidPrimitive.BOX, dimensions=list(size))])
    fill_pose(msg.pose, Pose(position=(x, y, z - size[2] / 2)))
    return msg


def pose_stamped(pose_in_world: Pose) -> PoseStamped:
    """Return a pose in the world."""
    msg = PoseStamped()
    msg.header.frame_id = "world"
    fill_pose(msg.pose, pose_in_world)
    return msg


def trajectory(path: Array, period_s: float) -> JointTrajectory:
    """Return a joint path with times."""
    msg = JointTrajectory()
    for index, row in enumerate(path.tolist()):
        point = JointTrajectoryPoint(positions=row)
        seconds, nanoseconds = divmod(round(index * period_s * 1e9), 1_000_000_000)
        point.time_from_start.sec, point.time_from_start.nanosec = seconds, nanoseconds
        msg.points.append(point)
    return msg
