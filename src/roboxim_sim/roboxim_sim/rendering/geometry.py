"""Packs a `RenderWorld` into one vertex and one index array: a tick then uploads poses only and draws in few calls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import fast_simplification
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
COARSE_VERTEX = np.dtype([("position", np.float32, 3), ("ids", np.uint16, 2)])
"""A vertex of what casts shadows."""
COARSE_FORMAT = "3f 2u2"
COARSE_NAMES = ("in_position", "in_ids")
COARSE_FACES = 250
"""Faces that a finer mesh is simplified to for its shadow."""
VERTEX_NAMES = ("in_position", "in_normal", "in_uv", "in_color", "in_surface", "in_ids")


@dataclass(frozen=True, kw_only=True)
class PackedBody:
    """Where a body lies in the arrays, and its bounds."""

    key: str
    """Key of its pose."""
    entity: str
    """Entity that it belongs to."""
    shape: range
    """Its indices."""
    shadow: range
    """Its indices in the coarse arrays."""
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
    coarse_vertices: npt.NDArray[np.void]
    """Of dtype `COARSE_VERTEX`: simplified meshes that cast shadows."""
    coarse_indices: npt.NDArray[np.uint32]
    """Their triangles."""
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
    fine, coarse, bodies = _Arrays(VERTEX), _Arrays(COARSE_VERTEX), []
    for row, body in enumerate(body for body in world.bodies if body.parts):
        ids = (row, entities[body.entity])
        first, coarse_first = fine.count, coarse.count
        for part in body.parts:
            check_mesh(part.mesh, body.key)
            fine.add(*_shaped(part, textures.index(part.material.texture), ids))
            if body.entity not in SURROUNDINGS:
                coarse.add(*_coarse(part.mesh, ids))
        points = np.concatenate([part.mesh.vertices for part in body.parts]).astype(float)
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        bodies.append(
            PackedBody(
                key=body.key,
                entity=body.entity,
                shape=range(first, fine.count),
                shadow=range(coarse_first, coarse.count),
                center=center,
                radius=float(np.linalg.norm(points - center, axis=1).max()),
            )
        )
    return PackedWorld(
        vertices=np.concatenate(fine.vertices),
        indices=np.concatenate(fine.indices),
        coarse_vertices=np.concatenate(coarse.vertices),
        coarse_indices=np.concatenate(coarse.indices),
        bodies=tuple(bodies),
        textures=textures,
        keys=tuple(keys),
    )


class _Arrays:
    """Vertices and indices that grow mesh by mesh."""

    def __init__(self, dtype: np.dtype[np.void]) -> None:
        self.vertices = [np.zeros(0, dtype)]
        self.indices = [np.zeros(0, np.uint32)]
        self.count = 0
        """Number of indices."""
        self._vertex_count = 0

    def add(self, vertices: npt.NDArray[np.void], faces: npt.NDArray[np.uint32]) -> None:
        self.vertices.append(vertices)
        self.indices.append(faces.reshape(-1) + np.uint32(self._vertex_count))
        self.count += faces.size
        self._vertex_count += len(vertices)


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
    return np.asarray(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4))


def _shaped(part: VisualPart, layer: int, ids: tuple[int, int]) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint32]]:
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


_SIMPLIFIED: WeakKeyDictionary[TriangleMesh, tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]]
_SIMPLIFIED = WeakKeyDictionary()
"""Meshes come from caches and outlive a scene, so simplifying one happens once a process."""


def _coarse(mesh: TriangleMesh, ids: tuple[int, int]) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint32]]:
    if mesh not in _SIMPLIFIED:
        _SIMPLIFIED[mesh] = _simplified(mesh)
    points, faces = _SIMPLIFIED[mesh]
    packed = np.zeros(len(points), COARSE_VERTEX)
    packed["position"] = points
    packed["ids"] = ids
    return packed, faces


def _simplified(mesh: TriangleMesh) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    if len(mesh.faces) <= COARSE_FACES:
        return mesh.vertices.astype(np.float32), np.asarray(mesh.faces, dtype=np.uint32)
    # Welded first: vertices that are split for their normals would come apart.
    points, index = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    reduction = 1.0 - COARSE_FACES / len(mesh.faces)
    points, faces = fast_simplification.simplify(points.astype(np.float32), faces[whole].astype(np.int32), reduction)
    return np.asarray(points, dtype=np.float32), np.asarray(faces, dtype=np.uint32)


def check_request(keys: Iterable[str], poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]]) -> None:
    """Check the arguments of a renderer's `render` against its world's body keys.

    Raises:
        InvalidRequestError: On a pose of an unknown body, or two cameras of one name.
    """
    if unknown := sorted(set(poses) - (known := set(keys))):
        raise InvalidRequestError(f"poses of unknown bodies {unknown}; the world has {sorted(known)}")
    if len({camera.name for camera, _ in cameras}) != len(cameras):
        raise InvalidRequestError(f"camera names must be unique, got {[camera.name for camera, _ in cameras]}")
