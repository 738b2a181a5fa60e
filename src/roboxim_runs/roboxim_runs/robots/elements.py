"""Elements of the URDFs that RoboXim writes."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

Element = ElementTree.Element


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
