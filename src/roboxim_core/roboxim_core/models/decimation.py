"""Decimation of meshes: fewer triangles, each with the triangle that it comes from."""

from __future__ import annotations

import fast_simplification
import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Array


def decimated(
    points: Array, faces: npt.NDArray[np.integer], count: int, *, aggressiveness: float = 7.0
) -> tuple[Array, npt.NDArray[np.integer], npt.NDArray[np.intp]]:
    """Collapse edges until about ``count`` triangles are left. Triangles without area are dropped.

    Args:
        points: Vertices, welded: triangles that share no vertex come apart; shape (N, 3).
        faces: Indices of each triangle's vertices, shape (M, 3).
        count: Number of triangles to reach.
        aggressiveness: The higher, the faster and the coarser.

    Returns:
        The new vertices, the triangles that are left, and the index of each in ``faces``.
    """
    kept = np.flatnonzero(_whole(faces))
    faces, points = faces[kept].astype(np.int32), points.astype(np.float32)
    if len(faces) <= count:
        return points, faces, kept
    *_, collapses = fast_simplification.simplify(
        points, faces, target_count=count, agg=aggressiveness, return_collapses=True
    )
    points, _, mapping = fast_simplification.replay_simplification(points, faces, collapses)
    faces = mapping[faces]
    left = _whole(faces)
    return points, faces[left], kept[left]


def _whole(faces: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Return which triangles have three different vertices."""
    a, b, c = faces.T
    return np.asarray((a != b) & (b != c) & (c != a))
