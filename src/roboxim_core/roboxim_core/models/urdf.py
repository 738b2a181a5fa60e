"""Read objects from URDF, as the values that an object's YAML file would hold."""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from roboxim_core import limits
from roboxim_core.errors import ConfigError
from roboxim_core.models.description import JointModel, LinkModel, Shape, Visual, unit_axis
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import MaterialSpec

LARGEST = 1e6
"""Largest value of any number of an object's file."""
_XACRO = "{http://www.ros.org/wiki/xacro}"


def urdf_object(path: Path) -> tuple[tuple[LinkModel, ...], tuple[JointModel, ...]]:
    """Read the links, the base first, and joints of a URDF file.

    A link on a fixed joint becomes part of its parent. Collision meshes become their convex hulls. Inertias are not
    read: the simulator computes them from shapes and masses (see `roboxim_sim.bodies.ObjectBody`).

    Raises:
        ConfigError: When the file cannot be read or holds an element that objects do not support.
    """
    root = urdf_root(path)
    materials = urdf_materials(root)
    links = {link.get("name", ""): _link(link, path, materials) for link in root.findall("link")}
    if len(links) != len(root.findall("link")):
        raise ConfigError(f"{path} has several links of one name; names of links must differ")
    if not links:
        raise ConfigError(f"{path} has no <link>")
    pending = [_Joint(element, path) for element in root.findall("joint")]
    for joint in pending:
        if joint.parent not in links or joint.child not in links:
            raise ConfigError(
                f"{path}: joint '{joint.name}' joins '{joint.parent}' and '{joint.child}', not both links"
            )
    names = [joint.child for joint in pending]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}: link '{twice[0]}' is the child of several joints; a link has one parent")
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


def urdf_root(path: Path) -> ElementTree.Element:
    """Return the root element of a URDF file.

    Raises:
        ConfigError: When the file cannot be read, is not XML, or is a xacro that is not expanded.
    """
    try:
        root = _parsed(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:  # the last three: the encoding
        raise ConfigError(f"{path} is not valid XML: {str(error) or type(error).__name__}") from None
    for element in root.iter():
        texts = [str(element.tag), *element.attrib.values()]
        if found := next((text for text in texts if text.startswith(_XACRO) or "${" in text or "$(" in text), None):
            raise ConfigError(
                f"{path} is a xacro that is not expanded, it has {limits.echo(found.replace(_XACRO, 'xacro:'))}; "
                f"expand it: xacro {path.name} > {path.stem.removesuffix('.urdf')}.expanded.urdf"
            )
    return root


def _parsed(text: bytes) -> ElementTree.Element:
    """Parse XML in which names may have an undeclared prefix, such as ``drake:``, as ROS's own reader does."""
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if "unbound prefix" not in str(error):
            raise
    used = re.findall(rb"(?:<|\s)([A-Za-z]\w*):\w+(?=[^<>]*>)", text)
    prefixes = sorted(set(used) - set(re.findall(rb"xmlns:(\w+)", text)) - {b"xmlns", b"xml"})
    declared = b"".join(b' xmlns:%s="%s"' % (prefix, prefix) for prefix in prefixes)
    return ElementTree.fromstring(re.sub(rb"<robot\b", b"<robot" + declared, text, count=1))


def mesh_path(name: str, urdf: Path) -> Path:
    """Return the file that a ``filename`` of a URDF's mesh or texture names; the first candidate if none exists.

    ``package://PACKAGE/...`` is searched in ROS's folder layout: in a folder above the URDF that is named like the
    package or has its ``package.xml``, then beside such folders, then in ``ROS_PACKAGE_PATH`` and the ``share`` folders
    of ``AMENT_PREFIX_PATH``.
    """
    found = re.match(r"(package|file)://(.+)", name)
    if not found:
        return (urdf.parent / name).resolve()
    rest = Path(unquote(found[2]))
    if found[1] == "file":
        return (urdf.parent / rest).resolve()
    package, inner = rest.parts[0], Path(*rest.parts[1:])
    above = urdf.absolute().parents
    places = [urdf.absolute().parent.parent / package]
    places += [folder for folder in above if folder.name == package or _package_name(folder) == package]
    places += [folder / package for folder in above]
    places += [Path(place, package) for place in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if place]
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    places += [Path(place, "share", package) for place in prefixes if place]
    files = [(place / inner).resolve() for place in places]
    return next((file for file in files if file.is_file()), files[0])


def _package_name(folder: Path) -> str:
    """Return the name of the ROS package whose root is a folder; empty: it is not the root of a package."""
    try:
        return (ElementTree.parse(folder / "package.xml").getroot().findtext("name") or "").strip()
    except (OSError, ElementTree.ParseError, ValueError, LookupError):
        return ""


class _Joint:
    """A joint during the removal of fixed joints."""

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
        where = f"{path}: joint '{self.name}'"
        self.pose = origin_pose(element, where)
        self.axis = joint_axis(element, where)
        self.lower, self.upper = (
            number(_attribute(element, "limit", end) or "0", f"{where}: <limit> {end}") for end in ("lower", "upper")
        )
        if self.kind == "continuous":
            self.lower, self.upper = -2 * np.pi, 2 * np.pi
        elif self.kind != "fixed" and self.lower >= self.upper:
            raise ConfigError(f"{path}: joint '{self.name}' needs a <limit> with lower < upper")
        self.damping, self.friction = (
            number(_attribute(element, "dynamics", what) or "0", f"{where}: <dynamics> {what}")
            for what in ("damping", "friction")
        )

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
    name = element.get("name", "")
    mass = number(_attribute(element, "inertial/mass", "value") or "0", f"{path}: link '{name}': <mass>")
    if mass < 0:
        raise ConfigError(f"{path}: link '{name}': <mass> must not be below 0, got {mass:g}")
    return LinkModel(
        name=name,
        mass=mass,
        collision=tuple(_shape(collision, path) for collision in element.findall("collision")),
        visual=tuple(urdf_visual(visual, path, materials) for visual in element.findall("visual")),
    )


def _shape(element: ElementTree.Element, path: Path) -> Shape:
    kind, size, mesh, scale = _geometry(element, path)
    if len({abs(factor) for factor in scale}) != 1 or min(scale) <= 0:
        raise ConfigError(f"{path}: a collision mesh needs one scale > 0 for x, y and z, got {scale}")
    return Shape(
        kind="hull" if mesh else kind, size=size, mesh=mesh, scale=scale[0], pose=origin_pose(element, str(path))
    )


def urdf_materials(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    """Return the materials of a URDF by name: as in ROS, one that a link defines can be named by others."""
    stated = [*root.findall("material"), *root.iterfind("link/visual/material")]
    return {material.get("name", ""): material for material in reversed(stated) if _defined(material)}


def _defined(material: ElementTree.Element) -> bool:
    return material.find("color") is not None or material.find("texture") is not None


def urdf_visual(element: ElementTree.Element, path: Path, materials: dict[str, ElementTree.Element]) -> Visual:
    """Return a ``<visual>`` of a URDF.

    Args:
        element: The element.
        path: The URDF.
        materials: Its materials by name.

    As in RViz, a material's image stands in place of its colour.

    Raises:
        ConfigError: When it has no valid geometry, origin, colour or image.
    """
    kind, size, mesh, scale = _geometry(element, path)
    material = element.find("material")
    if material is not None and not _defined(material):
        material = materials.get(material.get("name", ""), material)
    surface = MaterialSpec()
    if material is not None and (image := material.find("texture")) is not None:
        file = mesh_path(image.get("filename", ""), path)
        if not file.is_file():
            raise ConfigError(f"{path}: material '{material.get('name', '')}' needs the <texture> {file}: no such file")
        surface = MaterialSpec(color=(1.0, 1.0, 1.0), texture=str(file))
    elif material is not None and (color := material.find("color")) is not None:
        text = color.get("rgba", "0.7 0.7 0.7 1")
        rgb = _vector(" ".join(text.split()[:3]), f"{path}: <color> rgba")
        if not all(0.0 <= value <= 1.0 for value in rgb):
            raise ConfigError(f"{path}: <color> rgba must be numbers from 0 to 1, got {limits.echo(text)}")
        surface = MaterialSpec(color=rgb)
    return Visual(kind=kind, size=size, mesh=mesh, scale=scale, pose=origin_pose(element, str(path)), material=surface)


def _geometry(element: ElementTree.Element, path: Path) -> tuple[str, tuple[float, ...], str, Vec3]:
    """Return kind, size, mesh file and scale of a visual or collision element."""
    geometry = element.find("geometry")
    inner = None if geometry is None else next(iter(geometry), None)
    if inner is None:
        raise ConfigError(f"{path}: a <{element.tag}> has no geometry")
    one: Vec3 = (1.0, 1.0, 1.0)
    try:
        if inner.tag == "box":
            return "box", _sizes(inner, "size", path), "", one
        if inner.tag == "sphere":
            return "sphere", _sizes(inner, "radius", path), "", one
        if inner.tag == "cylinder":
            return "cylinder", (*_sizes(inner, "radius", path), *_sizes(inner, "length", path)), "", one
        if inner.tag == "mesh":
            file = inner.attrib["filename"]
            return "mesh", (), str(mesh_path(file, path)), _vector(inner.get("scale", "1 1 1"), f"{path}: <mesh> scale")
    except KeyError as error:
        raise ConfigError(f"{path}: <{inner.tag}> lacks {error}") from None
    raise ConfigError(f"{path}: <{inner.tag}> is not a geometry of URDF; expected box, sphere, cylinder or mesh")


def origin_pose(element: ElementTree.Element, where: str) -> Pose:
    """Return the pose that the ``<origin>`` of an element states."""
    from scipy.spatial.transform import Rotation

    origin = element.find("origin")
    if origin is None:
        return IDENTITY
    rpy = _vector(origin.get("rpy", "0 0 0"), f"{where}: <origin> rpy")
    return Pose.from_arrays(
        _vector(origin.get("xyz", "0 0 0"), f"{where}: <origin> xyz"), Rotation.from_euler("xyz", rpy)
    )


def joint_axis(element: ElementTree.Element, where: str) -> Vec3:
    """Return the unit vector that the ``<axis>`` of a joint states; x without one, and for a fixed joint.

    Raises:
        ConfigError: When it is not three numbers, or has no direction.
    """
    if element.get("type") == "fixed":  # exporters write 0 0 0
        return 1.0, 0.0, 0.0
    return unit_axis(_vector(_attribute(element, "axis", "xyz") or "1 0 0", f"{where}: <axis>"), f"{where}: <axis>")


def _sizes(element: ElementTree.Element, name: str, path: Path) -> tuple[float, ...]:
    """Return the numbers of an attribute of a shape, all > 0."""
    where = f"{path}: <{element.tag}> {name}"
    text = element.attrib[name]
    values = _vector(text, where) if element.tag == "box" else (number(text, where),)
    if min(values) <= 0:
        raise ConfigError(f"{where} must be greater than 0, got {limits.echo(text)}")
    return values


def _vector(text: str, where: str) -> Vec3:
    values = [number(word, where) for word in text.split()]
    if len(values) != 3:
        raise ConfigError(f"{where} must be three numbers, got {limits.echo(text)}")
    x, y, z = values
    return x, y, z


def number(text: str, where: str) -> float:
    """Return a finite number.

    Raises:
        ConfigError: When the text is not a number, e.g. has a decimal comma.
    """
    try:
        value = float(text)
    except ValueError:
        hint = ", with a point for decimals" if "," in text else ""
        raise ConfigError(f"{where} must be a number{hint}, got {limits.echo(text)}") from None
    if not math.isfinite(value) or abs(value) > LARGEST:
        raise ConfigError(f"{where} must be a number of at most {LARGEST:g}, got {limits.echo(text)}")
    return value


def _attribute(element: ElementTree.Element, tag: str, name: str) -> str:
    found = element.find(tag)
    return "" if found is None else found.get(name, "")
