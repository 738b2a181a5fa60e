"""Visual meshes of robots from COLLADA files, shared by the robots' ``derive.py``."""

from __future__ import annotations

from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from collada import read_collada

TRIANGLES = 1600
CREASE_RAD = np.radians(32.0)
SLIVER_M = 0.002
"""A triangle thinner than this is a sliver."""
WHITE = (233, 234, 236)  # the files contain 255, which no painted surface reflects
GLOSS = {255: 0.32, 230: 0.42, 64: 0.55}


def visual(source: Path, *, triangles: int = TRIANGLES, linear: bool = False) -> trimesh.Scene:
    """Decimate a COLLADA file's meshes and group them by colour.

    All meshes are decimated together, so that no gaps open between colours.

    Args:
        source: The file.
        triangles: Target number of triangles.
        linear: Whether the file's colours are linear instead of sRGB.
    """
    vertices, faces, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], []
    for color, mesh in read_collada(source):
        if linear:
            color = tuple(round(255.0 * (c / 255.0) ** (1.0 / 2.2)) for c in color)
        faces.append(mesh.faces + sum(len(points) for points in vertices))
        vertices.append(mesh.vertices)
        colors += [(230, 235, 237) if color == (229, 234, 237) else color] * len(mesh.faces)
    points, index = np.unique(np.round(np.concatenate(vertices), 5), axis=0, return_inverse=True)
    corners, color_of = decimated(points, index.reshape(-1)[np.concatenate(faces)], np.array(colors), triangles)
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


def decimated(
    points: np.ndarray, faces: np.ndarray, colors: np.ndarray, triangles: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return coarser triangles, shape (M, 3, 3), and their colours, shape (M, 3)."""
    kept = whole(faces)
    faces, colors = faces[kept].astype(np.int32), colors[kept]
    points = points.astype(np.float32)
    if len(faces) > triangles:
        *_, collapses = fast_simplification.simplify(
            points, faces, target_count=triangles, agg=4.0, return_collapses=True
        )
        points, _, mapping = fast_simplification.replay_simplification(points, faces, collapses)
        faces = mapping[faces]
        kept = whole(faces)
        faces, colors = faces[kept], colors[kept]
    return points[faces], colors


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


def whole(faces: np.ndarray) -> np.ndarray:
    """Return which faces have three different corners."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def welded(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of triangles, shape (M, 3, 3)."""
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)
