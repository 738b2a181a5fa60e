"""Spheres that cover a convex shape: a cheap lower bound of its distance from any other shape.

The piece with the largest sphere is cut in two across its longest extent until there are as many pieces as spheres. The
pieces together are the shape, so the spheres around them cover it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SPHERES = 8
"""Spheres per convex shape; the native kernel processes eight at a time."""
_SAFE_M = 1e-7


def cover_hull(points: Array) -> Array:
    """Return spheres that cover the convex hull of points.

    Args:
        points: Shape (N, 3), spanning a volume [m].

    Returns:
        Rows of centre and radius, shape (8, 4) [m].
    """
    return _cover_hull(np.ascontiguousarray(points).tobytes()).copy()


@lru_cache(maxsize=256)
def _cover_hull(raw: bytes) -> Array:
    pieces = [_corners(np.frombuffer(raw).reshape(-1, 3))]
    balls = [_ball(pieces[0])]
    while len(pieces) < SPHERES:
        worst = int(np.argmax([ball[3] for ball in balls]))
        halves = _halve(pieces.pop(worst))
        balls.pop(worst)
        pieces += halves
        balls += [_ball(half) for half in halves]
    return np.array(balls)


def cover_box(size: npt.ArrayLike) -> Array:
    """Return spheres that cover a box with its centre at the origin.

    Args:
        size: Extents along x, y, z [m].

    Returns:
        Rows of centre and radius, shape (N, 4), N <= 8 [m].
    """
    x, y, z = np.asarray(size, dtype=float).tolist()
    return _cover_box(x, y, z).copy()


@lru_cache(maxsize=1024)
def _cover_box(x: float, y: float, z: float) -> Array:
    extents = np.array([x, y, z])
    parts = np.ones(3, dtype=int)
    while True:
        longest = int(np.argmax(extents / parts))
        more = parts.copy()
        more[longest] += 1
        if more.prod() > SPHERES:
            break
        parts = more
    axes = [(np.arange(n) + 0.5) * (extent / n) - extent / 2 for n, extent in zip(parts, extents, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(extents / parts) / 2 + _SAFE_M
    return np.column_stack([centers, np.full(len(centers), radius)])


def cover_round(radius: float, length: float, *, capped: bool) -> Array:
    """Return spheres that cover a cylinder along z, or a capsule of that cylinder, centred at the origin.

    Args:
        radius: Radius [m].
        length: Length of the cylinder [m].
        capped: Whether it is a capsule.

    Returns:
        Rows of centre and radius, shape (N, 4), N <= 8 [m].
    """
    count = int(np.clip(np.ceil(length / max(radius, 1e-6)), 1, SPHERES))
    centers = np.zeros((count, 3))
    centers[:, 2] = (np.arange(count) + 0.5) * (length / count) - length / 2
    half = length / (2 * count)
    around = radius + half if capped else float(np.hypot(radius, half))
    return np.column_stack([centers, np.full(count, around + _SAFE_M)])


def _corners(points: Array) -> Array:
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points, qhull_options="QJ").vertices] if len(points) > 4 else points


def _ball(points: Array) -> Array:
    """Return a small sphere around points: ever smaller steps to the farthest point (Badoiu and Clarkson, 2003)."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    best_center, best = center, float(np.linalg.norm(points - center, axis=1).max())
    for step in range(1, 60):
        away = np.linalg.norm(points - center, axis=1)
        far = int(np.argmax(away))
        if away[far] < best:
            best_center, best = center, float(away[far])
        center = center + (points[far] - center) / (step + 1)
    return np.append(best_center, best + _SAFE_M)


def _halve(points: Array) -> list[Array]:
    """Cut a polytope across its longest extent; return the corners of each half, both with those of the cut."""
    from scipy.spatial import ConvexHull

    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    height = (points - middle) @ axis
    height -= 0.5 * (height.min() + height.max())
    faces = ConvexHull(points, qhull_options="QJ").simplices
    edges = np.concatenate([faces[:, pair] for pair in ([0, 1], [1, 0], [1, 2], [2, 1], [2, 0], [0, 2])])
    i, k = edges[(height[edges[:, 0]] > 0) & (height[edges[:, 1]] < 0)].T
    share = (height[i] / (height[i] - height[k]))[:, None]
    cut = points[i] + share * (points[k] - points[i])
    return [_corners(np.concatenate([half, cut])) for half in (points[height >= 0], points[height <= 0])]
