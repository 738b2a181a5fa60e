"""URDFs: descriptions read as one (URDF, xacro, MJCF), elements and folders that are written."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from roboxim_core.errors import ConfigError
from roboxim_core.models.urdf import urdf_root
from roboxim_runs.robots.mjcf import is_mjcf, urdf_of

Element = ElementTree.Element
BY_HAND = ("LICENSE", "LICENSE.arm", "README.md", "recipe.yaml", "derive.py")
"""Files of a robot or gripper that a new derivation keeps."""


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


def massless() -> Element:
    """Return the inertial element of a frame; PyBullet gives a link without one a mass of 1 kg."""
    made = ElementTree.Element("inertial")
    ElementTree.SubElement(made, "mass", {"value": "0"})
    ElementTree.SubElement(made, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))
    return made


def fixed_joint(name: str, parent: str, child: str, *, xyz: str, rpy: str = "0 0 0") -> Element:
    """Return a joint that fixes a link to another.

    Args:
        name: Its name.
        parent: The other link.
        child: The link.
        xyz: Position of the link in the other one [m].
        rpy: Roll, pitch and yaw of the link in the other one [rad].
    """
    made = ElementTree.Element("joint", {"name": name, "type": "fixed"})
    ElementTree.SubElement(made, "parent", {"link": parent})
    ElementTree.SubElement(made, "child", {"link": child})
    ElementTree.SubElement(made, "origin", {"xyz": xyz, "rpy": rpy})
    return made


def write(root: Element, file: Path) -> None:
    """Write a URDF."""
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


@contextlib.contextmanager
def replaced(out: Path, kind: str, name: str) -> Iterator[Path]:
    """Write a robot's or gripper's folder, with its YAML file beside it, in place of that of an earlier derivation.

    Yields the new folder, in a configuration folder of its own; it replaces the old one unless an exception is raised.

    Args:
        out: Folder that receives both.
        kind: Name of the new folder's parent: ``robots`` or ``grippers``.
        name: Name of the robot or gripper.
    """
    target, scratch = out / name, out / f".{name}.new"
    shutil.rmtree(scratch, ignore_errors=True)
    made = scratch / kind / name
    for meshes in ("visual", "collision"):
        (made / meshes).mkdir(parents=True)
    try:
        yield made
        for kept in BY_HAND:
            if (target / kept).is_file():
                shutil.copy(target / kept, made / kept)
        shutil.rmtree(target, ignore_errors=True)
        made.rename(target)
        (made.parent / f"{name}.yaml").replace(out / f"{name}.yaml")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
