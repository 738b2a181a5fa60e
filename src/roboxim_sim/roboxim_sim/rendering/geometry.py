"""Packing of a `RenderWorld` into one vertex and one index array; a tick then uploads poses and draws in few calls."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Pose
from roboxim_core.specs import RGB, CameraSpec
from roboxim_core.vision.renderer import RenderBody, RenderWorld, TriangleMesh, VisualPart
from roboxim_core.vision.srgb import to_linear
from roboxim_sim.rendering.lod import coarse_meshes
from roboxim_sim.rendering.textures import TILE_M

Array = npt.NDArray[np.float64]

SURROUNDINGS = ("floor", "wall")
"""Entities that receive shadows and cast none."""

OBJECTS_LAYER, TABLE_LAYER, SURROUNDINGS_LAYER = range(3)

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
"""A vertex. color: square roots of the linear base colour, metallic; surface: roughness, texture, openness; ids:
body, entity."""
VERTEX_FORMAT = "3f 3f 2f 4f1 4f1 2u2"
VERTEX_NAMES = ("in_position", "in_normal", "in_uv", "in_color", "in_surface", "in_ids")
COARSE_FACES = 500
"""Faces of the coarse shape of robot links and of bodies with many faces, for shadows and for small images of them."""
MANY_FACES = 3000
"""Number of faces above which other bodies get a coarse shape."""
KEPT_SHAPES = 256
"""Number of bodies whose packed shapes are kept for later worlds."""

Openness = Callable[[Sequence[TriangleMesh], Sequence[TriangleMesh]], Sequence[npt.NDArray[np.uint8]]]
"""Computes the openness (0..255) of vertices, given a body's meshes and the meshes that hold these vertices."""


@dataclass(frozen=True, kw_only=True)
class PackedBody:
    """A body's index ranges and bounds. A body of the surroundings has one `PackedBody` for each of its parts."""

    key: str = ""
    """Key of its pose."""
    entity: str = ""
    """Entity that the body belongs to."""
    plain: range
    """Indices of the untextured faces."""
    plain_coarse: range
    """The same with fewer faces."""
    textured: range
    """Indices of the textured faces."""
    textured_coarse: range
    """The same with fewer faces."""
    shadow: range
    """Indices of the shadow-casting shape: the whole body, with few faces."""
    center: Array
    """Centre of the bounding box in the body's frame, shape (3,) [m]."""
    half: Array
    """Half the extent of the bounding box, shape (3,) [m]."""
    radius: float
    """Radius of the bounding sphere about the centre [m]."""


@dataclass(frozen=True, kw_only=True)
class PackedWorld:
    """A world as arrays."""

    vertices: npt.NDArray[np.void]
    """Of dtype `VERTEX`."""
    indices: npt.NDArray[np.uint32]
    """Triangles of all bodies."""
    bodies: tuple[PackedBody, ...]
    """The bodies with something to draw; vertices refer to them by index."""
    keys: tuple[str, ...]
    """Keys of all bodies."""

    @cached_property
    def centers(self) -> Array:
        """Centres of the bodies' bounding spheres in their frames, shape (N, 3) [m]."""
        return np.array([body.center for body in self.bodies], dtype=float).reshape(-1, 3)

    @cached_property
    def radii(self) -> Array:
        """Radii of the bodies' bounding spheres, shape (N,) [m]."""
        return np.array([body.radius for body in self.bodies], dtype=float)

    @cached_property
    def corners(self) -> Array:
        """Corners of the bodies' bounding boxes in their frames, shape (N, 8, 3) [m]."""
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
        return np.array([body.center + signs * body.half for body in self.bodies]).reshape(-1, 8, 3)

    @cached_property
    def layers(self) -> npt.NDArray[np.int64]:
        """Drawing order of the bodies, shape (N,): objects first, then the table, then the surroundings."""
        layers = dict.fromkeys(SURROUNDINGS, SURROUNDINGS_LAYER)
        numbers = np.array([layers.get(body.entity, OBJECTS_LAYER) for body in self.bodies], dtype=np.int64)
        if self.slab is not None:
            numbers[self.slab] = TABLE_LAYER
        return numbers

    @cached_property
    def faces(self) -> npt.NDArray[np.int64]:
        """Number of faces of each body, shape (N,)."""
        return np.array([(len(body.plain) + len(body.textured)) // 3 for body in self.bodies], dtype=np.int64)

    @cached_property
    def slab(self) -> int | None:
        """The table's top, which is the widest body of the table; none: there is no table."""
        return max(self.tables, key=lambda i: float(np.prod(self.bodies[i].half[:2])), default=None)

    @cached_property
    def tables(self) -> list[int]:
        """The bodies of the table: its top with its legs, and the robot's pedestal."""
        return [i for i, body in enumerate(self.bodies) if body.entity == "table"]


def texture_names(world: RenderWorld) -> list[str]:
    """Return the names of the textures that a world uses."""
    return list(dict.fromkeys(["", *(part.material.texture for body in world.bodies for part in body.parts)]))


def check_world(world: RenderWorld) -> None:
    """Check that a world can be packed.

    Raises:
        InvalidRequestError: On a malformed mesh, a duplicate key, or too many bodies, entities or textures.
    """
    names, keys = texture_names(world), [body.key for body in world.bodies]
    if twice := sorted({key for key in keys if keys.count(key) > 1}):
        raise InvalidRequestError(f"body keys must be unique, got {twice} more than once")
    if len(names) > 255 or len(keys) > 65535:
        raise InvalidRequestError(f"at most 254 textures and 65535 bodies, got {len(names) - 1} and {len(keys)}")
    for body in world.bodies:
        for part in body.parts:
            check_mesh(part.mesh, body.key)


class Packer:
    """Packs worlds. Keeps the shapes of bodies, since the next world has most of them, too."""

    def __init__(self, openness: Openness) -> None:
        """Start without shapes.

        Args:
            openness: Computes the openness of the vertices of a body's meshes (see `occlusion`).
        """
        self._openness = openness
        self._kept: OrderedDict[tuple[Any, ...], _Shape] = OrderedDict()

    def pack(self, world: RenderWorld, textures: Sequence[str]) -> PackedWorld:
        """Pack a world that has passed `check_world`.

        Args:
            world: The world.
            textures: Texture names by number, including all that the world uses; number 0 means no texture.
        """
        entities = {name: index + 1 for index, name in enumerate(world.entity_names)}
        vertices, indices = [np.zeros(0, VERTEX)], [np.zeros(0, np.uint32)]
        bodies = list[PackedBody]()
        first_vertex = first_index = 0
        for body in world.bodies:
            alone = body.entity in SURROUNDINGS
            for parts in [(part,) for part in body.parts] if alone else [body.parts] if body.parts else []:
                shape = self._shape(body.entity, parts, textures)
                own = shape.vertices.copy()
                own["ids"] = len(bodies), entities[body.entity]
                vertices.append(own)
                indices.append(shape.indices + np.uint32(first_vertex))
                bodies.append(shape.placed(body, first_index))
                first_vertex += len(own)
                first_index += len(shape.indices)
        return PackedWorld(
            vertices=np.concatenate(vertices),
            indices=np.concatenate(indices),
            bodies=tuple(bodies),
            keys=tuple(body.key for body in world.bodies),
        )

    def _shape(self, entity: str, parts: Sequence[VisualPart], textures: Sequence[str]) -> _Shape:
        kind = entity if entity in (*SURROUNDINGS, "table", "robot") else ""
        layers = tuple(textures.index(part.material.texture) for part in parts)
        key = (kind, layers, *map(id, parts))  # kept shapes keep their parts, so that ids stay unique
        shape = self._kept.get(key)
        if shape is None:
            shape = self._kept[key] = _shape_of(kind, parts, layers, self._openness)
            while len(self._kept) > KEPT_SHAPES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return shape


@dataclass(frozen=True, kw_only=True)
class _Shape:
    """A body's arrays, independent of its place in a world."""

    parts: tuple[VisualPart, ...]
    vertices: npt.NDArray[np.void]
    indices: npt.NDArray[np.uint32]
    body: PackedBody
    """The body without key and entity, as if its indices were the first ones."""

    def placed(self, body: RenderBody, first_index: int) -> PackedBody:
        """Return the body whose indices begin at a place."""
        moved: dict[str, Any] = {
            name: range(value.start + first_index, value.stop + first_index)
            for name, value in vars(self.body).items()
            if isinstance(value, range)
        }
        return replace(self.body, key=body.key, entity=body.entity, **moved)


def _shape_of(kind: str, parts: Sequence[VisualPart], layers: Sequence[int], openness: Openness) -> _Shape:
    """Return a body's shape: its untextured parts, the textured ones, then all coarse ones (untextured first)."""
    order = sorted(range(len(parts)), key=lambda i: bool(parts[i].material.texture))
    fine = [parts[i].mesh for i in order]
    room = kind in SURROUNDINGS
    faces = sum(len(mesh.faces) for mesh in fine)
    simplified = faces > MANY_FACES or (kind == "robot" and faces > 1.5 * COARSE_FACES)
    coarse = coarse_meshes(fine, max(COARSE_FACES, faces // 6)) if simplified and not room else ()
    if room or kind == "table":
        shades: Sequence[npt.NDArray[np.uint8]] = [np.full(len(mesh.vertices), 255, np.uint8) for mesh in fine]
    else:
        shades = openness(fine, [*fine, *coarse])
    arrays, ranges = _Arrays(), list[range]()
    for meshes in (fine, coarse or fine):
        first = middle = arrays.count
        for i, mesh, shade in zip(order, meshes, shades[len(ranges) // 2 * len(fine) :], strict=False):
            arrays.add(*_shaped(parts[i], mesh, layers[i], shade))
            middle = middle if parts[i].material.texture else arrays.count
        ranges += [range(first, middle), range(middle, arrays.count)]
        if not coarse:
            ranges *= 2
            break
    points = np.concatenate([mesh.vertices for mesh in fine]).astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    center = (low + high) / 2
    plain, textured, plain_coarse, textured_coarse = ranges
    return _Shape(
        parts=tuple(parts),
        vertices=np.concatenate(arrays.vertices),
        indices=np.concatenate(arrays.indices),
        body=PackedBody(
            plain=plain,
            plain_coarse=plain_coarse,
            textured=textured,
            textured_coarse=textured_coarse,
            shadow=range(0) if room else range(plain_coarse.start, textured_coarse.stop),
            center=center,
            half=(high - low) / 2,
            radius=float(np.linalg.norm(points - center, axis=1).max()),
        ),
    )


class _Arrays:
    """Vertex and index arrays under construction, mesh by mesh."""

    def __init__(self) -> None:
        self.vertices = [np.zeros(0, VERTEX)]
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
    """Check a mesh's array shapes and indices.

    Raises:
        InvalidRequestError: When shapes or indices are inconsistent, or a vertex is not finite.
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
    """Return the mesh with texture coordinates: its own, or by projecting each face along its main axis (`TILE_M`)."""
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
    return to_linear(np.clip(color, 0.0, 1.0))


def _shaped(
    part: VisualPart, mesh: TriangleMesh, layer: int, shade: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.uint32]]:
    if layer and mesh.uv is None:
        shade = shade[mesh.faces].reshape(-1)
        mesh = textured(mesh)
    packed = np.zeros(len(mesh.vertices), VERTEX)
    packed["position"] = mesh.vertices
    packed["normal"] = mesh.normals
    packed["uv"] = 0.0 if mesh.uv is None else mesh.uv
    color = [*np.sqrt(linear(part.material.color)), part.material.metallic]
    packed["color"] = np.rint(255 * np.clip(color, 0.0, 1.0))
    packed["surface"][:, :2] = round(255 * min(max(part.material.roughness, 0.08), 1.0)), layer
    packed["surface"][:, 2] = shade
    return packed, np.asarray(mesh.faces, dtype=np.uint32)


def check_request(keys: Iterable[str], poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]]) -> None:
    """Check the arguments of a renderer's `render` against its world's body keys.

    Raises:
        InvalidRequestError: On a pose of an unknown body, or two cameras with the same name.
    """
    if unknown := sorted(set(poses) - (known := set(keys))):
        raise InvalidRequestError(f"poses of unknown bodies {unknown}; the world has {sorted(known)}")
    if len({camera.name for camera, _ in cameras}) != len(cameras):
        raise InvalidRequestError(f"camera names must be unique, got {[camera.name for camera, _ in cameras]}")
