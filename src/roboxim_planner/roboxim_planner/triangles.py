"""The geometry that the planner checks, as triangles: convex hulls of links and bodies, not their visual meshes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin
import trimesh
from scipy.spatial import ConvexHull

from roboxim_planner.collisions.geometry import make_shape
from roboxim_planner.robot import PlannerRobot, se3
from roboxim_planner.scene import Body, TriangleMesh

Array = npt.NDArray[np.float64]


def robot_triangles(robot: PlannerRobot, joints: Array, opening: float) -> Iterator[Array]:
    """Return the robot's collision geometry at an arm configuration.

    Args:
        robot: The robot.
        joints: Shape (dof,) [rad].
        opening: Opening of the gripper.

    Yields:
        Triangles of a link in the robot's base, shape (N, 3, 3) [m].
    """
    data = robot.model.createData()
    placed = robot.geometry.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.geometry, placed, robot.full(joints, opening))
    for item, placement in list(zip(robot.geometry.geometryObjects, placed.oMg, strict=True))[: robot.whole_shapes]:
        corners = _triangles(item.geometry)
        yield corners @ placement.rotation.T + placement.translation


def body_triangles(body: Body) -> Array:
    """Return a body's triangles in its parent frame, shape (N, 3, 3) [m]."""
    parts = []
    for shape in body.shapes:
        place = se3(body.pose @ shape.pose)
        if isinstance(shape, TriangleMesh):
            corners = np.array(shape.vertices)[np.array(shape.triangles)]
        else:
            corners = _triangles(make_shape(shape))
        parts.append(corners @ place.rotation.T + place.translation)
    return np.concatenate(parts)


def _triangles(shape: Any) -> Array:
    """Return the triangles of coal's convex shape."""
    if isinstance(shape, coal.ConvexBase):
        return _hull(np.asarray(shape.points()))
    if isinstance(shape, coal.Box):
        mesh = trimesh.creation.box(2.0 * shape.halfSide)
    elif isinstance(shape, coal.Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=shape.radius)
    elif isinstance(shape, coal.Cylinder):
        mesh = trimesh.creation.cylinder(radius=shape.radius, height=2.0 * shape.halfLength, sections=24)
    else:
        mesh = trimesh.creation.capsule(radius=shape.radius, height=2.0 * shape.halfLength, count=(16, 16))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return _fine(np.asarray(mesh.triangles))


def _hull(points: Array) -> Array:
    return _fine(points[ConvexHull(points).simplices])


def _fine(triangles: Array) -> Array:
    """Split large triangles, because painting in the order of distance is wrong for long ones."""
    split: Any = trimesh.remesh.subdivide_to_size
    vertices, faces = split(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), max_edge=0.12)
    return np.asarray(vertices[faces])
