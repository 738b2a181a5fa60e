"""Decomposition of a mesh into convex parts that cover it.

The mesh is cut repeatedly by a plane perpendicular to an axis, where the hulls of the two pieces are smallest. The hull
of a piece contains the piece, so the parts contain the mesh: a body that touches the mesh also touches a part.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

Array = npt.NDArray[np.float64]
PLANES = 40
"""Number of cuts to try along each axis."""


def convex_parts(mesh: trimesh.Trimesh, *, min_gain: float, max_parts: int) -> list[trimesh.Trimesh]:
    """Cut a closed mesh into pieces and return their convex hulls.

    Args:
        mesh: The mesh.
        min_gain: Minimum fraction of the whole hull's volume that a cut must save.
        max_parts: Maximum number of parts.
    """
    pieces = [np.asarray(mesh.triangles, dtype=float)]
    cuts = [_best_cut(pieces[0])]
    min_saved = min_gain * _volume(pieces[0])
    while len(pieces) < max_parts:
        k = int(np.argmax([saved for saved, _ in cuts]))
        saved, halves = cuts[k]
        if saved < min_saved:
            break
        pieces[k : k + 1] = halves
        cuts[k : k + 1] = [_best_cut(half) for half in halves]
    return [trimesh.convex.convex_hull(piece.reshape(-1, 3)) for piece in pieces]


def around(points: npt.ArrayLike, directions: int = 100) -> trimesh.Trimesh:
    """Return a tight polytope with few faces that contains the points: each face touches a point.

    Args:
        points: The points, shape (N, 3).
        directions: Number of faces in addition to the six of the box; their normals are spread evenly over the sphere.
    """
    inside = np.asarray(points, dtype=float)
    k = np.arange(directions) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / directions), np.pi * (1.0 + 5.0**0.5) * k
    even = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    normals = np.concatenate([even, np.eye(3), -np.eye(3)])
    farthest = (inside @ normals.T).max(axis=0)
    corners = HalfspaceIntersection(np.column_stack([normals, -farthest]), inside.mean(axis=0)).intersections
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(np.unique(np.round(corners, 9), axis=0))
    return hull


def coarser(mesh: trimesh.Trimesh, within_m: float) -> trimesh.Trimesh:
    """Return a polytope of few faces that contains a convex mesh and reaches little beyond it.

    It starts as a box. Of the planes of the mesh's faces, the one that its farthest corner violates most is added until
    no corner is farther away than ``within_m``.

    Args:
        mesh: A convex mesh.
        within_m: How far a corner may lie in front of a face's plane [m]; 0: the mesh itself is returned.
    """
    if within_m == 0.0:
        return mesh
    points = np.asarray(mesh.vertices, dtype=float)
    normals = np.unique(np.round(mesh.face_normals[mesh.area_faces > 0.0], 9), axis=0)
    farthest = (points @ normals.T).max(axis=0)
    box = np.concatenate([np.eye(3), -np.eye(3)])
    planes = HalfspaceIntersection(
        np.column_stack([box, -(points @ box.T).max(axis=0)]), points.mean(axis=0), incremental=True
    )
    for _ in normals:
        beyond = planes.intersections @ normals.T - farthest
        corner, face = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[corner, face] <= within_m:
            break
        planes.add_halfspaces(np.append(normals[face], -farthest[face])[None])
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(np.unique(np.round(planes.intersections, 9), axis=0))
    return hull if len(hull.faces) < len(mesh.faces) else mesh


def _best_cut(triangles: Array) -> tuple[float, list[Array]]:
    """Return the decrease of the hulls' volume by the best cut, and the two halves."""
    whole = _volume(triangles)
    best: tuple[float, list[Array]] = (0.0, [])
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    for axis in range(3):
        for place in np.linspace(low[axis], high[axis], PLANES + 2)[1:-1]:
            heights = triangles[:, :, axis] - place
            halves = [_clip(triangles, heights), _clip(triangles, -heights)]
            saved = whole - sum(_volume(half) for half in halves)
            if saved > best[0]:
                best = saved, halves
    return best


def _volume(triangles: Array) -> float:
    try:
        return float(ConvexHull(triangles.reshape(-1, 3)).volume)
    except (QhullError, ValueError):
        return float("inf")


def _clip(triangles: Array, heights: Array) -> Array:
    """Clip triangles, shape (N, 3, 3), to heights >= 0, given the heights of their corners, shape (N, 3)."""
    inside = heights >= 0.0
    count = inside.sum(axis=1)
    kept = [triangles[count == 3]]
    for corners in (1, 2):
        some = count == corners
        odd = np.argmax(inside[some] == (corners == 1), axis=1)  # the only corner on its side
        order = (odd[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[some], order[:, :, None], axis=1), 1, 0)
        high = np.take_along_axis(heights[some], order, axis=1)
        ab = a + (high[:, :1] / (high[:, :1] - high[:, 1:2])) * (b - a)
        ac = a + (high[:, :1] / (high[:, :1] - high[:, 2:])) * (c - a)
        if corners == 1:
            kept.append(np.stack([a, ab, ac], axis=1))
        else:
            kept += [np.stack([b, c, ab], axis=1), np.stack([c, ac, ab], axis=1)]
    return np.concatenate(kept)
