"""Visual generators of angular bodies: boxes with round edges, convex bodies, blades. `turned` explains the design."""

from __future__ import annotations

import numpy as np

from roboxim_core.models.meshes import joined, triangles, visual_generators
from roboxim_core.poses import Array
from roboxim_core.vision.renderer import TriangleMesh

SLOT_STEPS = 4
"""Straight pieces of a quarter of a slot's round end."""


@visual_generators.register("rounded_box")
def rounded_box(size: tuple[float, ...]) -> TriangleMesh:
    """Return a box with round edges: extents x, y, z, radius [m].

    On each face u runs along its longer side and v along the other, 1 for the box's longest side: a texture is
    not stretched, and a wood grain runs lengthwise.

    Raises:
        ValueError: When the radius does not fit.
    """
    half, radius = np.asarray(size[:3], dtype=float) / 2, size[3]
    if not 0 < radius <= half.min():
        raise ValueError("the radius must be > 0 and at most half of the smallest extent")
    bend = radius * np.tan(np.radians([45.0, 22.5]))
    vertices: list[Array] = []
    normals: list[Array] = []
    uv: list[Array] = []
    faces: list[Array] = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        ticks = []
        for k in (first, second):
            inner = half[k] - radius
            ticks.append(np.concatenate([-inner - bend, [-inner, inner], inner + bend[::-1]]))
        for side in (-1.0, 1.0):
            a, b = np.meshgrid(*ticks, indexing="ij")
            on_cube = np.zeros((*a.shape, 3))
            on_cube[..., axis], on_cube[..., first], on_cube[..., second] = side * half[axis], a, b
            inside = np.clip(on_cube, radius - half, half - radius)
            normal = on_cube - inside
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            index = sum(map(len, vertices)) + np.arange(a.size).reshape(a.shape)
            p, q, r, s = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
            block = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
            faces.append(block if side > 0 else block[:, ::-1])
            vertices.append((inside + radius * normal).reshape(-1, 3))
            normals.append(normal.reshape(-1, 3))
            along = np.stack([a, b] if half[first] >= half[second] else [b, a], axis=-1)
            uv.append(along.reshape(-1, 2) / (2 * half.max()) + 0.5)
    return triangles(*(np.concatenate(part) for part in (vertices, normals, faces, uv)))


@visual_generators.register("convex")
def convex(size: tuple[float, ...]) -> TriangleMesh:
    """Return the convex hull of points x0, y0, z0, x1, ... [m], flat-shaded; ``uv`` spans each side's extents.

    Raises:
        ValueError: When the points span no volume.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.asarray(size, dtype=float)
    if len(points) % 3 or len(points) < 12:
        raise ValueError("needs x, y, z of at least four points")
    points = points.reshape(-1, 3)
    try:
        hull = ConvexHull(points)
    except QhullError:
        raise ValueError("the points span no volume") from None
    corners = points[hull.simplices]
    normals = hull.equations[:, :3]
    turned = np.einsum("ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), normals) < 0
    corners[turned] = corners[turned][:, ::-1]
    low, extent = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9)
    unit = (corners - low) / extent
    plane = np.array([[1, 2], [0, 2], [0, 1]])[np.abs(normals).argmax(axis=1)]
    uv = np.take_along_axis(unit, np.repeat(plane[:, None], 3, axis=1), axis=2)
    count = len(corners)
    return triangles(
        corners.reshape(-1, 3),
        np.repeat(normals, 3, axis=0),
        np.arange(3 * count).reshape(count, 3),
        uv.reshape(-1, 2),
    )


@visual_generators.register("panel")
def panel(size: tuple[float, ...]) -> TriangleMesh:
    """Return a rectangle that faces +x: extents y, z [m]; ``uv`` runs from 0 to 1, u along y, v along z.

    Raises:
        ValueError: On another number of values.
    """
    wide, high = size
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    vertices = np.insert((uv - 0.5) * [wide, high], 0, 0.0, axis=1)
    return triangles(vertices, np.tile([1.0, 0.0, 0.0], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), uv)


@visual_generators.register("slotted_board")
def slotted_board(size: tuple[float, ...]) -> TriangleMesh:
    """Return an upright board with a slot that has round ends, cut through along y.

    Args:
        size: Extents x, y, z of the board; length and height of the slot, height of its middle above the board's [m].
            On the board's sides u runs along x and v along z, each from 0 to 1.

    Raises:
        ValueError: On another number of values, or when the slot does not fit.
    """
    wide, thick, high, slot_wide, slot_high, slot_z = size
    x, y, z, radius = wide / 2, thick / 2, high / 2, slot_high / 2
    if not 0 < slot_high <= slot_wide < wide or abs(slot_z) + radius >= z:
        raise ValueError("the slot must be longer than high and end within the board")
    angle = np.linspace(np.pi / 2, 3 * np.pi / 2, 2 * SLOT_STEPS + 1)
    end = np.stack([np.cos(angle) * radius - (slot_wide / 2 - radius), np.sin(angle) * radius + slot_z], axis=1)
    hole = np.concatenate([end, end[::-1] * [-1.0, 1.0]])  # anticlockwise, seen along -y: left end, then the right one
    rim = np.array([[-x, z], [-x, -z], [x, -z], [x, z]])
    half, count = SLOT_STEPS, 4 * SLOT_STEPS + 2
    corner = [count + k for k in (0, 1, 2, 3)]
    flat = []
    for first, above, below in ((0, corner[0], corner[1]), (count // 2, corner[2], corner[3])):
        flat += [[first + k, above, first + k + 1] for k in range(half)]
        flat += [[first + half, above, below]]
        flat += [[first + half + k, below, first + half + k + 1] for k in range(half)]
    last, low = 2 * half, count // 2
    flat += [[last, corner[1], corner[2]], [last, corner[2], low], [count - 1, corner[3], corner[0]]]
    flat += [[count - 1, corner[0], 0]]
    points, faces = np.concatenate([hole, rim]), np.array(flat)
    uv = points / [wide, high] + 0.5
    pieces = []
    for side in (-1.0, 1.0):
        vertices = np.insert(points, 1, side * y, axis=1)
        normals = np.tile([0.0, side, 0.0], (len(points), 1))
        pieces.append((vertices, normals, faces, uv))
    for outline, inwards in ((hole, True), (rim, False)):
        near = np.concatenate([outline, outline[:1]])
        for a, b in zip(near[:-1], near[1:], strict=True):
            along = (b - a) / np.linalg.norm(b - a)
            across = np.array([-along[1], along[0]]) * (1.0 if inwards else -1.0)
            normal = np.array([across[0], 0.0, across[1]])
            vertices = np.array([[a[0], -y, a[1]], [b[0], -y, b[1]], [b[0], y, b[1]], [a[0], y, a[1]]])
            ends = np.array([a, b, b, a]) / [wide, high] + 0.5
            pieces.append((vertices, np.tile(normal, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), ends))
    return joined([_facing(piece) for piece in pieces])


@visual_generators.register("blade")
def blade(size: tuple[float, ...]) -> TriangleMesh:
    """Return a blade in the xy plane, thick at its back and sharp at its edge.

    Args:
        size: Thickness of the back, then of each station along x: x, y of the edge, y of the back [m].

    Raises:
        ValueError: On fewer than two stations.
    """
    if len(size) < 7 or (len(size) - 1) % 3:
        raise ValueError("needs the thickness, then x, edge, back of at least two stations")
    thick, stations = size[0], np.asarray(size[1:], dtype=float).reshape(-1, 3)
    x, edge, back = stations.T
    zero, top = np.zeros_like(x), np.full_like(x, thick / 2)
    v = np.linspace(0.0, 1.0, len(x))
    low, high = np.stack([x, edge, zero], 1), np.stack([x, back, top], 1)
    under = high * [1.0, 1.0, -1.0]
    parts = [_strip(low, high, v, (0, 0, 1)), _strip(low, under, v, (0, 0, -1)), _strip(under, high, v, (0, 1, 0))]
    end = np.array([low[0], under[0], high[0]])
    parts.append((end, np.tile([-1.0, 0.0, 0.0], (3, 1)), np.array([[0, 2, 1]]), np.zeros((3, 2))))
    return joined(parts)


def _facing(piece: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Return a piece whose triangles face the way of their first vertex's normal."""
    vertices, normals, faces, uv = piece
    p, q, r = (vertices[faces[:, k]] for k in range(3))
    wrong = np.einsum("ij,ij->i", np.cross(q - p, r - p), normals[faces[:, 0]]) < 0
    return vertices, normals, np.where(wrong[:, None], faces[:, ::-1], faces), uv


def _strip(first: Array, second: Array, u: Array, facing: tuple[int, int, int]) -> tuple[Array, Array, Array, Array]:
    """Return vertices, normals, faces and uv of the strip between two polylines, facing a direction."""
    count = len(first)
    vertices = np.concatenate([first, second])
    k = np.arange(count - 1)
    faces = np.concatenate([np.stack([k, k + 1, count + k + 1], 1), np.stack([k, count + k + 1, count + k], 1)])
    p, q, r = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(q - p, r - p)
    turned = normal @ np.asarray(facing) < 0
    faces[turned] = faces[turned][:, ::-1]
    normal[turned] *= -1
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], normal)
    normals += 1e-12 * np.asarray(facing)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = np.stack([np.tile(u, 2), np.repeat([0.0, 1.0], count)], axis=1)
    return vertices, normals, faces, uv
