"""What an object's shape allows: a flat top that supports, a hollow that contains, a base that can be pushed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import trimesh
from scipy import ndimage

from roboxim_core.models.description import Region
from roboxim_core.poses import Array, Pose

CELL_M = 0.002
"""Side of a cell of the height map [m]."""
FLAT_M = 0.0015
"""Largest unevenness of a flat top [m]."""
SMALLEST_TOP_M, SMALLEST_HOLLOW_M = 0.04, 0.05
"""Smallest diameter of a top that supports, and of a hollow that contains [m]."""
SHALLOWEST_M = 0.015
"""Smallest depth of a hollow [m]."""
SHRINK_M = 0.002
"""How much smaller than measured a region is made [m]."""
RIMS = (0.1, 0.2, 0.35, 0.5)
"""Distances of a rim from the object's top that are tried, as shares of its height."""
FLOOR_SHARE = 0.3
"""How far a hollow's floor may rise from its lowest point, as a share of its depth."""
EMPTY = -1e3
"""Height of a cell without the object [m]."""


def regions_of(parts: Sequence[trimesh.Trimesh]) -> list[Region]:
    """Return the places for other objects that convex parts leave open to above: a hollow, else a flat top.

    Args:
        parts: Convex parts in the base frame, z up [m].
    """
    low = np.min([part.bounds[0] for part in parts], axis=0)
    high = np.max([part.bounds[1] for part in parts], axis=0)
    heights = height_map(parts, low, high)
    hollow = _hollow(heights, low)
    return [hollow] if hollow else [top for top in (_top(heights, low),) if top]


def height_map(parts: Sequence[trimesh.Trimesh], low: Array, high: Array) -> Array:
    """Return the heights of convex parts as seen from above, `EMPTY` where there is none.

    Args:
        parts: The parts [m].
        low: Smallest x, y, z of the map [m].
        high: Largest x, y, z [m].

    Returns:
        Shape (columns along x, columns along y) [m].
    """
    xs, ys = (np.arange(low[k] + CELL_M / 2, high[k], CELL_M) for k in (0, 1))
    x, y = np.meshgrid(xs, ys, indexing="ij")
    heights = np.full(x.shape, EMPTY)
    for part in parts:
        normals, offsets = part.face_normals, np.einsum("ij,ij->i", part.face_normals, part.triangles[:, 0])
        upper, lower = np.full(x.shape, np.inf), np.full(x.shape, -np.inf)
        for (a, b, c), offset in zip(normals, offsets, strict=True):  # a x + b y + c z <= offset
            side = offset - a * x - b * y
            if c > 1e-9:
                upper = np.minimum(upper, side / c)
            elif c < -1e-9:
                lower = np.maximum(lower, side / c)
            else:
                upper = np.where(side < 0, -np.inf, upper)
        heights = np.where(upper >= lower, np.maximum(heights, upper), heights)
    return heights


def _disc(cells: npt.NDArray[np.bool_], low: Array) -> tuple[float, float, float]:
    """Return the largest disc inside marked cells: x, y of its middle and its radius [m]."""
    inside = ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1]
    column, row = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return (
        float(low[0] + (column + 0.5) * CELL_M), float(low[1] + (row + 0.5) * CELL_M),
        float(inside[column, row] * CELL_M - SHRINK_M),
    )  # fmt: skip


def _top(heights: Array, low: Array) -> Region | None:
    """Return the flat top as a region, if there is one."""
    highest = float(heights.max())
    x, y, radius = _disc(heights > highest - FLAT_M, low)
    if 2 * radius < SMALLEST_TOP_M:
        return None
    place = Pose(position=(round(x, 4), round(y, 4), round(highest, 4)))
    size = round(2 * radius, 4)
    return Region(kind="surface", shape="disc", pose=place, size=(size, size, 0.0))


def _hollow(heights: Array, low: Array) -> Region | None:
    """Return the largest hollow that a closed rim surrounds, if there is one."""
    lowest, highest = float(low[2]), float(heights.max())
    for share in RIMS:
        rim = highest - share * (highest - lowest)
        wall = heights >= rim
        inner = ndimage.binary_fill_holes(wall) & ~wall & (heights > EMPTY)
        if not inner.any():
            continue
        bottom = float(heights[inner].min())
        x, y, radius = _disc(inner & (heights <= bottom + FLOOR_SHARE * (rim - bottom)), low)
        if 2 * radius < SMALLEST_HOLLOW_M:
            continue
        columns, rows = np.indices(heights.shape)
        near = np.hypot(low[0] + (columns + 0.5) * CELL_M - x, low[1] + (rows + 0.5) * CELL_M - y) < radius
        floor = float(heights[near].max())
        if rim - floor < SHALLOWEST_M:
            continue
        place, size = Pose(position=(round(x, 4), round(y, 4), round(floor, 4))), round(2 * radius, 4)
        return Region(kind="interior", shape="disc", pose=place, size=(size, size, round(rim - floor, 4)))
    return None
