"""A robot's files from somebody's URDF: `roboxim robot new`.

The arm is cut out between base and flange, every name gets the robot's prefix, visual meshes are decimated to GLB,
collision meshes become convex parts that cover them, a gripper is mounted, and the pairs of links that self-collision
checks leave out are found by sampling. `roboxim robot check` then proves the result.
"""

from __future__ import annotations

import contextlib
import math
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh
import yaml

from roboxim_core.errors import ConfigError
from roboxim_core.models.urdf import mesh_path, urdf_root
from roboxim_runs.robots.collision_pairs import srdf_text
from roboxim_runs.robots.convex_parts import convex_parts
from roboxim_runs.robots.decimation import Color, visual
from roboxim_runs.robots.grippers import gripper, mounted
from roboxim_runs.robots.home import home_of
from roboxim_runs.robots.recipe import NAME_PATTERN, RobotRecipe, source_file, spread

Element = ElementTree.Element
MOVING = ("revolute", "continuous", "prismatic")
MIN_GAIN = 0.03
"""Fraction of a link's hull that a further convex part must save."""
MAX_PARTS = 8
WELD_M = 0.001
"""Detail of visual meshes that is dropped [m]."""
GREY: Color = (190, 192, 196)
"""Colour of a mesh that neither its file nor the URDF gives one."""
JERK_TIME_S = 0.05
"""Time in which an acceleration is reached when no jerk is given [s]."""


def derive(recipe: RobotRecipe, out: Path, *, folder: Path | None = None, say: Callable[[str], None] = print) -> Path:
    """Write a robot's folder and its YAML file.

    Args:
        recipe: What to do.
        out: Folder ``robots`` of a configuration folder; receives ``NAME/`` and ``NAME.yaml``.
        folder: Folder that the recipe's ``urdf`` is relative to; none: the working directory.
        say: Receives a line for each step.

    Returns:
        The YAML file.

    Raises:
        ConfigError: When the URDF has no such arm, or a mesh is missing or unreadable.
    """
    if not re.fullmatch(NAME_PATTERN, recipe.name):
        raise ConfigError(f"name '{recipe.name}': expected lower-case letters, digits and _, a letter first")
    source = source_file(recipe.urdf, folder or Path.cwd())
    arm = Arm(expanded(source), source, recipe)
    target, scratch = out / recipe.name, out / f".{recipe.name}.new"
    shutil.rmtree(scratch, ignore_errors=True)
    inside = scratch / "robots" / recipe.name
    file = scratch / "robots" / f"{recipe.name}.yaml"
    for kind in ("visual", "collision"):
        (inside / kind).mkdir(parents=True)
    try:
        say(f"{len(arm.joints)} joints from {arm.base} to {arm.flange}: {', '.join(arm.joints)}")
        tool = gripper(recipe.gripper)
        root = ElementTree.Element("robot", {"name": recipe.name})
        root.extend(list(arm.elements(inside, say)))
        mount = ElementTree.SubElement(root, "joint", {"name": f"{recipe.name}_mount_joint", "type": "fixed"})
        ElementTree.SubElement(mount, "parent", {"link": f"{recipe.name}_{arm.flange}"})
        ElementTree.SubElement(mount, "child", {"link": f"{recipe.name}_{tool.root.removeprefix(tool.prefix)}"})
        origin = {"xyz": _text(recipe.mount_xyz), "rpy": _text(recipe.mount_rpy)}
        ElementTree.SubElement(mount, "origin", origin)
        root.extend(mounted(tool, recipe.name, inside, lambda name: f"{recipe.name}_{name}"))
        ElementTree.indent(root)
        urdf = inside / f"{recipe.name}.urdf"
        ElementTree.ElementTree(root).write(urdf, encoding="utf-8", xml_declaration=True)
        say("sampling which links can touch")
        (inside / f"{recipe.name}.srdf").write_text(srdf_text(recipe.name, urdf))
        values = arm.values(tool.prefix)
        file.write_text(_yaml(recipe, values))
        if not recipe.home:
            say("searching a home pose")
            values["home"] = [round(float(q), 4) for q in home_of(recipe.name, scratch)]
            file.write_text(_yaml(recipe, values))
        for kept in target.glob("*") if target.is_dir() else ():
            if kept.name in ("LICENSE", "README.md", "recipe.yaml"):
                shutil.copy(kept, inside / kept.name)
        shutil.rmtree(target, ignore_errors=True)
        inside.rename(target)
        return Path(file.replace(out / f"{recipe.name}.yaml"))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


class Arm:
    """The part of a URDF between base and flange."""

    def __init__(self, root: Element, path: Path, recipe: RobotRecipe) -> None:
        """Find the chain.

        Raises:
            ConfigError: When base or flange are missing, do not lie on one chain, or a joint is not supported.
        """
        self.path, self.recipe = path, recipe
        self._links = {str(link.get("name")): link for link in root.findall("link")}
        self._materials = {str(item.get("name")): item for item in root.findall("material")}
        above = {_child(joint): joint for joint in root.findall("joint")}
        roots = [name for name in self._links if name not in above]
        if len(roots) != 1:
            raise ConfigError(f"{path}: expected one root link, found {', '.join(roots) or 'none'}")
        self.base = recipe.base or self._first_body(roots[0], above)
        self.flange = recipe.flange or self._last(above)
        for what, name in (("base", self.base), ("flange", self.flange)):
            if name not in self._links:
                raise ConfigError(f"{path}: no link '{name}' for the {what}; its links are {', '.join(self._links)}")
        chain = [self.flange]
        while chain[-1] != self.base:
            if chain[-1] not in above:
                raise ConfigError(f"{path}: '{self.flange}' is not below '{self.base}'")
            chain.append(_parent(above[chain[-1]]))
        self._chain = [above[link] for link in reversed(chain[:-1])]
        moving = [joint for joint in self._chain if joint.get("type") != "fixed"]
        for joint in moving:
            if joint.get("type") not in ("revolute", "continuous"):
                raise ConfigError(
                    f"{path}: joint '{joint.get('name')}' is {joint.get('type')}; an arm has revolute joints"
                )
        if not moving:
            raise ConfigError(f"{path}: no joint moves between '{self.base}' and '{self.flange}'")
        self.joints = {str(joint.get("name")): joint for joint in moving}
        self._kept = [*(self._links[link] for link in reversed(chain)), *self._side_links(above, set(chain))]

    def _first_body(self, root: str, above: dict[str, Element]) -> str:
        """Return the first link with a shape, below links such as ``world``."""
        link = root
        while self._links[link].find("collision") is None:
            below = [name for name, joint in above.items() if _parent(joint) == link]
            if len(below) != 1:
                break
            link = below[0]
        return link

    def _last(self, above: dict[str, Element]) -> str:
        """Return the link at the end of the longest chain."""

        def depth(link: str) -> int:
            return 0 if link not in above else 1 + depth(_parent(above[link]))

        return max(self._links, key=depth)

    def _side_links(self, above: dict[str, Element], chain: set[str]) -> list[Element]:
        """Return the links that are fixed to the chain before the flange, e.g. covers."""
        side = []
        for name, link in self._links.items():
            at, fixed = name, True
            while at not in chain and at in above:
                fixed = fixed and above[at].get("type") == "fixed"
                at = _parent(above[at])
            if name not in chain and fixed and at in chain - {self.flange} and link.find("visual") is not None:
                side.append(link)
                if above[name] not in self._chain:
                    self._chain.append(above[name])
        return side

    def elements(self, folder: Path, say: Callable[[str], None]) -> Iterable[Element]:
        """Yield links and joints with the robot's names and meshes; write the meshes.

        Raises:
            ConfigError: When a mesh is missing or unreadable.
        """
        for link in self._kept:
            made = ElementTree.Element("link", {"name": self._named(link)})
            shapes = self._visual(link, folder) + self._collision(link, folder)
            made.extend(shapes)
            inertial = link.find("inertial")
            made.append(massless() if inertial is None else inertial)
            if shapes:
                say(f"  {link.get('name')}: {sum(shape.tag == 'collision' for shape in shapes)} convex parts")
            yield made
        for joint in self._chain:
            yield self._joint(joint)

    def _named(self, element: Element) -> str:
        return f"{self.recipe.name}_{element.get('name')}"

    def _joint(self, joint: Element) -> Element:
        moving = joint.get("type") != "fixed"
        made = ElementTree.Element("joint", {"name": self._named(joint), "type": "revolute" if moving else "fixed"})
        ElementTree.SubElement(made, "parent", {"link": f"{self.recipe.name}_{_parent(joint)}"})
        ElementTree.SubElement(made, "child", {"link": f"{self.recipe.name}_{_child(joint)}"})
        for tag in ("origin", "axis"):
            if (part := joint.find(tag)) is not None:
                made.append(part)
        if moving:
            lower, upper, velocity, effort = self._limits(joint)
            limit = {"lower": lower, "upper": upper, "velocity": velocity, "effort": effort}
            ElementTree.SubElement(made, "limit", {name: f"{value:.10g}" for name, value in limit.items()})
            ElementTree.SubElement(made, "dynamics", {"damping": "0.003", "friction": "0.0"})
        return made

    def _limits(self, joint: Element) -> tuple[float, float, float, float]:
        """Return lower and upper limit [rad], speed [rad/s] and torque [N m] of a joint."""
        limit = joint.find("limit")
        given = (
            {}
            if limit is None
            else {name: float(value) for name, value in limit.attrib.items() if ":" not in name and "}" not in name}
        )
        half = self.recipe.range_rad / 2
        lower, upper = given.get("lower", -half), given.get("upper", half)
        if joint.get("type") == "continuous" or upper - lower > self.recipe.range_rad:
            lower, upper = -half, half
        place = list(self.joints).index(str(joint.get("name")))
        velocity = given.get("velocity", 0.0)
        if self.recipe.velocity:
            velocity = spread(self.recipe.velocity, len(self.joints), "velocity")[place]
        for what, value in (("velocity", velocity), ("effort", given.get("effort", 0.0))):
            if value <= 0.0:
                raise ConfigError(
                    f"{self.path}: joint '{joint.get('name')}' has no {what} limit; "
                    + ("give --velocity" if what == "velocity" else "add effort to its <limit>")
                )
        return lower, upper, velocity, given["effort"]

    def _visual(self, link: Element, folder: Path) -> list[Element]:
        parts: list[tuple[Color, trimesh.Trimesh]] = []
        for shape in link.findall("visual"):
            parts += coloured(shape, self.path, self._materials)
        if not parts:
            return []
        file = f"visual/{link.get('name')}.glb"
        scene = visual(parts, triangles=self.recipe.triangles, weld_m=WELD_M)
        (folder / file).write_bytes(scene.export(file_type="glb", include_normals=True))
        return [self._shape("visual", file)]

    def _collision(self, link: Element, folder: Path) -> list[Element]:
        made = []
        for k, shape in enumerate(link.findall("collision")):
            meshes = [mesh for _, mesh in coloured(shape, self.path, self._materials)]
            solid = trimesh.Trimesh(*trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes]))
            for i, part in enumerate(convex_parts(solid, min_gain=MIN_GAIN, max_parts=MAX_PARTS)):
                file = f"collision/{link.get('name')}_{k + 1}_{i + 1}.stl"
                part.export(folder / file)
                made.append(self._shape("collision", file))
        return made

    def _shape(self, tag: str, file: str) -> Element:
        made = ElementTree.Element(tag)
        geometry = ElementTree.SubElement(made, "geometry")
        ElementTree.SubElement(geometry, "mesh", {"filename": f"package://{self.recipe.name}/{file}"})
        return made

    def values(self, gripper_prefix: str) -> dict[str, Any]:
        """Return the content of the robot's YAML file."""
        recipe, tool, count = self.recipe, gripper(self.recipe.gripper), len(self.joints)
        limits = [self._limits(joint) for joint in self.joints.values()]
        acceleration = spread(recipe.acceleration, count, "acceleration")
        jerk = spread(recipe.jerk, count, "jerk") if recipe.jerk else tuple(a / JERK_TIME_S for a in acceleration)
        efforts = [limit[3] for limit in limits]

        def own(name: str) -> str:
            return f"{recipe.name}_{name.removeprefix(gripper_prefix)}"

        home = spread(recipe.home, count, "home") if recipe.home else tuple((low + up) / 2 for low, up, *_ in limits)
        return {
            "urdf": f"{recipe.name}/{recipe.name}.urdf",
            "srdf": f"{recipe.name}/{recipe.name}.srdf",
            "base_link": f"{recipe.name}_{self.base}",
            "tcp_link": own(tool.tcp),
            "joint_names": [f"{recipe.name}_{name}" for name in self.joints],
            "limits": {
                "lower": [limit[0] for limit in limits],
                "upper": [limit[1] for limit in limits],
                "velocity": [limit[2] for limit in limits],
                "acceleration": list(acceleration),
                "jerk": [round(value, 6) for value in jerk],
                "effort": efforts,
            },
            "gripper": {
                "joint_names": [own(name) for name in tool.joints],
                "max_opening_m": tool.max_opening_m,
                "force_n": tool.force_n,
                "speed_m_s": tool.speed_m_s,
                "links": [own(name) for name in tool.links],
            },
            "home": list(home),
            "position_gain": 0.3,
            # Weaker wrists do not keep the tool within 2 mm of its command; see config/robots/panda.yaml.
            "motor_force": [max(effort, 50.0) for effort in efforts],
        }


def massless() -> Element:
    """Return the inertial element of a frame; PyBullet gives a link without one a mass of 1 kg."""
    made = ElementTree.Element("inertial")
    ElementTree.SubElement(made, "mass", {"value": "0"})
    ElementTree.SubElement(made, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))
    return made


def expanded(path: Path) -> Element:
    """Return the root element of a URDF or xacro file.

    Raises:
        ConfigError: When it cannot be read, or is a xacro and `xacrodoc` is not installed.
    """
    if b"<xacro:" not in path.read_bytes():
        return urdf_root(path)
    try:
        from xacrodoc import XacroDoc
    except ModuleNotFoundError:
        raise ConfigError(f"{path} is a xacro; install the package that expands it: pip install xacrodoc") from None
    try:
        with contextlib.chdir(path.parent):  # which its includes are relative to
            return ElementTree.fromstring(XacroDoc.from_file(path.name, resolve_packages=False).to_urdf_string())
    except Exception as error:  # whatever the macros raise
        raise ConfigError(f"{path} cannot be expanded: {error}") from None


def coloured(shape: Element, path: Path, materials: dict[str, Element]) -> list[tuple[Color, trimesh.Trimesh]]:
    """Return colour and mesh of each part of a URDF's visual or collision shape, in its link's frame.

    Raises:
        ConfigError: When the geometry is missing, unreadable or of another kind.
    """
    geometry = shape.find("geometry")
    item = None if geometry is None else next(iter(geometry), None)
    if item is None:
        raise ConfigError(f"{path}: a <{shape.tag}> has no geometry")
    material = shape.find("material")
    named = None if material is None else materials.get(str(material.get("name")))
    color = next((c for m in (material, named) if m is not None and (c := m.find("color")) is not None), None)
    stated: Color | None = None
    if color is not None:
        stated = tuple(round(255 * float(value)) for value in str(color.get("rgba")).split()[:3])
    if item.tag == "mesh":
        parts = _loaded(mesh_path(str(item.get("filename")), path), _numbers(item.get("scale", "1 1 1")))
    elif item.tag == "box":
        parts = [(None, trimesh.creation.box(_numbers(str(item.get("size")))))]
    elif item.tag == "cylinder":
        solid = trimesh.creation.cylinder(float(str(item.get("radius"))), float(str(item.get("length"))))
        parts = [(None, solid)]
    elif item.tag == "sphere":
        parts = [(None, trimesh.creation.icosphere(radius=float(str(item.get("radius")))))]
    else:
        raise ConfigError(f"{path}: geometry <{item.tag}> is not supported; use mesh, box, cylinder or sphere")
    origin = shape.find("origin")
    placed = np.eye(4)
    if origin is not None:
        placed = trimesh.transformations.euler_matrix(*_numbers(origin.get("rpy", "0 0 0")))
        placed[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    for _, mesh in parts:
        mesh.apply_transform(placed)
    return [(stated or own or GREY, mesh) for own, mesh in parts]


def _loaded(file: Path, scale: list[float]) -> list[tuple[Color | None, trimesh.Trimesh]]:
    """Return colour and mesh of each part of a mesh file; no colour: the file has none."""
    try:
        scene = trimesh.load_scene(file)
    except Exception as error:  # trimesh's readers raise whatever their parsers raise
        raise ConfigError(f"cannot read the mesh {file}: {error}") from None
    parts: list[tuple[Color | None, trimesh.Trimesh]] = []
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            mesh.apply_scale(scale)
            parts.append((_color(mesh), mesh))
    if not parts:
        raise ConfigError(f"{file} holds no triangles")
    return parts


def _color(mesh: trimesh.Trimesh) -> Color | None:
    main = getattr(getattr(mesh.visual, "material", None), "main_color", None)
    if main is None or len(main) < 3 or tuple(main[:3]) == (102, 102, 102):  # trimesh's default
        return None
    return tuple(int(c) for c in main[:3])


def _child(joint: Element) -> str:
    part = joint.find("child")
    return "" if part is None else str(part.get("link"))


def _parent(joint: Element) -> str:
    part = joint.find("parent")
    return "" if part is None else str(part.get("link"))


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.10g}" for value in values)


def _yaml(recipe: RobotRecipe, values: dict[str, Any]) -> str:
    comment = f"# {recipe.title or recipe.name} with the gripper {recipe.gripper}."
    if recipe.source:
        comment += f" Source: {recipe.source}."
    comment += "\n# Written by `roboxim robot new`; accelerations are the recipe's, the other limits the URDF's.\n"
    rounded = {
        name: [round(v, 6) if isinstance(v, float) and math.isfinite(v) else v for v in value]
        if isinstance(value, list)
        else value
        for name, value in values.items()
    }
    return comment + str(yaml.safe_dump(rounded, sort_keys=False, default_flow_style=None, width=120))
