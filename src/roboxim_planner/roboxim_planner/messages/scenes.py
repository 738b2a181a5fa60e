"""Converts the scene of a request: primitives, hulls, meshes, library models, held bodies, allowed contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from shape_msgs.msg import SolidPrimitive

from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec
from roboxim_planner.messages.conversions import optional_pose
from roboxim_planner.scene import (
    AllowedContact,
    Attached,
    Body,
    BodyShape,
    PlanningScene,
    PointHull,
    TriangleMesh,
    model_shapes,
)
from roboxim_ros.messages.conversions import scalar_from_json


def scene_from_msg(msg: Any, named: PlanningScene | None, library: ModelLibrary) -> PlanningScene:
    """Build a request's scene.

    Args:
        msg: ``PlanningScene`` message.
        named: The simulated revision that the message names; none: it names no revision.
        library: Source of the objects that name a model.
    """
    scene = named or PlanningScene(robot_pose=optional_pose(msg.robot_pose_in_world, what="robot_pose_in_world"))
    scene = scene.without(msg.ignored_objects)
    scene = scene.with_bodies(_body_from_msg(item, library) for item in msg.objects)
    for item in msg.attached:
        links = tuple(item.touch_links)
        if not item.entity:
            scene = scene.holding(Attached(body=_body_from_msg(item.object, library), touch_links=links))
        elif scene.pose_tcp is None:
            raise InvalidRequestError(
                f"attached entity '{item.entity}' needs a scene named by episode_id; give its geometry in 'object'"
            )
        else:
            scene = scene.attach(item.entity, scene.pose_tcp, links)
    opening = opening_from_msg(msg)
    scene = scene.with_contacts(allowed_from_msg(msg))
    return scene if opening is None else scene.with_opening(opening)


def allowed_from_msg(msg: Any) -> tuple[AllowedContact, ...]:
    """Convert the ``allowed_contacts`` of a message."""
    return tuple(AllowedContact(body_a=item.body_a, body_b=item.body_b) for item in msg.allowed_contacts)


def opening_from_msg(msg: Any) -> float | None:
    """Convert the ``gripper_opening`` of a message; none: the message gives no opening.

    Raises:
        InvalidRequestError: If it has several.
    """
    if len(msg.gripper_opening) > 1:
        raise InvalidRequestError(f"gripper_opening takes at most one number, got {len(msg.gripper_opening)}")
    return float(msg.gripper_opening[0]) if len(msg.gripper_opening) else None


def _body_from_msg(msg: Any, library: ModelLibrary) -> Body:
    shapes: list[BodyShape] = []
    if msg.model:
        modifiers = {item.key: _scalar(msg.name, item) for item in msg.modifiers}
        positions = {item.name: float(item.value) for item in msg.joint_positions}
        entity = EntitySpec(name=msg.name, model=msg.model, modifiers=modifiers, joint_positions=positions)
        shapes += model_shapes(library.entity_model(entity), positions)
    for primitive, pose in _posed(msg, msg.primitives, msg.primitive_poses):
        shapes.append(_primitive(msg.name, primitive, pose))
    for hull, pose in _posed(msg, msg.hulls, msg.hull_poses):
        shapes.append(PointHull(points=_points(hull), pose=pose))
    for mesh, pose in _posed(msg, msg.meshes, msg.mesh_poses):
        indices = np.array([triangle.vertex_indices for triangle in mesh.triangles], dtype=int).reshape(-1, 3)
        corners = tuple((a, b, c) for a, b, c in indices.tolist())
        shapes.append(TriangleMesh(vertices=_points(mesh), triangles=corners, pose=pose))
    return Body(name=msg.name, shapes=tuple(shapes), pose=optional_pose(msg.pose, what=f"pose of object '{msg.name}'"))


def _scalar(name: str, item: Any) -> Any:
    try:
        return scalar_from_json(item.value)
    except InvalidRequestError as error:
        raise InvalidRequestError(f"object '{name}': modifier '{item.key}': {error}") from None


def _posed(msg: Any, shapes: Sequence[Any], poses: Sequence[Any]) -> list[tuple[Any, Pose]]:
    if len(poses) not in (0, len(shapes)):
        raise InvalidRequestError(f"object '{msg.name}': give one pose per shape, or none at all")
    what = f"pose of a shape of object '{msg.name}'"
    placed = [optional_pose(pose, what=what) for pose in poses] or [IDENTITY] * len(shapes)
    return list(zip(shapes, placed, strict=True))


def _points(mesh: Any) -> tuple[tuple[float, float, float], ...]:
    return tuple((p.x, p.y, p.z) for p in mesh.vertices)


def _primitive(name: str, primitive: SolidPrimitive, pose: Pose) -> Shape | PointHull:
    size = tuple(float(value) for value in primitive.dimensions)
    if primitive.type == SolidPrimitive.CONE:
        if len(size) != 2 or not all(0.0 < value < 100.0 for value in size):
            raise InvalidRequestError(f"object '{name}': a cone has height and radius between 0 and 100 m, got {size}")
        return PointHull(points=_cone(*size), pose=pose)
    if primitive.type not in _KINDS:
        raise InvalidRequestError(
            f"object '{name}': primitive type must be BOX (1), SPHERE (2), CYLINDER (3) or CONE (4), got "
            f"{primitive.type}; give other shapes as hulls or meshes"
        )
    if primitive.type == SolidPrimitive.CYLINDER and len(size) == 2:
        size = size[1], size[0]  # the message gives the height first
    return Shape(kind=_KINDS[primitive.type], size=size, pose=pose)


def _cone(height: float, radius: float, sides: int = 32) -> tuple[tuple[float, float, float], ...]:
    """Return the corners of a pyramid around a cone along z whose origin is in the middle of its height."""
    angles = 2.0 * math.pi * np.arange(sides) / sides
    outside = radius / math.cos(math.pi / sides)
    rim = [(outside * math.cos(a), outside * math.sin(a), -0.5 * height) for a in angles.tolist()]
    return (*rim, (0.0, 0.0, 0.5 * height))


_KINDS = {SolidPrimitive.BOX: "box", SolidPrimitive.SPHERE: "sphere", SolidPrimitive.CYLINDER: "cylinder"}
