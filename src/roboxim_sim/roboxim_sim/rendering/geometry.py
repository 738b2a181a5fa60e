"""Packs a `RenderWorld` into one vertex and one index array: a tick then uploads poses only and draws in few calls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Pose
from roboxim_core.rendering import RenderWorld, TriangleMesh, VisualPart
from roboxim_core.specs import RGB, CameraSpec
from roboxim_sim.rendering.textures import TILE_M

SURROUNDINGS = ("floor", "wall")
"""Entities that receive shadows and cast none."""

VERTEX = np.dtype(
    [
        ("position", np.float32, 3),
        ("normal", np.float32, 3),
        ("uv", np.float32, 2),
        ("color", np.uint8, 4),
        ("surface", np.uint8, 4),
        ("ids", np.uint16, 2),
    ]
)
"""A vertex. color: square roots of the linear base colour, metallic; surface: roughness, texture layer; ids: body,
entity."""
VERTEX_FORMAT = "3f 3f 2f 4f1 4f1 2u2"
VERTEX_NAMES = ("in_position", "in_normal", "in_uv", "in_color", "in_surface", "in_ids")


@dataclass(frozen=True, kw_only=True)
class PackedBody:
    """Where a body lies in the arrays, and its bounds."""

    key: str
    """Key of its pose."""
    entity: str
    """Entity that it belongs to."""
    first: int
    """First index."""
    count: int
    """Number of indices."""
    center: npt.NDArray[np.float64]
    """Centre of the bounding sphere in the body's frame, shape (3,) [m]."""
    radius: float
    """Radius of the bounding sphere [m]."""


@dataclass(frozen=True, kw_only=True)
class PackedWorld:
    """A world as arrays."""

    vertices: npt.NDArray[np.void]
    """Of dtype `VERTEX`."""
    indices: npt.NDArray[np.uint32]
    """Triangles of all bodies, in order."""
    bodies: tuple[PackedBody, ...]
    """The bodies with something to draw."""
    textures: tuple[str, ...]
    """Names by layer; layer 0 is plain white."""
    keys: tuple[str, ...]
    """Keys of all bodies."""


def pack(world: RenderWorld) -> PackedWorld:
    """Pack a world.

    Raises:
        InvalidRequestError: On a malformed mesh, a duplicate key, or too many bodies, entities or textures.
    """
    textures = tuple(dict.fromkeys(["", *(part.material.texture for body in world.bodies for part in body.parts)]))
    keys = [body.key for body in world.bodies]
    if twice := sorted({key for key in keys if keys.count(key) > 1}):
        raise InvalidRequestError(f"body keys must be unique, got {twice} more than once")
    if len(textures) > 255 or len(keys) > 65535:
        raise InvalidRequestError(f"at most 254 textures and 65535 bodies, got {len(textures) - 1} and {len(keys)}")
    entities = {name: index + 1 for index, name in enumerate(world.entity_names)}
    vertices, indices, bodies = [np.zeros(0, VERTEX)], [np.zeros(0, np.uint32)], []
    vertex_count = index_count = 0
    for row, body in enumerate(body for body in world.bodies if body.parts):
        ids = (row, entities[body.entity])
        parts = [_pack_part(part, body.key, textures.index(part.material.texture), ids) for part in body.parts]
        first = index_count
        for part_vertices, faces in parts:
            vertices.append(part_vertices)
            indices.append(faces.reshape(-1) + np.uint32(vertex_count))
            vertex_count += len(part_vertices)
            index_count += faces.size
        points = np.concatenate([part_vertices["position"] for part_vertices, _ in parts]).astype(float)
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = float(np.linalg.norm(points - center, axis=1).max())
        bodies.append(
            PackedBody(
                key=body.key, entity=body.entity, first=first, count=index_count - first, center=center, radius=radius
            )
        )
    return PackedWorld(
        vertices=np.concatenate(vertices),
        indices=np.concatenate(indices),
        bodies=tuple(bodies),
        textures=textures,
        keys=tuple(keys),
    )


def check_mesh(mesh: TriangleMesh, key: str) -> None:
    """Check a mesh's shapes and indices.

    Raises:
        InvalidRequestError: When they do not fit together.
    """
    count = len(mesh.vertices)
    good = (
        mesh.vertices.shape == (count, 3)
        and mesh.normals.shape == (count, 3)
        and mesh.faces.ndim == 2
        and mesh.faces.shape[1] == 3
        and (mesh.uv is None or mesh.uv.shape == (count, 2))
    )
    if not good:
        shapes = [
            None if array is None else array.shape for array in (mesh.vertices, mesh.normals, mesh.faces, mesh.uv)
        ]
        raise InvalidRequestError(
            f"body '{key}': a mesh needs vertices (N, 3), normals (N, 3), faces (M, 3), uv (N, 2) or none; got {shapes}"
        )
    if not count or not len(mesh.faces) or int(mesh.faces.max()) >= count or not np.isfinite(mesh.vertices).all():
        raise InvalidRequestError(f"body '{key}': a mesh needs finite vertices, and faces that index them")


def textured(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with texture coordinates: its own, or each face projected along its main axis (`TILE_M`)."""
    if mesh.uv is not None:
        return mesh
    corners = mesh.vertices[mesh.faces]
    axis = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(axis=1)
    flat = corners.reshape(-1, 3)
    plane = np.array([[1, 2], [0, 2], [0, 1]])[axis].repeat(3, axis=0)
    return TriangleMesh(
        vertices=flat,
        normals=mesh.normals[mesh.faces].reshape(-1, 3),
        faces=np.arange(len(flat), dtype=np.uint32).reshape(-1, 3),
        uv=(np.take_along_axis(flat, plane, axis=1) / TILE_M).astype(np.float32),
    )


def linear(color: RGB) -> npt.NDArray[np.float64]:
    """Convert an sRGB colour to linear."""
    srgb = np.clip(np.asarray(color, dtype=float), 0.0, 1.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _pack_part(
    part: VisualPart, key: str, layer: int, ids: tuple[int, int]
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint32]]:
    check_mesh(part.mesh, key)
    mesh = textured(part.mesh) if layer else part.mesh
    packed = np.zeros(len(mesh.vertices), VERTEX)
    packed["position"] = mesh.vertices
    packed["normal"] = mesh.normals
    packed["uv"] = 0.0 if mesh.uv is None else mesh.uv
    color = [*np.sqrt(linear(part.material.color)), part.material.metallic]
    packed["color"] = np.rint(255 * np.clip(color, 0.0, 1.0))
    packed["surface"] = (round(255 * min(max(part.material.roughness, 0.08), 1.0)), layer, 0, 0)
    packed["ids"] = ids
    return packed, np.asarray(mesh.faces, dtype=np.uint32)


def check_request(keys: Iterable[str], poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]]) -> None:
    """Check the arguments of a renderer's `render` against its world's body keys.

    Raises:
        InvalidRequestError: On a pose of an unknown body, or two cameras of one name.
    """
    if unknown := sorted(set(poses) - (known := set(keys))):
        raise InvalidRequestError(f"poses of unknown bodies {unknown}; the world has {sorted(known)}")
    if len({camera.name for camera, _ in cameras}) != len(cameras):
        raise InvalidRequestError(f"camera names must be unique, got {[camera.name for camera, _ in cameras]}")
