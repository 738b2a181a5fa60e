"""Convex hulls of mesh files, for collision.

A hull of any mesh format (GLB, COLLADA, a scene of many parts) is written once, as an OBJ file in the user's cache. The
simulator and the planner therefore read the same shape; in PyBullet its surface is 1 mm further out on every side.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.mesh_files import Stamp, mesh_references, mesh_stamp, read_scene, refuse_moved_images
from roboxim_core.models.surfaces import paint, refuse_transparency
from roboxim_core.poses import Array
from roboxim_core.user_folders import cache_dir
from roboxim_core.whole_files import write_whole

if TYPE_CHECKING:
    import trimesh


LARGEST = 1e6
"""Largest coordinate of a mesh, in the file's units."""
UNIT_FORMATS = (".dae", ".zae", ".3mf", ".3dxml", ".xaml")
"""Formats that state a unit. Their hulls have other names in the cache than those of versions that did not heed it."""


def load_scene(path: Path | str, *, merge: bool = False) -> trimesh.Scene:
    """Return a mesh file as the scene of its parts.

    Lengths are the file's numbers; where a file of another unit than the metre states it, as COLLADA and 3MF do, they
    are metres.

    Args:
        path: The file.
        merge: Whether equal vertices become one, of formats other than glTF.

    Raises:
        ConfigError: When it cannot be read, a part has wrong vertices or faces, or a surface would be drawn wrongly: it
            is transparent, or its image is moved or repeated.
    """
    import trimesh

    refuse_moved_images(Path(path))
    try:
        scene = read_scene(path, merge=merge)
        unit = next((str(part.units) for part in scene.geometry.values() if part.units), "m")
        if (metres := trimesh.units.unit_conversion(unit, "m")) != 1.0:
            scene.apply_transform(np.diag([metres, metres, metres, 1.0]))
    except Exception as error:  # trimesh's readers raise exceptions of any class
        raise ConfigError(f"cannot read the mesh {path}: {type(error).__name__}: {error}") from None
    for part in scene.geometry.values():
        if isinstance(part, trimesh.Trimesh):
            _check(part, path)
            refuse_transparency(part, path)
            paint(part)
    return scene


def _check(mesh: trimesh.Trimesh, path: Path | str) -> None:
    """Refuse a mesh whose vertices or faces are wrong, which trimesh reads."""
    if mesh.vertices.shape[1] != 3:
        raise ConfigError(f"the mesh {path} has vertices of {mesh.vertices.shape[1]} numbers, expected 3")
    if not (np.abs(mesh.vertices) <= LARGEST).all():
        raise ConfigError(f"the mesh {path} has a vertex that is not a number of at most {LARGEST:g}")
    if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        raise ConfigError(f"the mesh {path} has a face of vertex {mesh.faces.max()}, of {len(mesh.vertices)} vertices")


def load_mesh(path: Path | str) -> trimesh.Trimesh:
    """Return a mesh file as a single mesh, in the file's units.

    Raises:
        ConfigError: When it is missing, cannot be read or is empty.
    """
    import trimesh

    scene = load_scene(path)
    try:
        mesh = scene.to_mesh()
    except Exception as error:  # e.g. of transforms that cannot be applied
        raise ConfigError(f"cannot read the mesh {path}: {type(error).__name__}: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ConfigError(f"the mesh {path} has no faces")
    _check(mesh, path)
    return mesh


def hull_file(path: str) -> str:
    """Return the OBJ file of a mesh's convex hull; write it if it does not exist.

    Raises:
        ConfigError: When the mesh cannot be read or spans no volume, or the cache cannot be written.
    """
    return _hull_file(path, mesh_stamp(path))


@lru_cache(maxsize=128)
def _hull_file(path: str, _stamp: Stamp) -> str:
    buffers = mesh_references(Path(path)).values() if path.lower().endswith(".gltf") else ()
    try:
        content = b"".join(file.read_bytes() for file in (Path(path), *buffers) if file.is_file() or file == Path(path))
    except OSError as error:
        raise ConfigError(f"cannot read the mesh {path}: {error.strerror}") from None
    how = b"metres" if Path(path).suffix.lower() in UNIT_FORMATS else b""
    name = hashlib.blake2b(content, digest_size=12, person=how).hexdigest()
    file = cache_dir() / "hulls" / f"{name}.obj"
    if not file.is_file():
        hull = hull_of(path)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in hull.vertices]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in hull.faces]
        try:
            write_whole(file, "\n".join(lines) + "\n")
        except OSError as error:
            raise ConfigError(
                f"cannot write {file}: {error.strerror}; set XDG_CACHE_HOME to a writable folder"
            ) from None
    return str(file)


def hull_of(path: Path | str) -> trimesh.Trimesh:
    """Return the convex hull of a mesh file.

    Raises:
        ConfigError: When it cannot be read or spans no volume.
    """
    try:
        hull: trimesh.Trimesh = load_mesh(path).convex_hull
        flat = bool(hull.volume < 1e-18)
    except ConfigError:
        raise
    except Exception:  # qhull's errors and trimesh's own have no common class
        flat = True
    if flat:
        raise ConfigError(f"the mesh {path} is flat: its convex hull has no volume; use a box for its collision")
    return hull


@lru_cache(maxsize=128)
def hull_vertices(path: str) -> Array:
    """Return the vertices of a mesh's convex hull, shape (N, 3), in the file's units.

    Raises:
        ConfigError: See `hull_file`.
    """
    import trimesh

    return np.asarray(trimesh.load_mesh(hull_file(path), process=False).vertices, dtype=float)
