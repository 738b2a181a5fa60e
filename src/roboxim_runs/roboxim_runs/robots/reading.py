"""Somebody's description of a robot or gripper, read as URDF: URDF, xacro or MJCF."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from xml.etree import ElementTree

from roboxim_core.errors import ConfigError
from roboxim_core.models.urdf import urdf_root
from roboxim_runs.robots.mjcf import is_mjcf, urdf_of

Element = ElementTree.Element


def expanded(path: Path) -> Element:
    """Return the root element of a URDF file, or that of the URDF that a xacro or MJCF file stands for.

    Raises:
        ConfigError: When it cannot be read, or is a xacro and `xacrodoc` is not installed.
    """
    if b"<xacro:" not in re.sub(rb"<!--.*?-->", b"", path.read_bytes(), flags=re.S):  # xacro itself leaves comments
        root = urdf_root(path)
        return urdf_of(root, path) if is_mjcf(root) else root
    try:
        from xacrodoc import XacroDoc
    except ModuleNotFoundError:
        raise ConfigError(f"{path} is a xacro; install the package that expands it: pip install xacrodoc") from None
    try:
        with contextlib.chdir(path.parent):  # which its includes are relative to
            return ElementTree.fromstring(XacroDoc.from_file(path.name, resolve_packages=False).to_urdf_string())
    except Exception as error:  # whatever the macros raise
        raise ConfigError(f"{path} cannot be expanded: {error}") from None
