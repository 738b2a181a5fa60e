"""A mesh of any origin as a solid: in metres, upright, its surface repaired, and cut into convex parts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.hulls import load_mesh, load_scene
from roboxim_core.models.surfaces import rewrite
from roboxim_core.poses import Array

NEARLY_CONVEX = 0.95
"""Smallest share of its convex hull's volume at which a solid counts as one convex part."""
MAX_PARTS = 16
"""Most convex parts of an object; PyBullet keeps that many shapes of a link."""


UPS = ("z", "y")
"""Axis of a mesh that points up; RoboXim's objects have z."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How finely a mesh is cut into convex parts; see CoACD's options (Wei et al., SIGGRAPH 2022)."""

    concavity: float
    """Largest concavity of a part, relative to the mesh's size."""
    parts: int
    """Most parts."""
    search: tuple[int, int, int]
    """Iterations, nodes and depth of CoACD's tree search for a cut."""
    resolution: int
    """Samples of the concavity's measurement."""


EFFORTS = {
    "fast": Effort(concavity=0.08, parts=8, search=(30, 10, 2), resolution=800),
    "thorough": Effort(concavity=0.04, parts=MAX_PARTS, search=(150, 20, 3), resolution=2000),
}
"""Name to effort; fast takes seconds a mesh."""


def placed(file: Path, scale: float, up: str) -> tuple[Any, trimesh.Trimesh]:
    """Return a mesh file's scene and the single mesh of it, in metres, z up, the middle of its box at the origin.

    The scene's colours are those of a GLB file.

    Args:
        file: Mesh file, of any format that trimesh reads.
        scale: Length of the file's unit [m].
        up: Axis of the file that points up: ``z`` or ``y``.

    Raises:
        ConfigError: When the mesh cannot be read, or the axis is another one.
    """
    if up not in UPS:
        raise ConfigError(f"unknown up-axis '{up}'; {one_of(UPS, up)}")
    load_mesh(file)  # checks it
    scene: Any = load_scene(file)
    rewrite(scene, file, Path("it.glb"))
    turn = np.eye(4)
    if up == "y":
        turn[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    scene.apply_transform(turn @ np.diag([scale, scale, scale, 1.0]))
    whole = scene.to_mesh()
    shift = np.eye(4)
    shift[:3, 3] = -whole.bounds.mean(axis=0)
    scene.apply_transform(shift)
    return scene, scene.to_mesh()


def repaired(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, str]:
    """Return a mesh with a closed surface whose faces point outwards, where that is possible.

    Returns:
        The mesh, and what was mended in words; empty: nothing was.
    """
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    whole.merge_vertices(merge_tex=True, merge_norm=True)
    if whole.is_volume:
        return whole, ""
    if len(whole.split(only_watertight=False)) == 1:
        trimesh.repair.fix_normals(whole)
        if whole.is_volume:
            return whole, "its faces pointed inwards: flipped"
        trimesh.repair.fill_holes(whole)
        if whole.is_volume:
            return whole, "its holes were closed"
    closed = _united(whole)
    if closed is not None:
        return closed, "its parts were joined into one closed surface"
    return whole, "its surface stays open: volume and mass come from its convex parts"


def _united(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return the union of a mesh's closed parts by Manifold; none if it has an open part."""
    from manifold3d import Error, Manifold, Mesh

    total = Manifold()
    for piece in mesh.split(only_watertight=False):
        trimesh.repair.fix_normals(piece)
        trimesh.repair.fill_holes(piece)
        given = Mesh(piece.vertices.astype(np.float32), piece.faces.astype(np.uint32))
        given.merge()
        solid = Manifold(given)
        if solid.status() != Error.NoError or solid.is_empty():
            return None
        total += solid if solid.volume() > 0 else Manifold()
    made = total.to_mesh()
    joined = trimesh.Trimesh(made.vert_properties[:, :3], made.tri_verts, process=True)
    return joined if len(joined.faces) and joined.is_volume else None


def convex_parts(mesh: trimesh.Trimesh, effort: Effort) -> list[trimesh.Trimesh]:
    """Cut a mesh into convex parts by CoACD; a mesh that is nearly convex stays one part.

    Raises:
        ConfigError: When the mesh has no volume.
    """
    try:
        hull = mesh.convex_hull
    except Exception:  # qhull's errors and trimesh's own have no common class
        hull = None
    if hull is None or hull.volume < 1e-12:
        raise ConfigError("the mesh is flat: no solid can be made of it; give the object a box in a YAML file instead")
    if mesh.is_volume and mesh.volume > NEARLY_CONVEX * hull.volume:
        return [hull]
    import coacd

    coacd.set_log_level("error")
    iterations, nodes, depth = effort.search
    cut = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=effort.concavity, max_convex_hull=effort.parts,
        resolution=effort.resolution, mcts_iterations=iterations, mcts_nodes=nodes, mcts_max_depth=depth,
        decimate=True, max_ch_vertex=64, seed=0,
    )  # fmt: skip
    parts = [trimesh.Trimesh(points, faces).convex_hull for points, faces in cut if len(points) >= 4]
    return [part for part in parts if part.volume > 1e-12] or [hull]


def volume_of(mesh: trimesh.Trimesh, parts: list[trimesh.Trimesh]) -> float:
    """Return the volume of a solid; of an open mesh, that of its convex parts [m^3]."""
    return float(mesh.volume) if mesh.is_volume else float(sum(part.volume for part in parts))


def surface_points(mesh: trimesh.Trimesh, count: int) -> tuple[Array, Array]:
    """Sample a surface evenly.

    Returns:
        Points, shape (N, 3) [m], and the outward normals there, shape (N, 3).
    """
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points), np.asarray(mesh.face_normals[faces])
