"""The registry of visual generators, and the primitive meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Array
from roboxim_core.registry import Registry
from roboxim_core.vision.renderer import TriangleMesh

if TYPE_CHECKING:
    import trimesh

visual_generators: Registry[Callable[[tuple[float, ...]], TriangleMesh]] = Registry("visual generator")
"""Visual generators: functions from a visual's ``size`` to its mesh in the visual's frame."""


@visual_generators.register("box")
def box_mesh(size: tuple[float, ...]) -> TriangleMesh:
    """Return a box with bevelled edges: extents x, y, z [m]. ``uv`` runs from 0 to 1 over each face."""
    half = np.asarray(size, dtype=float) / 2
    bevel = min(0.0015, 0.08 * float(half.min()))
    vertices: list[Array] = []
    normals: list[Array] = []
    uv: list[Array] = []
    faces: list[list[int]] = []

    def quad(corners: Array, normal: Array, corner_normals: Array, coordinates: Array) -> None:
        a, b, c, d = range(len(vertices), len(vertices) + 4)
        outward = float(np.dot(np.cross(corners[1] - corners[0], corners[2] - corners[0]), normal)) > 0
        faces.extend([[a, b, c], [a, c, d]] if outward else [[a, c, b], [a, d, c]])
        vertices.extend(corners)
        normals.extend(corner_normals)
        uv.extend(coordinates)

    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = side
            corners = np.zeros((4, 3))
            corners[:, axis] = side * half[axis]
            corners[:, [first, second]] = signs * (half[[first, second]] - bevel)
            quad(corners, normal, np.tile(normal, (4, 1)), signs / 2 + 0.5)
            for other in (-1.0, 1.0):  # the bevel shared with the neighbour along `first`
                neighbour = np.zeros(3)
                neighbour[first] = other
                along = np.array([-1.0, 1.0]) * (half[second] - bevel)
                edge = np.zeros((4, 3))
                edge[:, second] = [along[0], along[1], along[1], along[0]]
                edge[:2, axis], edge[2:, axis] = side * half[axis], side * (half[axis] - bevel)
                edge[:2, first], edge[2:, first] = other * (half[first] - bevel), other * half[first]
                quad(edge, normal + neighbour, np.stack([normal, normal, neighbour, neighbour]), np.full((4, 2), 0.5))
    for corner in np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T:
        points = corner * (half - bevel * (1 - np.eye(3)))
        start = len(vertices)
        faces.append([start, start + 1, start + 2] if np.prod(corner) > 0 else [start, start + 2, start + 1])
        vertices.extend(points)
        normals.extend(np.diag(corner))
        uv.extend(np.full((3, 2), 0.5))
    return triangles(np.array(vertices), np.array(normals), np.array(faces), np.array(uv))


@visual_generators.register("sphere")
def sphere_mesh(size: tuple[float, ...]) -> TriangleMesh:
    """Return a sphere: (radius,) [m]."""
    import trimesh

    return from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=size[0]))


@visual_generators.register("cylinder")
def cylinder_mesh(size: tuple[float, ...]) -> TriangleMesh:
    """Return a cylinder along z: (radius, length) [m]."""
    import trimesh

    return from_trimesh(trimesh.creation.cylinder(radius=size[0], height=size[1], sections=40))


@visual_generators.register("capsule")
def capsule_mesh(size: tuple[float, ...]) -> TriangleMesh:
    """Return a capsule along z, centred: (radius, length of the cylinder) [m]."""
    import trimesh

    mesh = trimesh.creation.capsule(radius=size[0], height=size[1], count=[24, 24])
    mesh.vertices -= mesh.bounds.mean(axis=0)
    return from_trimesh(mesh)


def triangles(vertices: Array, normals: Array, faces: npt.ArrayLike, uv: Array | None = None) -> TriangleMesh:
    """Return a mesh of float32 arrays."""
    return TriangleMesh(
        vertices=np.ascontiguousarray(vertices, dtype=np.float32),
        normals=np.ascontiguousarray(normals, dtype=np.float32),
        faces=np.ascontiguousarray(faces, dtype=np.uint32),
        uv=None if uv is None else np.ascontiguousarray(uv, dtype=np.float32),
    )


def joined(pieces: Sequence[tuple[npt.NDArray[Any], ...]]) -> TriangleMesh:
    """Return one mesh of several pieces: vertices, normals, faces and texture coordinates."""
    offsets = np.cumsum([0, *[len(piece[0]) for piece in pieces]])
    vertices, normals, uv = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 1, 3))
    faces = np.concatenate([piece[2] + offset for piece, offset in zip(pieces, offsets, strict=False)])
    return triangles(vertices, normals, faces, uv)


def from_trimesh(mesh: trimesh.Trimesh) -> TriangleMesh:
    """Return a mesh with normals that are smooth where faces meet at less than 40 degrees."""
    import trimesh

    smooth = trimesh.graph.smooth_shade(mesh, angle=np.radians(40.0))
    return triangles(smooth.vertices, smooth.vertex_normals, smooth.faces)
