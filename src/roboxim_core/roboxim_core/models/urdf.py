"""Read objects from URDF, as the values that an object's YAML file would hold."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import JointModel, LinkModel, Shape, Visual
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import MaterialSpec


def urdf_object(path: Path) -> tuple[tuple[LinkModel, ...], tuple[JointModel, ...]]:
    """Read the links, the base first, and joints of a URDF file.

    A link on a fixed joint becomes part of its parent. Collision meshes become their convex hulls. Inertias are not
    read: the simulator computes them from shapes and masses.

    Raises:
        ConfigError: When the file cannot be read or holds an element that objects do not support.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path} is not valid XML: {error}") from None
    materials = {m.get("name", ""): m for m in root.findall("material")}
    links = {link.get("name", ""): _link(link, path, materials) for link in root.findall("link")}
    if not links:
        raise ConfigError(f"{path} has no <link>")
    pending = [_Joint(element, path) for element in root.findall("joint")]
    for joint in pending:
        if joint.parent not in links or joint.child not in links:
            raise ConfigError(
                f"{path}: joint '{joint.name}' joins '{joint.parent}' and '{joint.child}', not both links"
            )
    moving = [joint for joint in pending if joint.kind != "fixed"]
    fixed = [joint for joint in pending if joint.kind == "fixed"]
    while fixed:  # from the leaves inwards, so that a chain ends up on one link
        leaves = [joint for joint in fixed if all(joint.child != other.parent for other in fixed)]
        if not leaves:
            raise ConfigError(f"{path}: its fixed joints form a loop")
        joint = leaves[0]
        fixed.remove(joint)
        links[joint.parent] = _merged(links[joint.parent], links.pop(joint.child), joint.pose)
        for other in moving:
            if other.parent == joint.child:
                other.parent, other.pose = joint.parent, joint.pose @ other.pose
    children = {joint.child for joint in moving}
    bases = [name for name in links if name not in children]
    if len(bases) != 1:
        raise ConfigError(f"{path} must have one base link, got {bases}")
    ordered = (links[bases[0]], *(links[joint.child] for joint in moving))
    return ordered, tuple(joint.model() for joint in moving)


class _Joint:
    """A joint while fixed ones are folded away."""

    def __init__(self, element: ElementTree.Element, path: Path) -> None:
        self.name, self.kind = element.get("name", ""), element.get("type", "")
        if self.kind not in ("fixed", "prismatic", "revolute", "continuous"):
            raise ConfigError(
                f"{path}: joint '{self.name}' is {self.kind or 'of no type'}; expected fixed, prismatic, revolute or "
                "continuous"
            )
        if element.find("mimic") is not None:
            raise ConfigError(f"{path}: joint '{self.name}' mimics another one, which objects do not support")
        self.parent, self.child = (_attribute(element, tag, "link") for tag in ("parent", "child"))
        self.pose = _origin(element)
        self.axis = _vector(_attribute(element, "axis", "xyz") or "1 0 0")
        self.lower = float(_attribute(element, "limit", "lower") or 0.0)
        self.upper = float(_attribute(element, "limit", "upper") or 0.0)
        if self.kind == "continuous":
            self.lower, self.upper = -2 * np.pi, 2 * np.pi
        elif self.kind != "fixed" and self.lower >= self.upper:
            raise ConfigError(f"{path}: joint '{self.name}' needs a <limit> with lower < upper")
        self.damping = float(_attribute(element, "dynamics", "damping") or 0.0)
        self.friction = float(_attribute(element, "dynamics", "friction") or 0.0)

    def model(self) -> JointModel:
        return JointModel(
            name=self.name,
            kind="prismatic" if self.kind == "prismatic" else "revolute",
            parent=self.parent,
            child=self.child,
            pose=self.pose,
            axis=self.axis,
            lower=self.lower,
            upper=self.upper,
            damping=self.damping,
            resistance=self.friction,
        )


def _merged(parent: LinkModel, child: LinkModel, pose: Pose) -> LinkModel:
    return replace(
        parent,
        mass=parent.mass + child.mass,
        collision=(*parent.collision, *(replace(s, pose=pose @ s.pose) for s in child.collision)),
        visual=(*parent.visual, *(replace(v, pose=pose @ v.pose) for v in child.visual)),
    )


def _link(element: ElementTree.Element, path: Path, materials: dict[str, ElementTree.Element]) -> LinkModel:
    return LinkModel(
        name=element.get("name", ""),
        mass=float(_attribute(element, "inertial/mass", "value") or 0.0),
        collision=tuple(_shape(collision, path) for collision in element.findall("collision")),
        visual=tuple(_visual(visual, path, materials) for visual in element.findall("visual")),
    )


def _shape(element: ElementTree.Element, path: Path) -> Shape:
    kind, size, mesh, scale = _geometry(element, path)
    if len({abs(factor) for factor in scale}) != 1 or min(scale) <= 0:
        raise ConfigError(f"{path}: a collision mesh needs one scale > 0 for x, y and z, got {scale}")
    return Shape(kind="hull" if mesh else kind, size=size, mesh=mesh, scale=scale[0], pose=_origin(element))


def _visual(element: ElementTree.Element, path: Path, materials: dict[str, ElementTree.Element]) -> Visual:
    kind, size, mesh, scale = _geometry(element, path)
    material = element.find("material")
    if material is not None and material.find("color") is None:
        material = materials.get(material.get("name", ""), material)
    surface = MaterialSpec()
    if material is not None and (color := material.find("color")) is not None:
        r, g, b = (float(v) for v in color.get("rgba", "0.7 0.7 0.7 1").split()[:3])
        surface = MaterialSpec(color=(r, g, b))
    return Visual(kind=kind, size=size, mesh=mesh, scale=scale, pose=_origin(element), material=surface)


def _geometry(element: ElementTree.Element, path: Path) -> tuple[str, tuple[float, ...], str, Vec3]:
    """Return kind, size, mesh file and scale of a visual or collision element."""
    geometry = element.find("geometry")
    inner = None if geometry is None else next(iter(geometry), None)
    if inner is None:
        raise ConfigError(f"{path}: a <{element.tag}> has no geometry")
    one: Vec3 = (1.0, 1.0, 1.0)
    try:
        if inner.tag == "box":
            return "box", _vector(inner.attrib["size"]), "", one
        if inner.tag == "sphere":
            return "sphere", (float(inner.attrib["radius"]),), "", one
        if inner.tag == "cylinder":
            return "cylinder", (float(inner.attrib["radius"]), float(inner.attrib["length"])), "", one
        if inner.tag == "mesh":
            file = inner.attrib["filename"]
            package = re.match(r"(?:package|file)://(.+)", file)
            found = (path.parent.parent / package.group(1)) if package else (path.parent / file)
            return "mesh", (), str(found.resolve()), _vector(inner.get("scale", "1 1 1"))
    except (KeyError, ValueError) as error:
        raise ConfigError(f"{path}: <{inner.tag}> lacks or misspells {error}") from None
    raise ConfigError(f"{path}: <{inner.tag}> is not a geometry of URDF; expected box, sphere, cylinder or mesh")


def _origin(element: ElementTree.Element) -> Pose:
    from scipy.spatial.transform import Rotation

    origin = element.find("origin")
    if origin is None:
        return IDENTITY
    rpy = _vector(origin.get("rpy", "0 0 0"))
    return Pose.from_arrays(_vector(origin.get("xyz", "0 0 0")), Rotation.from_euler("xyz", rpy))


def _vector(text: str) -> Vec3:
    x, y, z = (float(v) for v in text.split())
    return x, y, z


def _attribute(element: ElementTree.Element, tag: str, name: str) -> str:
    found = element.find(tag)
    return "" if found is None else found.get(name, "")
