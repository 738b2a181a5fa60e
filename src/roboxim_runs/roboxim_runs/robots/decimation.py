"""Visual meshes of robots: fewer triangles, grouped by colour, with shading that hides the decimation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from roboxim_core.models.decimation import decimated

Color = tuple[int, ...]
TRIANGLES = 1600
CREASE_RAD = np.radians(32.0)
SLIVER_M = 0.002
"""A triangle thinner than this is a sliver."""
WHITE = (233, 234, 236)  # the files contain 255, which no painted surface reflects
GLOSS = {255: 0.32, 230: 0.42, 64: 0.55}


def visual(
    parts: Iterable[tuple[Color, trimesh.Trimesh]], *, triangles: int = TRIANGLES, weld_m: float = 0.0
) -> trimesh.Scene:
    """Decimate coloured meshes and group them by colour.

    All meshes are decimated together, so that no gaps open between colours.

    Args:
        parts: Colour (sRGB, 0..255) and mesh of each part.
        triangles: Target number of triangles.
        weld_m: Size of the cells whose vertices become one, which removes engraved text and double faces that would
            not let a mesh collapse; 0: only equal vertices are welded [m].
    """
    vertices, faces, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], []
    for color, mesh in parts:
        faces.append(mesh.faces + sum(len(points) for points in vertices))
        vertices.append(mesh.vertices)
        colors += [(230, 235, 237) if color == (229, 234, 237) else color] * len(mesh.faces)
    every, corner = np.concatenate(vertices), np.concatenate(faces)
    if weld_m:
        _, index = np.unique(np.round(every / weld_m).astype(np.int64), axis=0, return_inverse=True)
        count = np.bincount(index.reshape(-1))
        points = np.stack([np.bincount(index.reshape(-1), every[:, k]) / count for k in range(3)], axis=1)
    else:
        points, index = np.unique(np.round(every, 5), axis=0, return_inverse=True)
    triangles_of = index.reshape(-1)[corner]
    if weld_m:
        _, first = np.unique(np.sort(triangles_of, axis=1), axis=0, return_index=True)
        triangles_of, colors = triangles_of[np.sort(first)], [colors[k] for k in np.sort(first)]
    coarse, left, kept = decimated(points, triangles_of, triangles, aggressiveness=4.0)
    corners, color_of = coarse[left], np.array(colors)[kept]
    result = trimesh.Scene()
    for color in sorted(set(map(tuple, color_of.tolist())), reverse=True):
        part = trimesh.Trimesh(*welded(corners[(color_of == color).all(axis=1)]), process=False)
        part = softened(trimesh.graph.smooth_shade(part, angle=CREASE_RAD))
        part.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*(WHITE if color == (255, 255, 255) else color), 255],
                metallicFactor=0.0,
                roughnessFactor=GLOSS.get(color[0], 0.5),
            )
        )
        result.add_geometry(part, geom_name="color_{:02x}{:02x}{:02x}".format(*color))
    return result


def softened(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with slivers shaded like the surface around them.

    Decimation leaves steps of about a millimetre; with their own normals they would appear as black cracks.
    """
    corners, normals = mesh.vertices[mesh.faces], np.asarray(mesh.vertex_normals)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    height = np.linalg.norm(areas, axis=1) / np.maximum(longest, 1e-9)
    slivers = height < SLIVER_M
    points, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    around = np.zeros_like(points)
    for k in range(3):
        np.add.at(around, place.reshape(-1)[mesh.faces[:, k]], areas)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-12)
    shading = normals[mesh.faces]
    shading[slivers] = around[place.reshape(-1)[mesh.faces[slivers]]]
    both = np.round(np.concatenate([corners, shading], axis=2).reshape(-1, 6), 6)
    both, index = np.unique(both, axis=0, return_inverse=True)
    return trimesh.Trimesh(both[:, :3], index.reshape(-1, 3), vertex_normals=both[:, 3:], process=False)


def welded(corners: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return vertices and faces of triangles, shape (M, 3, 3)."""
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)
