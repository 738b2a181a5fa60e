"""The shapes of a scene as markers, so that a viewer shows robot and objects without any file.

A viewer draws the robot from `/robot_description` only where it finds the meshes that the URDF names. Markers carry
their triangles, so a bag looks like its episode on every machine. They are coarse, and come once an episode: each is
locked to its body's frame, which `/tf` moves.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.rendering import VisualPart
from roboxim_core.specs import MaterialSpec, SceneSpec
from roboxim_ros.conversions import fill_stamp
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


def scene_markers(scene: SceneSpec, library: ModelLibrary, stamp_ns: int) -> MarkerArray:
    """Return the shapes of a scene: the table, the robot's links and the objects.

    The namespace of a marker is its entity, its frame that of its body in ``/tf``.

    Non-obvious: scenes share the markers; serialise the message before making the next one.

    Args:
        scene: The scene.
        library: Where its models come from.
        stamp_ns: Time of the tick that it belongs to [ns].
    """
    clear = Marker(action=Marker.DELETEALL)
    clear.header.frame_id = "world"
    markers = [clear]
    for body in render_world(scene, library).bodies:
        if body.entity not in LEFT_OUT:
            markers += _markers(body.key, body.entity, body.parts, len(markers))
    for marker in markers:
        fill_stamp(marker.header.stamp, stamp_ns)
    return MarkerArray(markers=markers)


@lru_cache(maxsize=256)
def _markers(key: str, entity: str, parts: tuple[VisualPart, ...], first: int) -> tuple[Marker, ...]:
    """Return a body's markers, made once: models share their parts between scenes, and points are slow to make."""
    frame = "world" if entity == "table" else key.removeprefix(f"{ROBOT}/")
    markers = []
    meshes = coarse_meshes([part.mesh for part in parts], FACES)
    for number, (part, mesh) in enumerate(zip(parts, meshes, strict=True), start=first):
        if len(mesh.faces):
            corners = np.round(mesh.vertices[mesh.faces].reshape(-1, 3).astype(float) / GRID_M) * GRID_M
            marker = Marker(
                ns=entity, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD, color=_color(part.material),
                scale=Vector3(x=1.0, y=1.0, z=1.0), points=[Point(x=x, y=y, z=z) for x, y, z in corners.tolist()],
                frame_locked=True,
            )  # fmt: skip
            marker.pose.orientation.w = 1.0
            marker.header.frame_id = frame
            markers.append(marker)
    return tuple(markers)


@lru_cache(maxsize=256)
def _color(material: MaterialSpec) -> ColorRGBA:
    """Return a material's colour, with the mean of its texture."""
    color = np.array(material.color, float)
    if material.texture:
        color *= np.asarray(pixels(material.texture), float)[..., :3].mean(axis=(0, 1)) / 255
    r, g, b = np.clip(color, 0.0, 1.0).tolist()
    return ColorRGBA(r=r, g=g, b=b, a=1.0)
