"""Visual generators of round bodies: surfaces of revolution, bent tubes, ribbons around them.

Each is a function of the numbers in a visual's ``size``, so that an object needs a YAML file and no code. Their texture
coordinates: u around the axis, v along the profile or path, both from 0 to 1.
"""

from __future__ import annotations

import numpy as np

from roboxim_core.models.meshes import joined, triangles, visual_generators
from roboxim_core.poses import Array
from roboxim_core.vision.renderer import TriangleMesh

CREASE_RAD = np.radians(35.0)
"""Where a profile turns by more, the surface has an edge."""
FOLD_RAD = np.radians(179.0)
"""Where a smooth profile turns by more, it has no mean normal."""
AROUND_M, ALONG_M = 0.008, 0.004
"""Length of a facet around the widest place, unless that gives fewer than 12 or more than 36, and along a curve."""


@visual_generators.register("lathe")
def lathe(size: tuple[float, ...]) -> TriangleMesh:
    """Return a surface of revolution about z.

    Args:
        size: Points of the profile r0, z0, r1, z1, ... [m], seen with the axis on the left: from the bottom along the
            outside to the top, then, of a vessel, down the inside.

    Raises:
        ValueError: On fewer than two points, equal points in a row, or a negative radius.
    """
    return _revolved(_pairs(size))


@visual_generators.register("smooth_lathe")
def smooth_lathe(size: tuple[float, ...]) -> TriangleMesh:
    """Return a surface of revolution about z whose profile is a smooth curve through points; else as `lathe`.

    Where the profile turns back on itself, the surface has an edge.
    """
    points = _pairs(size)
    curve = _spline(points)
    curve[:, 0] = np.maximum(curve[:, 0], 0.0)
    return _revolved(curve, crease_rad=FOLD_RAD)


@visual_generators.register("tube")
def tube(size: tuple[float, ...]) -> TriangleMesh:
    """Return a bent tube with closed ends.

    Args:
        size: Points on its axis, each with the radius there: x0, y0, z0, r0, x1, ... [m].

    Raises:
        ValueError: On fewer than two points, or equal points in a row.
    """
    if len(size) < 8 or len(size) % 4:
        raise ValueError("a tube needs x, y, z, radius of at least two points")
    points = np.asarray(size, dtype=float).reshape(-1, 4)
    _require_distinct(points[:, :3])
    curve = _spline(points) if len(points) > 2 else points
    path, radius = curve[:, :3], np.maximum(curve[:, 3], 0.0)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    sections = int(np.clip(round(2 * np.pi * radius.max() / AROUND_M), 12, 18))
    angle = np.linspace(0.0, 2 * np.pi, sections + 1)
    side = np.cross(tangent[0], [0.0, 0.0, 1.0] if abs(tangent[0, 2]) < 0.9 else [1.0, 0.0, 0.0])
    along = _fraction(path)
    slope = np.gradient(radius, along * _length(path) + 1e-12)
    rings, normals = [], []
    for point, forward, r, grows in zip(path, tangent, radius, slope, strict=True):
        side = side - forward * (side @ forward)  # carried along without twist
        side /= np.linalg.norm(side)
        out = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(forward, side)
        rings.append(point + r * out)
        normal = out - np.clip(grows, -3.0, 3.0) * forward
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    u = np.linspace(0.0, 1.0, sections + 1)
    mesh = _grid_mesh(np.array(rings), np.array(normals), u, along)
    caps = [_cap(rings[0], -tangent[0], path[0], 0.0), _cap(rings[-1], tangent[-1], path[-1], 1.0)]
    pieces = [mesh, *[cap for cap, r in zip(caps, (radius[0], radius[-1]), strict=True) if r > 1e-5]]
    return joined([(p.vertices, p.normals, p.faces, p.uv) for p in pieces if p.uv is not None])


@visual_generators.register("ribbon")
def ribbon(size: tuple[float, ...]) -> TriangleMesh:
    """Return a wavy ribbon around z.

    Args:
        size: Radius, height of its middle line, width, amplitude of the wave [m], number of waves, number of
            repetitions of the texture around it.

    Raises:
        ValueError: On another number of values.
    """
    radius, z, width, amplitude, waves, repeats = size
    u = np.linspace(0.0, 1.0, 41)
    out = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), np.zeros_like(u)], axis=1)
    middle = z + amplitude * np.sin(2 * np.pi * waves * u)
    rows = [radius * out + np.outer(middle + side * width / 2, [0.0, 0.0, 1.0]) for side in (-1, 1)]
    return _grid_mesh(np.array(rows), np.array([out, out]), repeats * u, np.array([0.0, 1.0]))


def _pairs(size: tuple[float, ...]) -> Array:
    if len(size) < 4 or len(size) % 2:
        raise ValueError("a profile needs r, z of at least two points")
    points = np.asarray(size, dtype=float).reshape(-1, 2)
    if points[:, 0].min() < 0:
        raise ValueError("a profile's radius must not be negative")
    _require_distinct(points)
    return points


def _require_distinct(points: Array) -> None:
    """Refuse equal points in a row, between which a surface has no direction."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if steps.min() < 1e-9:
        number = int(steps.argmin())
        raise ValueError(f"points {number + 1} and {number + 2} are the same: leave one out")


def _spline(points: Array) -> Array:
    """Sample a curve through points that does not overshoot, in 4 to 22 pieces, at least one for each span."""
    from scipy.interpolate import PchipInterpolator

    place = points[:, : max(2, points.shape[1] - 1)]
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(place, axis=0), axis=1), 1e-6))])
    pieces = int(np.clip(round(knots[-1] / ALONG_M), 4, 22))
    share = np.maximum(1, np.round(pieces * np.diff(knots) / knots[-1]).astype(int))
    spans = zip(knots, knots[1:], share, strict=False)
    where = np.concatenate([np.linspace(low, high, count, endpoint=False) for low, high, count in spans])
    return np.asarray(PchipInterpolator(knots, points)(np.append(where, knots[-1])))


def _fraction(path: Array) -> Array:
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum())


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _revolved(profile: Array, crease_rad: float = CREASE_RAD) -> TriangleMesh:
    segments = int(np.clip(round(2 * np.pi * profile[:, 0].max() / AROUND_M), 12, 36))
    steps = np.diff(profile, axis=0)
    facing = np.stack([steps[:, 1], -steps[:, 0]], axis=1) / np.linalg.norm(steps, axis=1, keepdims=True)
    v = _fraction(profile)
    rows, normals, heights = [profile[0]], [facing[0]], [v[0]]
    for k in range(1, len(profile) - 1):
        turn = np.arccos(np.clip(facing[k - 1] @ facing[k], -1.0, 1.0))
        if turn > crease_rad:
            rows += [profile[k], profile[k]]
            normals += [facing[k - 1], facing[k]]
            heights += [v[k], v[k]]
        else:
            rows.append(profile[k])
            normals.append(facing[k - 1] + facing[k])
            heights.append(v[k])
    rows.append(profile[-1])
    normals.append(facing[-1])
    heights.append(v[-1])
    u = np.linspace(0.0, 1.0, segments + 1)
    out = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), np.zeros_like(u)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    vertices = np.array([r * out + z * up for r, z in rows])
    outward = np.array([n[0] * out + n[1] * up for n in np.array(normals) / np.linalg.norm(normals, axis=1)[:, None]])
    return _grid_mesh(vertices, outward, u, np.array(heights))


def _grid_mesh(vertices: Array, normals: Array, u: Array, v: Array) -> TriangleMesh:
    """Return rows of vertices of shape (rows, columns, 3) as a mesh, facing outwards, without empty triangles."""
    rows, columns, _ = vertices.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = vertices.reshape(-1, 3)
    p, q, r = (points[faces[:, i]] for i in range(3))
    doubled = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    uv = np.stack([np.tile(u, rows), np.repeat(v, columns)], axis=1)
    return triangles(points, normals.reshape(-1, 3), faces[doubled > 1e-12], uv)


def _cap(ring: Array, normal: Array, center: Array, v: float) -> TriangleMesh:
    count = len(ring)
    vertices = np.concatenate([ring, center[None]])
    index = np.arange(count - 1)
    faces = np.stack([index, index + 1, np.full(count - 1, count)], axis=1)
    if np.cross(ring[1] - ring[0], center - ring[0]) @ normal < 0:
        faces = faces[:, ::-1]
    uv = np.tile([0.5, v], (count + 1, 1))  # one point: a whole turn would sample the mean
    return triangles(vertices, np.tile(normal, (count + 1, 1)), faces, uv)
