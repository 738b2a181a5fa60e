"""The shapes of a scene as markers, so that a viewer shows robot and objects without any file.

A viewer draws the robot from `/robot_description` only where it finds the meshes that the URDF names. Markers carry
their triangles, so a bag looks like its episode on every machine. They are coarse, and come once an episode: each is
locked to its body's frame, which `/tf` moves.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from visualization_msgs.msg import Marker

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.poses import IDENTITY
from roboxim_core.rendering import VisualPart
from roboxim_core.specs import MaterialSpec, SceneSpec
from roboxim_ros.cdr_writer import CdrWriter
from roboxim_sim.rendering.lod import coarse_meshes
from roboxim_sim.rendering.textures import pixels

FACES = 500
"""Most triangles of a body, about; `raster` simplifies a robot's links to as many, and the meshes are shared."""
GRID_M = 2.0**-13
"""Corners lie on a grid of this size [m], so that bags compress them."""
LEFT_OUT = ("wall", "floor")
"""Entities that would hide the scene from a viewer."""
ROBOT = "robot"
"""Namespace of the robot's markers, so that a viewer can hide them where it has the meshes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """What a marker of a triangle list shows."""

    entity: str
    """Entity that it belongs to."""
    frame: str
    """Frame of its body in ``/tf``."""
    color: tuple[float, float, float, float]
    """Red, green, blue and opacity, 0..1."""
    corners: npt.NDArray[np.float64]
    """Three corners for each triangle in the body's frame, shape (n, 3) [m]."""


def scene_markers_cdr(scene: SceneSpec, library: ModelLibrary, stamp_ns: int) -> bytearray:
    """Return the shapes of a scene as a serialised ``MarkerArray``: the table, the robot's links and the objects.

    The namespace of a marker is its entity, its frame that of its body in ``/tf``. The first marker deletes those of an
    earlier scene.

    Args:
        scene: The scene.
        library: Where its models come from.
        stamp_ns: Time of the tick that it belongs to [ns].
    """
    shapes = [
        shape
        for body in render_world(scene, library).bodies
        if body.entity not in LEFT_OUT
        for shape in _shapes(body.key, body.entity, body.parts)
    ]
    writer = CdrWriter()
    writer.uint32(1 + len(shapes))
    _write_marker(writer, stamp_ns, 0, None)
    for number, shape in enumerate(shapes, start=1):
        _write_marker(writer, stamp_ns, number, shape)
    return writer.data


@lru_cache(maxsize=256)
def _shapes(key: str, entity: str, parts: tuple[VisualPart, ...]) -> tuple[Shape, ...]:
    """Return a body's shapes, made once: models share their parts between scenes."""
    frame = "world" if entity == "table" else key.removeprefix(f"{ROBOT}/")
    meshes = coarse_meshes([part.mesh for part in parts], FACES)
    return tuple(
        Shape(
            entity=entity,
            frame=frame,
            color=_color(part.material),
            corners=np.round(mesh.vertices[mesh.faces].reshape(-1, 3).astype("<f8") / GRID_M) * GRID_M,
        )
        for part, mesh in zip(parts, meshes, strict=True)
        if len(mesh.faces)
    )


def _write_marker(writer: CdrWriter, stamp_ns: int, number: int, shape: Shape | None) -> None:
    """Append a ``visualization_msgs/Marker``; without a shape it deletes all markers."""
    action, kind = (Marker.DELETEALL, Marker.ARROW) if shape is None else (Marker.ADD, Marker.TRIANGLE_LIST)
    writer.header(stamp_ns, shape.frame if shape else "world")
    writer.text(shape.entity if shape else "")
    for value in (number, kind, action):
        writer.uint32(value)
    writer.pose(IDENTITY)
    writer.double_array((1.0, 1.0, 1.0) if shape else (0.0, 0.0, 0.0))
    writer.data += struct.pack("<4f", *(shape.color if shape else (0.0,) * 4))
    writer.time(0)  # lifetime: for ever
    writer.data.append(shape is not None)  # frame_locked
    writer.elements(shape.corners if shape else np.zeros((0, 3)), 8, len(shape.corners) if shape else 0)
    writer.uint32(0)  # colors
    writer.text("")  # texture_resource
    writer.header(0, "")  # texture: header, format, data
    writer.text("")
    writer.uint32(0)
    writer.uint32(0)  # uv_coordinates
    for _ in ("text", "mesh_resource", "filename of mesh_file"):
        writer.text("")
    writer.uint32(0)  # data of mesh_file
    writer.data.append(0)  # mesh_use_embedded_materials


@lru_cache(maxsize=256)
def _color(material: MaterialSpec) -> tuple[float, float, float, float]:
    """Return a material's colour, with the mean of its texture, and opacity."""
    color = np.array(material.color, float)
    if material.texture:
        color *= np.asarray(pixels(material.texture), float)[..., :3].mean(axis=(0, 1)) / 255
    r, g, b = np.clip(color, 0.0, 1.0).tolist()
    return (r, g, b, 1.0)
