"""Converts the shapes of scenes and models to coal's, with their poses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import coal
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_planner.native import native
from roboxim_planner.scene import BodyShape, PlanningScene, PointHull, TriangleMesh

Array = npt.NDArray[np.float64]
THINNEST_HULL = 1e-6
"""Smallest thickness of a hull, as a fraction of its largest coordinate or of 1 m. coal crashes below about 5e-7."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedShape:
    """A part of a resting body."""

    body: str
    """Name of the body."""
    shape: BodyShape
    """The part."""
    pose: Array
    """Pose in the robot's base, shape (4, 4)."""


def placed_shapes(scene: PlanningScene) -> list[PlacedShape]:
    """Return all parts of a scene's bodies in the frame of the robot's base."""
    parts = [(body, shape) for body in scene.bodies for shape in body.shapes]
    poses = pose_matrices([body.pose for body, _ in parts])
    if any(shape.pose is not IDENTITY for _, shape in parts):
        poses = poses @ pose_matrices([shape.pose for _, shape in parts])
    if scene.robot_pose != IDENTITY:
        poses = np.linalg.inv(pose_matrices([scene.robot_pose])) @ poses
    return [
        PlacedShape(body=body.name, shape=shape, pose=pose) for (body, shape), pose in zip(parts, poses, strict=True)
    ]


def pose_matrices(poses: list[Pose]) -> Array:
    """Return poses as homogeneous matrices, shape (N, 4, 4); much faster than scipy."""
    return native.pose_matrices(np.array([(*pose.position, *pose.quat_xyzw) for pose in poses]).reshape(-1, 7))


def make_shape(shape: BodyShape) -> coal.CollisionGeometry:
    """Return a new coal shape.

    Args:
        shape: The shape; its pose is not used.

    Raises:
        InvalidRequestError: When a hull's points span no volume or its file cannot be read.
    """
    if isinstance(shape, PointHull):
        made = coal.Convex(_hull_of_points(shape.points))
    elif isinstance(shape, TriangleMesh):
        made = _surface(shape.vertices, shape.triangles)
    elif shape.kind == "hull":
        made = coal.Convex(_hull_of_file(shape.mesh, shape.scale))
    elif shape.kind == "box":
        made = coal.Box(*shape.size)
    elif shape.kind == "sphere":
        made = coal.Sphere(*shape.size)
    else:
        made = (coal.Cylinder if shape.kind == "cylinder" else coal.Capsule)(*shape.size)
    made.computeLocalAABB()
    return made


def convex_hull(points: npt.ArrayLike) -> coal.ConvexBase:
    """Return the convex hull of points of shape (N, 3) [m].

    Raises:
        InvalidRequestError: When the points span no volume, or a thinner one than `THINNEST_HULL`. (coal itself would
            crash the process.)
    """
    from scipy.spatial import ConvexHull, QhullError

    array = np.asarray(points, dtype=float).reshape(-1, 3)
    try:
        corners = array[ConvexHull(array).vertices]
    except (QhullError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InvalidRequestError(f"{len(array)} points span no convex hull with a volume: {reason}") from None
    thinnest = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2][-1]
    thickness, needed = float(np.ptp(corners @ thinnest)), THINNEST_HULL * max(1.0, float(np.abs(corners).max()))
    if thickness < needed:
        raise InvalidRequestError(
            f"{len(array)} points span a hull only {thickness:.2g} m thick, at least {needed:.2g} m needed; "
            "give a flat part as a mesh, or make it thicker"
        )
    vertices = coal.StdVec_Vec3s()
    for corner in corners:
        vertices.append(corner)
    return coal.Convex.convexHull(vertices, True, "Qt")


@lru_cache(maxsize=256)
def _hull_of_points(points: tuple[tuple[float, float, float], ...]) -> coal.ConvexBase:
    return convex_hull(points)


@lru_cache(maxsize=64)
def _surface(points: tuple[Vec3, ...], triangles: tuple[tuple[int, int, int], ...]) -> coal.BVHModelOBBRSS:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(points))
    mesh.addVertices(np.array(points))
    mesh.addTriangles(np.array(triangles, dtype=np.int32))
    mesh.endModel()
    return mesh


@lru_cache(maxsize=256)
def _hull_of_file(path: str, scale: float) -> coal.ConvexBase:
    return convex_hull(mesh_points(path, scale))


def mesh_points(path: str, scale: float) -> tuple[Vec3, ...]:
    """Return the vertices of a mesh file.

    Args:
        path: The file.
        scale: Metres per unit of the file.

    Raises:
        InvalidRequestError: When it cannot be read.
    """
    try:
        mesh = coal.MeshLoader(coal.BV_OBBRSS).load(path, np.full(3, scale))
    except Exception as error:  # assimp's errors have no common class
        raise InvalidRequestError(f"cannot read the mesh {path}: {error}") from None
    return tuple((float(x), float(y), float(z)) for x, y, z in np.asarray(mesh.vertices()).tolist())
