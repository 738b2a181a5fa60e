"""Textures that are images: how they are named, and where they are.

A YAML file names an image relative to itself. Inside a folder of the search path (`config_dirs`) the image is then
known by its place in that folder, e.g. ``config://looks/photo.png``, so that scenes and the hashes of configurations do
not depend on where the folder lies. Other images are known by their whole paths.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from roboxim_core.config import from_plain, load_yaml
from roboxim_core.config_folders import PLACE, place_file, place_name
from roboxim_core.user_folders import expanded

T = TypeVar("T")
TEXTURE = "texture"
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp")


def is_picture(texture: str) -> bool:
    """Return whether a texture is a file, rather than the name of a built-in one."""
    return "/" in texture or Path(texture).suffix.lower() in IMAGES


def file_of(name: str) -> tuple[Path, str]:
    """Return the file of a texture that is an image, and the geometry in it; empty: the file is the image.

    Args:
        name: See `texture_name`; the image of a geometry is ``<mesh file>#<geometry>``.
    """
    cuts = [place for place, letter in enumerate(name) if letter == "#"]  # a folder's name may have one, too
    cut = next((place for place in cuts if place_file(name[:place]).is_file()), len(name))
    return place_file(name[:cut]), name[cut + 1 :]


def texture_name(texture: str, folder: Path) -> str:
    """Return the name of a texture that a YAML file gives, the same from every working directory.

    Args:
        texture: Name of a built-in texture, the path of an image, or a name that this function has returned.
        folder: Folder of the YAML file.
    """
    if texture.startswith(PLACE) or not is_picture(texture):
        return texture
    path, geometry = file_of(str((folder / expanded(texture)).resolve()))
    return place_name(path) + (f"#{geometry}" if geometry else "")


def load_with_textures(path: Path | str) -> Any:
    """Read a YAML file as `load_yaml` does, with the names of its textures (`texture_name`).

    Raises:
        ConfigError: See `load_yaml`.
    """
    return _named(load_yaml(path), Path(path).parent)


def load_scenery(path: Path | str, cls: type[T]) -> T:
    """Read a scene, or another YAML file that may have textures, into a dataclass.

    Raises:
        ConfigError: When the file is missing, is not YAML, or does not fit the class.
    """
    data = load_with_textures(path)
    return from_plain({} if data is None else data, cls, source=str(path))


def _named(data: Any, folder: Path, *, inside: bool = False) -> Any:
    """Give the textures of plain data their names; the data itself changes, ``inside``: of a value of a texture."""
    if isinstance(data, str):
        return texture_name(data, folder) if inside else data
    for key, value in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        data[key] = _named(value, folder, inside=inside or key == TEXTURE)
    return data
