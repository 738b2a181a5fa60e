"""The copy of a robot's URDF that PyBullet loads: no visuals, absolute mesh paths, and fingers of few parts.

The cost of a physics step grows with the links of a body. A gripper whose fingers are mechanisms has many: links that
are fixed to another link of their finger become part of it. The finger tips do not, since a link shares its contact
points among its shapes, and a held cube then slips farther. Other grippers stay as they are.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboxim_core.models.description import GripperModel
from roboxim_core.models.mesh_files import file_stamp
from roboxim_core.models.urdf import joint_axis, origin_pose, urdf_root
from roboxim_core.poses import Array, Pose

Element = ElementTree.Element
_MOMENTS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""Temporary folders, kept until the process ends."""


@dataclass(frozen=True, kw_only=True)
class PhysicsUrdf:
    """A URDF for PyBullet."""

    file: Path
    """The file."""
    part_of: Mapping[str, str]
    """Link that became part of another one to that one."""


def physics_urdf(urdf: Path, gripper: GripperModel) -> PhysicsUrdf:
    """Write a copy of a URDF for PyBullet.

    PyBullet rejects GLB visuals, does not resolve packages, and moves a sliding joint by its position times the length
    of its axis.

    Args:
        urdf: The robot's URDF.
        gripper: Its gripper.

    Raises:
        ConfigError: When the URDF cannot be read, or an axis is not one.
    """
    return _physics_urdf(urdf, gripper, file_stamp(urdf))


@lru_cache(maxsize=8)
def _physics_urdf(urdf: Path, gripper: GripperModel, _stamp: tuple[int, int]) -> PhysicsUrdf:
    root = urdf_root(urdf)
    for link in root.findall("link"):
        for shape in link.findall("visual"):
            link.remove(shape)
    for joint in root.findall("joint"):
        if (axis := joint.find("axis")) is not None:
            axis.set("xyz", " ".join(map(repr, joint_axis(joint, f"{urdf}: joint '{joint.get('name')}'"))))
    part_of = _joined(root, frozenset(gripper.links[3:]), str(urdf)) if gripper.followers else {}
    text = ElementTree.tostring(root, encoding="unicode")
    folder = tempfile.TemporaryDirectory(prefix="roboxim-urdf-")
    _KEPT.append(folder)
    file = Path(folder.name) / urdf.name
    file.write_text(text.replace("package://", f"{urdf.parent.parent}/"))
    return PhysicsUrdf(file=file, part_of=part_of)


def _joined(root: Element, fingers: frozenset[str], file: str) -> dict[str, str]:
    """Join links of the fingers that a fixed joint connects; return child to parent."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = [(joint, _end(joint, "parent"), _end(joint, "child")) for joint in root.findall("joint")]
    fixed = [row for row in joints if row[0].get("type") == "fixed" and {row[1], row[2]} <= fingers]
    part_of: dict[str, str] = {}
    while fixed:  # from the tips inwards
        joint, parent, child = next(row for row in fixed if all(row[2] != other[1] for other in fixed))
        fixed = [row for row in fixed if row[0] is not joint]
        place = origin_pose(joint, file)
        for shape in links[child].findall("collision"):
            moved = copy.deepcopy(shape)
            _set_origin(moved, place @ origin_pose(moved, file))
            links[parent].append(moved)
        _add_inertial(links[parent], links[child], place, file)
        for below, above, _ in joints:
            if above == child and below is not joint:
                _set_origin(below, place @ origin_pose(below, file))
                _part(below, "parent").set("link", parent)
        root.remove(links[child])
        root.remove(joint)
        joints = [
            (below, parent if above == child else above, end) for below, above, end in joints if below is not joint
        ]
        fixed = [(below, parent if above == child else above, end) for below, above, end in fixed]
        part_of = {link: parent if whole == child else whole for link, whole in part_of.items()} | {child: parent}
    return part_of


def _add_inertial(parent: Element, child: Element, place: Pose, file: str) -> None:
    """Add the mass and inertia of a child, given its place in the parent."""
    inertial = parent.find("inertial")
    mine, other = _inertia(inertial, file), _inertia(child.find("inertial"), file)
    mass = mine[0] + other[0]
    if other[0] == 0.0 or inertial is None:
        return
    turn = place.rotation.as_matrix()
    theirs = other[0], place.apply(other[1]), turn @ other[2] @ turn.T
    centre = (mine[0] * mine[1] + theirs[0] * theirs[1]) / mass
    whole = np.zeros((3, 3))
    for part_mass, at, inertia in (mine, theirs):
        off = at - centre
        whole += inertia + part_mass * (off @ off * np.eye(3) - np.outer(off, off))
    _set_origin(inertial, Pose(position=tuple(centre.tolist())))
    _part(inertial, "mass").set("value", repr(mass))
    for name, (row, column) in _MOMENTS.items():
        _part(inertial, "inertia").set(name, repr(float(whole[row, column])))


def _inertia(inertial: Element | None, file: str) -> tuple[float, Array, Array]:
    """Return mass, centre and inertia about the centre, in the link's frame."""
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    place, given = origin_pose(inertial, file), _part(inertial, "inertia").attrib
    inertia, turn = np.zeros((3, 3)), place.rotation.as_matrix()
    for name, (row, column) in _MOMENTS.items():
        inertia[row, column] = inertia[column, row] = float(given.get(name, "0"))
    return float(_part(inertial, "mass").get("value", "0")), np.array(place.position), turn @ inertia @ turn.T


def _set_origin(element: Element, pose: Pose) -> None:
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    origin.set("xyz", " ".join(map(repr, map(float, pose.position))))
    origin.set("rpy", " ".join(map(repr, pose.rotation.as_euler("xyz").tolist())))


def _part(element: Element, tag: str) -> Element:
    found = element.find(tag)
    assert found is not None, f"<{element.tag}> without <{tag}>"
    return found


def _end(joint: Element, tag: str) -> str:
    return str(_part(joint, tag).get("link"))
