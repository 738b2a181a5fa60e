"""MuJoCo's robot descriptions (MJCF) as URDF, so that `roboxim robot new` and `robot gripper` read both.

A body becomes a link with a joint above it. What a robot's description may hold and a URDF cannot say is refused by
name; cameras, sites, contacts, sensors and motors' gains are left out.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roboxim_core.errors import ConfigError

Element = ElementTree.Element
Array = npt.NDArray[np.float64]
VISIBLE_GROUPS = (0, 1, 2)
"""Groups of geoms that MuJoCo's viewer shows."""
_TURNS = ("quat", "euler", "axisangle")
_SIZES = {"sphere": 1, "cylinder": 2, "capsule": 2, "box": 3}
"""Kind of geom to the least number of its sizes."""
_REFUSED = ("include", "replicate", "frame", "attach", "composite", "flexcomp")
"""Elements of which bodies and geoms are made; not read, these would be lost."""
_ACTUATORS = ("motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion")
"""Shortcuts of ``<general>``: in a default class, all of them set the same attributes."""


def is_mjcf(root: Element) -> bool:
    """Return whether an XML file's root is that of an MJCF."""
    return root.tag == "mujoco"


def urdf_of(root: Element, path: Path) -> Element:
    """Return the URDF of an MJCF.

    Args:
        root: Root element of the MJCF.
        path: Its file; mesh paths become relative to it.

    Raises:
        ConfigError: When it holds what a URDF cannot say, or wrong numbers.
    """
    try:
        return _Reader(root, path).urdf()
    except ValueError as error:  # of numbers and rotations
        raise ConfigError(f"{path} is not valid: {error}") from None


@dataclass
class _Reader:
    """Turns bodies into links and joints."""

    root: Element
    path: Path
    made: Element = field(init=False)
    _drawn: list[tuple[Element, Element, int, bool]] = field(init=False, default_factory=list)
    """Link, visual element, group, and whether the geom also touches, of each geom that MuJoCo's viewer shows."""

    def __post_init__(self) -> None:
        for tag in _REFUSED:
            if self.root.find(f".//{tag}") is not None:
                raise ConfigError(f"{self.path}: <{tag}> is not read; expand it first, e.g. by mujoco.mj_saveLastXML")
        compiler = self.root.find("compiler")
        settings = {} if compiler is None else dict(compiler.attrib)
        if settings.get("coordinate", "local") != "local" or settings.get("eulerseq", "xyz") != "xyz":
            raise ConfigError(f"{self.path}: <compiler>: only local coordinates and eulerseq xyz are read")
        self._unit = 1.0 if settings.get("angle") == "radian" else math.pi / 180
        self._meshes_in = settings.get("meshdir", settings.get("assetdir", ""))
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for default in self.root.findall("default"):
            self._read_defaults(default, {})
        self._meshes: dict[str, Element] = {}
        for mesh in self.root.iterfind("asset/mesh"):
            self._meshes[mesh.get("name") or Path(mesh.get("file", "")).stem] = mesh
        self._colors = {
            str(item.get("name")): str(item.get("rgba"))
            for item in self.root.iterfind("asset/material")
            if item.get("rgba")
        }
        self._efforts = dict(self._motor_efforts())
        self.made = ElementTree.Element("robot", {"name": self.root.get("model", "robot")})

    def _read_defaults(
        self, element: Element, above: dict[str, dict[str, str]], *, nested: bool = False
    ) -> None:  # fmt: skip
        """Keep the attributes that a class of elements has where an element does not say otherwise."""
        mine = {tag: dict(values) for tag, values in above.items()}
        for child in element:
            if child.tag != "default":
                mine.setdefault(_kind(child.tag), {}).update(child.attrib)
        self._classes[element.get("class", "main")] = mine
        if not nested:  # it holds everywhere, whatever its name
            self._classes["main"] = self._classes["main"] | mine
        for child in element.findall("default"):
            self._read_defaults(child, mine, nested=True)

    def _full(self, element: Element, inherited: str, kind: str = "") -> dict[str, str]:
        """Return an element's attributes together with those that its class has for its kind, by default its tag."""
        name = element.get("class") or inherited
        if name not in self._classes:
            raise ConfigError(f"{self.path}: no default class '{name}'; there are {', '.join(self._classes)}")
        return self._classes[name].get(kind or _kind(element.tag), {}) | element.attrib

    def _motor_efforts(self) -> Iterator[tuple[str, float]]:
        """Yield driven joints and the largest torque [N m] or force [N] that their actuators state."""
        for actuator in self.root.iterfind("actuator/*"):
            given = self._full(actuator, "main")
            kinds = ("force", "ctrl") if actuator.tag == "motor" else ("force",)  # a motor's control is its force
            stated = [
                max(map(abs, _numbers(given, f"{kind}range", 2)))
                for kind in kinds
                if f"{kind}range" in given and given.get(f"{kind}limited") != "false"
            ]
            if "joint" in given and stated:
                yield given["joint"], min(stated) * abs(_numbers(given, "gear", 1, 6, default="1")[0])

    def urdf(self) -> Element:
        world = self.root.find("worldbody")
        bodies = [] if world is None else world.findall("body")
        if len(bodies) != 1:
            raise ConfigError(f"{self.path}: expected one <body> in <worldbody>, found {len(bodies)}")
        self._body(bodies[0], "", "main")
        self._leave_out_what_only_touches()
        joints = {str(joint.get("name")): joint for joint in self.made.findall("joint")}
        for equality in self.root.iterfind("equality/joint"):
            if (given := self._full(equality, "main", "equality")).get("active") != "false":
                self._mimic(given, joints)
        return self.made

    def _leave_out_what_only_touches(self) -> None:
        """Remove visual elements of the groups that hold no geom which is only to be seen, if others do.

        Some models have shapes for contacts in a group that MuJoCo's viewer shows, e.g. those of robosuite in group 0.
        """
        to_see = {group for _, _, group, touches in self._drawn if not touches}
        for link, shape, group, _ in self._drawn:
            if to_see and group not in to_see:
                link.remove(shape)

    def _body(self, body: Element, parent: str, inherited: str) -> None:
        name = body.get("name")
        if not name:
            raise ConfigError(f"{self.path}: a <body> without name; a URDF's links have names")
        inherited = body.get("childclass", inherited)
        if body.find("freejoint") is not None or len(body.findall("joint")) > 1:
            raise ConfigError(f"{self.path}: body '{name}': expected at most one joint, a hinge or a slide")
        link = ElementTree.SubElement(self.made, "link", {"name": name})
        for geom in body.findall("geom"):
            self._geom(geom, link, inherited)
        self._inertial(body, link)
        if parent:
            self._joint(body, parent, inherited)
        for child in body.findall("body"):
            self._body(child, name, inherited)

    def _joint(self, body: Element, parent: str, inherited: str) -> None:
        name, found = str(body.get("name")), body.find("joint")
        given = {} if found is None else self._full(found, inherited)
        kinds = {"hinge": "revolute", "slide": "prismatic"}
        if found is not None and (kind := given.get("type", "hinge")) not in kinds:
            raise ConfigError(f"{self.path}: joint '{given.get('name')}' is a {kind}; expected a hinge or a slide")
        if any(_numbers(given, "pos", 3, default="0 0 0")):
            raise ConfigError(f"{self.path}: joint '{given.get('name')}': pos must be 0, the origin of its body")
        if any(_numbers(given, "ref", 1, default="0")):
            raise ConfigError(f"{self.path}: joint '{given.get('name')}': ref is not read; turn the body, and state 0")
        kind = "fixed" if found is None else kinds[given.get("type", "hinge")]
        lower, upper = _numbers(given, "range", 2, default="0 0")
        if kind == "revolute":
            lower, upper = lower * self._unit, upper * self._unit
            kind = "revolute" if lower < upper and given.get("limited") != "false" else "continuous"
        named = given.get("name", f"{name}_joint")
        made = ElementTree.SubElement(self.made, "joint", {"name": named, "type": kind})
        made.append(_origin(*self._pose(body)))
        ElementTree.SubElement(made, "parent", {"link": parent})
        ElementTree.SubElement(made, "child", {"link": name})
        if kind == "fixed":
            return
        ElementTree.SubElement(made, "axis", {"xyz": _text(_numbers(given, "axis", 3, default="0 0 1"))})
        limit = {} if kind == "continuous" else {"lower": f"{lower:.10g}", "upper": f"{upper:.10g}"}
        forces = _numbers(given, "actuatorfrcrange", 2, default="0 0")
        effort = max(map(abs, forces)) or self._efforts.get(named, 0.0)
        ElementTree.SubElement(made, "limit", limit | {"velocity": "0", "effort": f"{effort:.10g}"})

    def _mimic(self, equality: dict[str, str], joints: dict[str, Element]) -> None:
        first, second = str(equality.get("joint1")), str(equality.get("joint2"))
        factors = _numbers(equality, "polycoef", 2, 5, default="0 1 0 0 0")
        if first not in joints or second not in joints or any(factors[2:]):
            raise ConfigError(f"{self.path}: <equality>: {first} must be a multiple of the joint {second}")
        values = {"joint": second, "multiplier": f"{factors[1]:.10g}", "offset": f"{factors[0]:.10g}"}
        ElementTree.SubElement(joints[first], "mimic", values)

    def _geom(self, geom: Element, link: Element, inherited: str) -> None:
        given = self._full(geom, inherited)
        group = int(_numbers(given, "group", 1, default="0")[0])
        seen = group in VISIBLE_GROUPS
        touched = given.get("contype", "1") != "0" or given.get("conaffinity", "1") != "0"
        for tag in (*(("visual",) if seen else ()), *(("collision",) if touched else ())):
            shape = ElementTree.SubElement(link, tag)
            shape.append(_origin(*self._pose(geom, given)))
            ElementTree.SubElement(shape, "geometry").append(self._shape(given))
            if tag == "collision":
                continue
            self._drawn.append((link, shape, group, touched))
            color = given.get("rgba") or self._colors.get(given.get("material", ""))
            if color:
                _numbers({"rgba": color}, "rgba", 4)
                material = ElementTree.SubElement(shape, "material", {"name": ""})
                ElementTree.SubElement(material, "color", {"rgba": color})

    def _shape(self, given: dict[str, str]) -> Element:
        kind = "mesh" if "mesh" in given else given.get("type", "sphere")
        if "fromto" in given:
            raise ConfigError(f"{self.path}: a geom with fromto is not read; give pos, quat and size")
        if kind == "mesh":
            name = given.get("mesh", "")
            mesh = self._meshes.get(name)
            if mesh is None or not mesh.get("file"):
                raise ConfigError(f"{self.path}: no mesh '{name}' with a file in <asset>")
            file = str(Path(self._meshes_in) / mesh.get("file", ""))
            stated = self._full(mesh, "main")
            if moved := {"refpos", "refquat"} & stated.keys():
                raise ConfigError(
                    f"{self.path}: mesh '{name}': {' and '.join(sorted(moved))} are not read; move the mesh's points"
                )
            scale = _text(_numbers(stated, "scale", 3, default="1 1 1"))
            return ElementTree.Element("mesh", {"filename": file, "scale": scale})
        if kind not in _SIZES:
            kinds = "mesh, box, sphere, cylinder or capsule"
            raise ConfigError(f"{self.path}: a geom of type {kind} is not read; use {kinds}")
        size = _numbers(given, "size", _SIZES[kind], 3)
        if kind == "box":
            return ElementTree.Element("box", {"size": _text(2 * np.array(size))})
        length = {} if kind == "sphere" else {"length": _text([2 * size[1]])}
        return ElementTree.Element(kind, {"radius": _text(size[:1])} | length)

    def _inertial(self, body: Element, link: Element) -> None:
        found = body.find("inertial")
        if found is None:
            if body.find("geom") is not None:
                raise ConfigError(f"{self.path}: body '{body.get('name')}' has no <inertial>; state its mass")
            return
        place, turn = self._pose(found)
        if found.get("fullinertia"):
            xx, yy, zz, xy, xz, yz = _numbers(found.attrib, "fullinertia", 6)
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            inertia = np.diag(_numbers(found.attrib, "diaginertia", 3, default="0 0 0"))
        inertia = turn.as_matrix() @ inertia @ turn.as_matrix().T
        made = ElementTree.SubElement(link, "inertial")
        made.append(_origin(place, Rotation.identity()))
        _numbers(found.attrib, "mass", 1, default="0")
        ElementTree.SubElement(made, "mass", {"value": found.get("mass", "0")})
        names = ("xx", "xy", "xz", "yy", "yz", "zz")
        values = {f"i{name}": f"{inertia['xyz'.index(name[0]), 'xyz'.index(name[1])]:.8g}" for name in names}
        ElementTree.SubElement(made, "inertia", values)

    def _pose(self, element: Element, given: dict[str, str] | None = None) -> tuple[Array, Rotation]:
        given = dict(element.attrib) if given is None else given
        if other := {"xyaxes", "zaxis"} & set(given):
            raise ConfigError(f"{self.path}: {min(other)} of a <{element.tag}> is not read; use {' or '.join(_TURNS)}")
        turn = Rotation.identity()
        if "quat" in given:
            w, x, y, z = _numbers(given, "quat", 4)
            turn = Rotation.from_quat([x, y, z, w])
        elif "euler" in given:
            turn = Rotation.from_euler("XYZ", self._unit * np.array(_numbers(given, "euler", 3)))
        elif "axisangle" in given:
            *axis, angle = _numbers(given, "axisangle", 4)
            turn = Rotation.from_rotvec(self._unit * angle * np.array(axis) / (np.linalg.norm(axis) or 1.0))
        return np.array(_numbers(given, "pos", 3, default="0 0 0")), turn


def _kind(tag: str) -> str:
    """Return the name under which a default class keeps the attributes of an element."""
    return "general" if tag in _ACTUATORS else tag


def _origin(place: Array, turn: Rotation) -> Element:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a quarter turn about y has many triples of angles; any will do
        angles = turn.as_euler("xyz")
    return ElementTree.Element("origin", {"xyz": _text(place), "rpy": _text(angles)})


def _text(values: npt.ArrayLike) -> str:
    return " ".join(f"{value:.10g}" for value in np.asarray(values).tolist())


def _numbers(given: Mapping[str, str], name: str, least: int, most: int = 0, *, default: str = "") -> list[float]:
    """Return the numbers of an attribute.

    Args:
        given: The element's attributes.
        name: Name of the attribute.
        least: Smallest number of numbers.
        most: Largest number of numbers; 0: the smallest.
        default: Text of an attribute that is not there.

    Raises:
        ValueError: When it holds another number of numbers, or they are not finite.
    """
    text = given.get(name, default)
    with contextlib.suppress(ValueError):
        found = [float(word) for word in text.split()]
        if least <= len(found) <= max(least, most) and all(map(math.isfinite, found)):
            return found
    expected = f"{least}" if most <= least else f"{least} to {most}"
    raise ValueError(f"{name}='{text}': expected {expected} finite number{'s' * (max(least, most) > 1)}")
