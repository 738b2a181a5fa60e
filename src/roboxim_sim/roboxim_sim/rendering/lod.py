"""Mesh simplification (level of detail) for shadows and for bodies that are small in an image."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from roboxim_core.models.decimation import decimated
from roboxim_core.vision.renderer import TriangleMesh

CREASE_RAD = np.radians(45.0)
"""Faces that meet at a smaller angle are shaded as one smooth surface."""
SLIVER = 0.15
"""A triangle whose height over its longest side is smaller than this ratio is a sliver."""
NEIGHBOURS = 8
"""Number of fine vertices among which a coarse corner selects its texture coordinates."""
SEAM = 0.3
"""Texture coordinates of one triangle that are further apart than this lie on different sides of a seam."""

_Coarse = dict[int, tuple[tuple[TriangleMesh, ...], tuple[TriangleMesh, ...]]]
_COARSE: WeakKeyDictionary[TriangleMesh, _Coarse] = WeakKeyDictionary()
"""Cache by a body's first mesh and the number of faces: its other meshes and all its coarse meshes. Meshes are cached
and outlive a scene."""


def coarse_meshes(meshes: Sequence[TriangleMesh], faces: int) -> tuple[TriangleMesh, ...]:
    """Simplify the meshes of a body together, so that no gaps open between them.

    Args:
        meshes: The meshes; at least one.
        faces: Approximate total number of faces of the result.

    Returns:
        A coarse mesh for each mesh, with texture coordinates if the fine one has them. It may have no faces left.
    """
    if sum(len(mesh.faces) for mesh in meshes) <= faces:
        return tuple(meshes)
    first, *others = meshes
    sizes = _COARSE.setdefault(first, {})
    known = sizes.get(faces)
    if known is None or not same(known[0], others):
        sizes[faces] = known = tuple(others), _simplified(meshes, faces)
    return known[1]


def same(some: Sequence[TriangleMesh], others: Sequence[TriangleMesh]) -> bool:
    """Return whether both sequences hold the same mesh objects."""
    return len(some) == len(others) and all(a is b for a, b in zip(some, others, strict=True))


def _simplified(meshes: Sequence[TriangleMesh], target: int) -> tuple[TriangleMesh, ...]:
    # Weld vertices first: vertices that were split for their normals would separate.
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    points, index = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    index = index.reshape(-1)
    faces = np.concatenate([index[mesh.faces + start] for mesh, start in zip(meshes, starts[:-1], strict=True)])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    points, faces, kept = decimated(points, faces, target)
    owner = owner[kept]
    return tuple(_shaded(points, faces[owner == i], mesh) for i, mesh in enumerate(meshes))


def _shaded(points: npt.NDArray[np.floating], faces: npt.NDArray[np.integer], fine: TriangleMesh) -> TriangleMesh:
    """Assign each face corner the mean normal of the adjacent faces within `CREASE_RAD` of its own face.

    If the fine mesh has texture coordinates, each corner gets those of a nearby fine vertex.
    """
    from scipy.sparse import csr_matrix

    corners = points[faces].astype(np.float64)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-12)
    # Pairs of a corner and a face that meet at a point.
    face_of = np.repeat(np.arange(len(faces)), 3)
    around = csr_matrix((np.ones(faces.size), (np.arange(faces.size), faces.ravel())), (faces.size, len(points)))
    pairs = (around @ around.T).tocoo()
    own, other = face_of[pairs.row], face_of[pairs.col]
    # A sliver's own normal is meaningless: use the mean of all adjacent faces.
    longest = np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max(axis=1)
    sliver = np.linalg.norm(areas, axis=1) < SLIVER * longest
    near = (np.einsum("ij,ij->i", flat[own], flat[other]) > np.cos(CREASE_RAD)) | sliver[own]
    normals = np.zeros((faces.size, 3))
    np.add.at(normals, pairs.row[near], areas[other[near]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    columns = [corners.reshape(-1, 3), normals]
    if fine.uv is not None:
        columns.append(_coordinates(corners, fine).reshape(-1, 2))
    both, index = np.unique(np.round(np.concatenate(columns, axis=1), 5), axis=0, return_inverse=True)
    both = both.astype(np.float32)
    return TriangleMesh(
        vertices=np.ascontiguousarray(both[:, :3]),
        normals=np.ascontiguousarray(both[:, 3:6]),
        faces=index.reshape(-1, 3).astype(np.uint32),
        uv=None if fine.uv is None else np.ascontiguousarray(both[:, 6:]),
    )


def _coordinates(corners: npt.NDArray[np.float64], fine: TriangleMesh) -> npt.NDArray[np.float64]:
    """Return texture coordinates of triangle corners, shape (M, 3, 2), such that no triangle crosses a seam."""
    from scipy.spatial import cKDTree

    assert fine.uv is not None
    tree, count = cKDTree(fine.vertices), min(NEIGHBOURS, len(fine.vertices))
    uv = fine.uv.astype(np.float64)
    middle = uv[tree.query(corners.mean(axis=1))[1]]  # (M, 2)
    distances, near = tree.query(corners, k=count)  # (M, 3, count)
    distances, near = distances.reshape(*corners.shape[:2], count), near.reshape(*corners.shape[:2], count)
    apart = np.abs(uv[near] - middle[:, None, None]).max(axis=-1) > SEAM
    best = (distances + 10.0 * apart).argmin(axis=-1)
    return np.asarray(uv[np.take_along_axis(near, best[..., None], axis=-1)[..., 0]])
