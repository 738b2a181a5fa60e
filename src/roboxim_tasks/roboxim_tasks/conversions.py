"""Messages to the tasks' values and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from geometry_msgs.msg import Point, PoseStamped
from geometry_msgs.msg import Pose as PoseMsg
from roboxim_interfaces.msg import (
    AllowedContact,
    AttachedObject,
    CollisionObject,
    MotionRequest,
    PlanningScene,
)
from roboxim_interfaces.srv import Act
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, SolidPrimitive
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import ObjectModel, Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import object_link_poses
from roboxim_core.policies import ActionChunk, Observation, ObservationWindow
from roboxim_core.poses import Array, Pose
from roboxim_core.state import StateRecord
from roboxim_ros.conversions import fill_pose, from_msg
from roboxim_tasks.planning import Surroundings


def window_from_msg(request: Any) -> ObservationWindow:
    """Convert an ``Act`` request; the expert needs no images, so they are left out.

    Raises:
        InvalidRequestError: When there is no observation.
    """
    if not request.observations:
        raise InvalidRequestError("an Act request needs at least one observation")
    observations = [
        Observation(
            seq=int(item.seq),
            stamp_ns=int(item.stamp_ns),
            proprio=np.asarray(item.proprio, dtype=np.float32),
            state=from_msg(item.state[0], StateRecord) if item.state else None,
        )
        for item in request.observations
    ]
    return ObservationWindow(
        instruction=request.instruction,
        observations=observations,
        pad_mask=tuple(bool(real) for real in request.pad_mask),
        episode_id=request.episode_id,
        seq=int(request.seq),
    )


def fill_chunk(response: Act.Response, chunk: ActionChunk) -> None:
    """Fill an ``Act`` response."""
    response.horizon = int(chunk.actions.shape[0])
    response.actions = chunk.actions.ravel().tolist()
    response.done = bool(chunk.done)
    response.phases = list(chunk.phases)


def motion_request(robot: str, joints: Array, around: Surroundings, library: ModelLibrary, seed: int) -> MotionRequest:
    """Return what a planning request has in common."""
    msg = MotionRequest(robot=robot, seed=seed, start_state=JointState(position=joints.tolist()))
    msg.scene = planning_scene(around, library)
    return msg


def planning_scene(around: Surroundings, library: ModelLibrary) -> PlanningScene:
    """Return a scene by the name of its revision, with what the gripper holds taken out of it and attached."""
    msg = PlanningScene(
        episode_id=around.state.episode_id, seq=around.state.seq, gripper_opening=[float(around.opening)]
    )
    msg.allowed_contacts = [AllowedContact(body_a=a, body_b=b) for a, b in around.touching]
    for entity in around.moved:
        if entity.name != around.held:
            model = library.entity_model(around.scene.entity(entity.name))
            there = collision_object(entity.name, model, around.state_then)
            fill_pose(there.pose, entity.pose)
            msg.objects.append(there)
            msg.ignored_objects.append(entity.name)
    if around.held:
        model = library.entity_model(around.scene.entity(around.held))
        held = collision_object(around.held, model, around.state_then)
        fill_pose(held.pose, around.held_in_tcp)
        msg.ignored_objects.append(around.held)
        msg.attached = [AttachedObject(object=held)]
    return msg


def collision_object(name: str, model: ObjectModel, state: StateRecord) -> CollisionObject:
    """Return an object's collision geometry in its base frame, at its present joint positions."""
    entity = state.entity(name)
    links = object_link_poses(model, dict(zip(entity.joint_names, entity.joint_positions, strict=True)))
    msg = CollisionObject(name=name)
    for link in model.links:
        for shape in link.collision:
            pose = fill_pose(PoseMsg(), links[link.name] @ shape.pose)
            if shape.kind in ("box", "sphere", "cylinder"):
                msg.primitives.append(_primitive(shape))
                msg.primitive_poses.append(pose)
            else:
                msg.hulls.append(Mesh(vertices=[Point(x=x, y=y, z=z) for x, y, z in _hull_points(shape).tolist()]))
                msg.hull_poses.append(pose)
    return msg


def _primitive(shape: Shape) -> SolidPrimitive:
    if shape.kind == "box":
        return SolidPrimitive(type=SolidPrimitive.BOX, dimensions=list(shape.size))
    if shape.kind == "sphere":
        return SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=list(shape.size))
    radius, length = shape.size
    return SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=[length, radius])


def _hull_points(shape: Shape) -> Array:
    if shape.kind == "capsule":
        radius, length = shape.size
        return np.asarray(trimesh.creation.capsule(length, radius, count=[8, 8]).vertices)
    return np.asarray(trimesh.load_mesh(shape.mesh).convex_hull.vertices)


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
