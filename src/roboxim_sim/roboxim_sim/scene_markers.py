"""The shapes of a scene as markers, so that a viewer shows robot and objects without any file.

A viewer draws the robot from `/robot_description` only where it finds the meshes that the URDF names. Markers carry
their triangles, so a bag looks like its episode on every machine. The triangles are coarse, and are sent once per
episode: each marker is locked to its body's frame, which `/tf` moves.

Serialising a shape is slow, since each of its corners is a Python object. So each shape is serialised once, and a
scene's message is put together from the kept bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from visualization_msgs.msg import Marker

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.poses import IDENTITY
from roboxim_core.specs import MaterialSpec, SceneSpec
from roboxim_core.vision.renderer import TriangleMesh, VisualPart
from roboxim_ros.messages.packing import ENCAPSULATION
from roboxim_ros.messages.serialising import (
    header_message,
    message,
    pose_message,
    serialise,
    time_message,
    vector_message,
)
from roboxim_sim.conversions import STAMP
from roboxim_sim.rendering.lod import coarse_meshes
from roboxim_sim.rendering.textures import pixels

FACES = 500
"""Approximate largest number of triangles of a body; the simplified robot links of `raster` have as many and are
shared."""
GRID_M = 2.0**-13
"""Corners lie on a grid of this size [m], so that bags compress them."""
LEFT_OUT = ("wall", "floor")
"""Entities that would hide the scene from a viewer."""
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
_COUNT, _ID = struct.Struct("<I"), struct.Struct("<i")
ROBOT = "robot"
"""Namespace of the robot's markers, so that a viewer can hide them where it has the meshes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """Content of a triangle-list marker."""

    entity: str
    """Entity that it belongs to."""
    frame: str
    """Frame of its body in ``/tf``."""
    color: tuple[float, float, float, float]
    """Red, green, blue and opacity, 0..1."""
    points: list[Any]
    """Three corners for each triangle in the body's frame [m]."""


@dataclass(frozen=True, kw_only=True)
class KeptMarker:
    """A serialised marker, as it is in a ``MarkerArray``.

    Padding depends on where a marker begins. In an array every marker begins 4 bytes after a multiple of 8: the first
    one follows the array's count. Points begin at a multiple of 8 and have 24 bytes each, and the part after them has
    the same length in all markers.
    """

    cdr: bytes
    """The marker with a stamp and an id of 0."""
    id_at: int
    """Position of its ``id``, after its stamp, its frame and its namespace [bytes]."""


def scene_markers_cdr(scene: SceneSpec, library: ModelLibrary, stamp_ns: int) -> memoryview:
    """Return the shapes of a scene as a serialised ``MarkerArray``: the table, the robot's links and the objects.

    The namespace of a marker is its entity, its frame that of its body in ``/tf``. The first marker deletes those of an
    earlier scene.

    Args:
        scene: The scene.
        library: Where its models come from.
        stamp_ns: Time of the tick that it belongs to [ns].
    """
    markers = [
        marker
        for body in render_world(scene, library).bodies
        if body.entity not in LEFT_OUT
        for marker in _markers(body.key, body.entity, body.parts)
    ]
    return _array_cdr(stamp_ns, [_deletion(), *markers])


def _array_cdr(stamp_ns: int, markers: Sequence[KeptMarker]) -> memoryview:
    """Return a serialised ``MarkerArray`` of markers, which get the stamp and their place in the array as id."""
    array = bytearray(ENCAPSULATION + _COUNT.pack(len(markers)))
    stamp = STAMP.pack(*divmod(stamp_ns, 1_000_000_000))
    for number, marker in enumerate(markers):
        _align(array)
        at = len(array)
        assert (at - len(ENCAPSULATION)) % 8 == 4, "the padding within a kept marker is that of such a place"
        array += marker.cdr
        array[at : at + STAMP.size] = stamp
        at += marker.id_at
        array[at : at + _ID.size] = _ID.pack(number)
    return memoryview(array)


def _kept(shape: Shape | None) -> KeptMarker:
    """Serialise a shape's marker; without a shape it deletes all markers."""
    array = serialise(MARKER_ARRAY, markers=[_marker(shape)])
    start = bytearray(STAMP.size)
    for text in (shape.frame, shape.entity) if shape else ("world", ""):
        start += bytes(4 + len(text.encode()) + 1)  # its length, its bytes, and a zero
        _align(start)
    return KeptMarker(cdr=bytes(array[len(ENCAPSULATION) + _COUNT.size :]), id_at=len(start))


@cache
def _deletion() -> KeptMarker:
    return _kept(None)


def _align(data: bytearray) -> None:
    """Pad to a multiple of 4 bytes."""
    data += bytes(-len(data) % 4)


@lru_cache(maxsize=256)
def _markers(key: str, entity: str, parts: tuple[VisualPart, ...]) -> tuple[KeptMarker, ...]:
    """Return a body's markers, made once: models share their parts between scenes."""
    frame = "world" if entity == "table" else key.removeprefix(f"{ROBOT}/")
    meshes = coarse_meshes([part.mesh for part in parts], FACES)
    return tuple(
        _kept(Shape(entity=entity, frame=frame, color=_color(part.material), points=_corners(mesh)))
        for part, mesh in zip(parts, meshes, strict=True)
        if len(mesh.faces)
    )


def _corners(mesh: TriangleMesh) -> list[Any]:
    """Return three points for each triangle of a mesh; triangles share the points of their common vertices."""
    vertices = np.round(mesh.vertices.astype(np.float64) / GRID_M) * GRID_M
    points = [vector_message(vertex) for vertex in vertices.tolist()]
    return [points[index] for index in mesh.faces.ravel().tolist()]


def _marker(shape: Shape | None) -> Any:
    """Return a ``visualization_msgs/Marker`` with a stamp and an id of 0; without a shape it deletes all markers."""
    r, g, b, opacity = shape.color if shape else (0.0,) * 4
    no_bytes = np.zeros(0, np.uint8)
    return message(
        "visualization_msgs/msg/Marker",
        header=header_message(0, shape.frame if shape else "world"),
        ns=shape.entity if shape else "",
        id=0,
        type=Marker.TRIANGLE_LIST if shape else Marker.ARROW,
        action=Marker.ADD if shape else Marker.DELETEALL,
        pose=pose_message(IDENTITY),
        scale=vector_message((1.0, 1.0, 1.0) if shape else (0.0, 0.0, 0.0)),
        color=message("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=opacity),
        lifetime=time_message(0),  # never expires
        frame_locked=shape is not None,
        points=shape.points if shape else [],
        colors=[],
        texture_resource="",
        texture=message("sensor_msgs/msg/CompressedImage", header=header_message(0, ""), format="", data=no_bytes),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=message("visualization_msgs/msg/MeshFile", filename="", data=no_bytes),
        mesh_use_embedded_materials=False,
    )


@lru_cache(maxsize=256)
def _color(material: MaterialSpec) -> tuple[float, float, float, float]:
    """Return a material's colour, with the mean of its texture, and opacity."""
    color = np.array(material.color, float)
    if material.texture:
        color *= np.asarray(pixels(material.texture), float)[..., :3].mean(axis=(0, 1)) / 255
    r, g, b = np.clip(color, 0.0, 1.0).tolist()
    return (r, g, b, 1.0)
