"""Paths of images in YAML files, which are relative to their file, wherever a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from roboxim_core.user_folders import expanded

TEXTURE = "texture"
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp")


def is_picture(texture: str) -> bool:
    """Return whether a texture is a file, rather than the name of a built-in one."""
    return "/" in texture or Path(texture).suffix.lower() in IMAGES


def with_whole_paths(data: Any, folder: Path) -> Any:
    """Give the textures of YAML data that are files their whole paths; the data itself changes.

    Args:
        data: As returned by `roboxim_core.config.parse_yaml`.
        folder: Folder of the YAML file.
    """
    for key, value in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        data[key] = _whole(value, folder) if key == TEXTURE else with_whole_paths(value, folder)
    return data


def _whole(value: Any, folder: Path) -> Any:
    """Return a texture, or the values that it may have, with whole paths."""
    if isinstance(value, str):
        return str((folder / expanded(value)).resolve()) if is_picture(value) else value
    for key, item in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        value[key] = _whole(item, folder)
    return value
