"""Turns the shapes of scenes and models into coal's convex shapes."""

from __future__ import annotations

from functools import lru_cache

import coal
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import Shape
from roboxim_planner.scene import PointHull


def make_shape(shape: Shape | PointHull) -> coal.ShapeBase:
    """Return a new coal shape.

    Args:
        shape: The shape; its pose is not used.

    Raises:
        InvalidRequestError: When a hull's points span no volume or its file cannot be read.
    """
    if isinstance(shape, PointHull):
        made = coal.Convex(_hull_of_points(shape.points))
    elif shape.kind == "hull":
        made = coal.Convex(_hull_of_file(shape.mesh))
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
        InvalidRequestError: When the points do not span a volume. (coal itself would crash the process.)
    """
    array = np.asarray(points, dtype=float)
    try:
        corners = array[ConvexHull(array).vertices]
    except (QhullError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InvalidRequestError(f"{len(array)} points span no convex hull with a volume: {reason}") from None
    vertices = coal.StdVec_Vec3s()
    for corner in corners:
        vertices.append(corner)
    return coal.Convex.convexHull(vertices, True, "Qt")


@lru_cache(maxsize=256)
def _hull_of_points(points: tuple[tuple[float, float, float], ...]) -> coal.ConvexBase:
    return convex_hull(points)


@lru_cache(maxsize=256)
def _hull_of_file(path: str) -> coal.ConvexBase:
    try:
        mesh = coal.MeshLoader(coal.BV_OBBRSS).load(path, np.ones(3))
    except Exception as error:  # assimp's errors have no common class
        raise InvalidRequestError(f"cannot read the mesh {path}: {error}") from None
    return convex_hull([mesh.vertices(i) for i in range(mesh.num_vertices)])
