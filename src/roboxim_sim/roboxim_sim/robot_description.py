"""The robot's URDF for `/robot_description`, with mesh names that viewers on any machine can resolve."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from roboxim_core.config import config_dir
from roboxim_core.models.mesh_files import file_stamp
from roboxim_core.models.urdf import mesh_path

PACKAGE = "roboxim_core"
"""ROS package whose share folder contains ``config/robots``."""


def robot_description(urdf: Path) -> str:
    """Return a URDF whose mesh names RViz and Foxglove can resolve.

    Meshes of RoboXim's own robots become ``package://roboxim_core/config/robots/...``: the installation puts them into
    that package's share folder, and the text (hence a bag) is the same on every machine. Meshes of robots in other
    folders (``ROBOXIM_CONFIG_PATH``) become ``file://`` URLs with their full path.

    Args:
        urdf: The robot's URDF.
    """
    return _description(urdf, file_stamp(urdf))


@lru_cache(maxsize=8)
def _description(urdf: Path, _stamp: tuple[int, int]) -> str:
    own = config_dir().resolve()

    def resolved(match: re.Match[str]) -> str:
        path = mesh_path(match.group(2), urdf).resolve()
        if path.is_relative_to(own):
            return f"{match.group(1)}package://{PACKAGE}/config/{path.relative_to(own).as_posix()}{match.group(3)}"
        return f"{match.group(1)}{path.as_uri()}{match.group(3)}"

    return re.sub(r"""(<mesh\b[^>]*?\bfilename=["'])([^"']+)(["'])""", resolved, urdf.read_text())
