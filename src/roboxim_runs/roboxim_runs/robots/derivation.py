"""Derives a robot's files from a URDF: `roboxim robot new`.

The arm is cut out between base and flange, every name gets the robot's prefix, visual meshes are decimated to GLB,
collision meshes become convex parts that cover them, a gripper is mounted, and the pairs of links that self-collision
checks leave out are found by sampling. `roboxim robot check` then proves the result.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml
from scipy.spatial.transform import Rotation

from roboxim_core.config import named_config
from roboxim_core.errors import ConfigError
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.urdf import joint_axis, number, origin_pose, urdf_materials, urdf_root
from roboxim_core.poses import Pose
from roboxim_runs.robots.collision_pairs import srdf_text
from roboxim_runs.robots.gripper_derivation import plain
from roboxim_runs.robots.grippers import Gripper, below, gripper, mounted
from roboxim_runs.robots.home import home_of, same_place
from roboxim_runs.robots.link_meshes import LinkMeshes
from roboxim_runs.robots.recipe import NAME_PATTERN, RobotRecipe, source_file, spread
from roboxim_runs.robots.stand import covered, root_link, stand
from roboxim_runs.robots.urdf_files import expanded, fixed_joint, massless, replaced, write

Element = ElementTree.Element
SHAPES = ("visual", "collision")
ACCELERATIONS = "accelerations are the recipe's, the other limits the URDF's"
UNCOVERED_M = 0.02
"""How far a visual mesh may reach beyond its collision parts without a word [m]."""
JERK_TIME_S = 0.05
"""Time in which an acceleration is reached when no jerk is given [s]."""


def derive(
    recipe: RobotRecipe, out: Path, *, folder: Path | None = None, report: Callable[[str], None] = print
) -> Path:
    """Write a robot's folder and its YAML file.

    Args:
        recipe: What to do.
        out: Folder ``robots`` of a configuration folder; receives ``NAME/`` and ``NAME.yaml``.
        folder: Folder that the recipe's ``urdf`` is relative to; none: the working directory.
        report: Receives a line for each step.

    Returns:
        The YAML file.

    Raises:
        ConfigError: When the URDF has no such arm, or a mesh is missing or unreadable.
    """
    if not re.fullmatch(NAME_PATTERN, recipe.name):
        raise ConfigError(f"name '{recipe.name}': expected lower-case letters, digits and _, a letter first")
    if recipe.arm:
        arm: Arm = ShippedArm(recipe)
    else:
        source = source_file(recipe.urdf, folder or Path.cwd())
        arm = Arm(expanded(source), source, recipe)
    with replaced(out, "robots", recipe.name) as inside:
        file = inside.parent / f"{recipe.name}.yaml"
        report(f"{len(arm.joints)} joints from {arm.base} to {arm.flange}: {', '.join(arm.joints)}")
        if arm.beside and not recipe.arm:
            report(f"kept, as they are fixed to it (--without leaves them out): {', '.join(arm.beside)}")
        tool = gripper(recipe.gripper)
        values = arm.values(tool)  # before meshes, which take long
        root = ElementTree.Element("robot", {"name": recipe.name})
        root.extend(list(arm.elements(inside, report)))
        root.extend(stand(recipe, inside, arm.own(arm.base)))
        hand = f"{recipe.name}_{tool.root.removeprefix(tool.prefix)}"
        xyz, rpy = _text(arm.mount.position), _text(arm.mount.rotation.as_euler("xyz"))
        root.append(fixed_joint(f"{recipe.name}_mount_joint", arm.own(arm.flange), hand, xyz=xyz, rpy=rpy))
        root.extend(mounted(tool, recipe.name, inside, lambda name: f"{recipe.name}_{name}"))
        urdf = inside / f"{recipe.name}.urdf"
        write(root, urdf)
        report("sampling which links can touch")
        together = frozenset(tool.model(lambda name: f"{recipe.name}_{name}").links)
        (inside / f"{recipe.name}.srdf").write_text(srdf_text(recipe.name, urdf, together=together))
        file.write_text(_yaml(recipe, values))
        if not recipe.home:
            report("searching a home pose")
            values["home"] = [round(float(q), 4) for q in arm.home(file.parents[1])]
            file.write_text(_yaml(recipe, values))
    return out / f"{recipe.name}.yaml"


class Arm:
    """The part of a URDF between base and flange."""

    def __init__(self, root: Element, path: Path, recipe: RobotRecipe, *, base: str = "", flange: str = "") -> None:
        """Find the chain.

        Args:
            root: Root of the URDF.
            path: Its file.
            recipe: What to do.
            base: First link; empty: the recipe's, or the first link with a shape.
            flange: Last link; empty: the recipe's, or the end of the longest chain.

        Raises:
            ConfigError: When base or flange are missing, do not lie on one chain, or a joint is not supported.
        """
        self.path, self.recipe = path, recipe
        self._links = {str(link.get("name")): link for link in root.findall("link")}
        self._materials = urdf_materials(root)
        above = {_child(joint): joint for joint in root.findall("joint")}
        roots = [name for name in self._links if name not in above]
        if len(roots) != 1:
            raise ConfigError(f"{path}: expected one root link, found {', '.join(roots) or 'none'}")
        self.base = base or recipe.base or self._first_body(roots[0], above)
        self.flange = flange or recipe.flange or self._last(above)
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
            if joint.find("mimic") is not None:
                raise ConfigError(
                    f"{path}: joint '{joint.get('name')}' follows another one (<mimic>); an arm's joints move alone"
                )
        if len(moving) < 5:
            raise ConfigError(
                f"{path}: {len(moving)} joints move between '{self.base}' and '{self.flange}'; an arm needs at least 5 "
                "for a tool that points down at any yaw"
            )
        self.joints = {str(joint.get("name")): joint for joint in moving}
        self._uncovered_m: dict[str, float] = {}
        side = self._side_links(above, set(chain))
        self.beside = [str(link.get("name")) for link in side]
        """Links that are kept although they are not on the chain."""
        self._kept = [*(self._links[link] for link in reversed(chain)), *side]

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
        """Return the links with shapes that are fixed to the chain before the flange, e.g. covers.

        Frames without a shape that hold such a link are among them.
        """
        left_out = self.recipe.without
        side: dict[str, Element] = {}
        if wrong := [name for name in left_out if name not in self._links or name in chain]:
            raise ConfigError(f"{self.path}: without {', '.join(wrong)}: expected links beside the chain")
        for name, link in self._links.items():
            at, fixed, path = name, True, []
            while at not in chain and at in above:
                fixed = fixed and above[at].get("type") == "fixed" and at not in left_out
                path.append(at)
                at = _parent(above[at])
            if fixed and at in chain - {self.flange} and any(map(link.findall, SHAPES)):
                for one in reversed(path):
                    if one not in side:
                        side[one] = self._links[one]
                        self._chain.append(above[one])
        return list(side.values())

    def elements(self, folder: Path, report: Callable[[str], None]) -> Iterable[Element]:
        """Yield links and joints with the robot's names and meshes; write the meshes.

        Raises:
            ConfigError: When a mesh is missing or unreadable.
        """
        for link in self._kept:
            made = ElementTree.Element("link", {"name": self.own(str(link.get("name")))})
            shapes = self._shapes(link, folder)
            made.extend(shapes)
            inertial = link.find("inertial")
            made.append(massless() if inertial is None else inertial)
            if shapes:
                report(f"  {link.get('name')}: {sum(shape.tag == 'collision' for shape in shapes)} convex parts")
            yield made
        if bare := {name: beyond for name, beyond in self._uncovered_m.items() if beyond > UNCOVERED_M}:
            named = ", ".join(f"{name} ({1000 * beyond:.0f} mm)" for name, beyond in bare.items())
            report(f"what is seen reaches beyond the collision shapes (--cover makes them of it): {named}")
        for joint in self._chain:
            yield self._joint(joint)

    @property
    def mount(self) -> Pose:
        """Pose of the gripper in the flange."""
        return Pose.from_arrays(self.recipe.mount_xyz, Rotation.from_euler("xyz", self.recipe.mount_rpy))

    @property
    def stand(self) -> list[float]:
        """Rectangle that the arm's stand covers, as `RobotModel.stand`."""
        return covered(self.recipe)

    @property
    def start(self) -> list[float]:
        """Box in which tasks start the tool, as `RobotModel.start`."""
        return list(self.recipe.start)

    def own(self, name: str) -> str:
        """Return the robot's name of a link or joint."""
        return f"{self.recipe.name}_{name}"

    def home(self, folder: Path) -> Iterable[float]:
        """Return joint positions at home [rad], given the configuration folder that has the robot's files.

        Raises:
            ConfigError: When the arm cannot point its tool down above the table.
        """
        return [float(q) for q in home_of(self.recipe.name, folder)]

    def _shapes(self, link: Element, folder: Path) -> list[Element]:
        """Return the visual and collision elements of a link; write its meshes."""
        recipe = self.recipe
        meshes = LinkMeshes(
            recipe.name, folder, self.path, self._materials, triangles=recipe.triangles, collision_m=recipe.collision_m
        )
        made = meshes.visual(link) + meshes.collision(link, cover=recipe.cover)
        self._uncovered_m[str(link.get("name"))] = meshes.uncovered_m
        return made

    def _joint(self, joint: Element) -> Element:
        moving = joint.get("type") != "fixed"
        name = self.own(str(joint.get("name")))
        made = ElementTree.Element("joint", {"name": name, "type": "revolute" if moving else "fixed"})
        ElementTree.SubElement(made, "parent", {"link": self.own(_parent(joint))})
        ElementTree.SubElement(made, "child", {"link": self.own(_child(joint))})
        if (origin := joint.find("origin")) is not None:
            origin_pose(joint, f"{self.path}: joint '{joint.get('name')}'")  # checks it
            made.append(origin)
        if moving:
            axis = joint_axis(joint, f"{self.path}: joint '{joint.get('name')}'")
            ElementTree.SubElement(made, "axis", {"xyz": _text(axis)})
            lower, upper, velocity, effort = self._limits(joint)
            limit = {"lower": lower, "upper": upper, "velocity": velocity, "effort": effort}
            ElementTree.SubElement(made, "limit", {name: f"{value:.10g}" for name, value in limit.items()})
            ElementTree.SubElement(made, "dynamics", {"damping": "0.003", "friction": "0.0"})
        return made

    def _limits(self, joint: Element) -> tuple[float, float, float, float]:
        """Return lower and upper limit [rad], speed [rad/s] and torque [N m] of a joint.

        Of a range wider than the recipe's, as much as that is kept, as near to the middle of 0 as the range allows.
        """
        limit, where = joint.find("limit"), f"{self.path}: joint '{joint.get('name')}'"
        given: dict[str, float] = {
            name: number(limit.attrib[name], f"{where}: <limit> {name}")
            for name in ("lower", "upper", "velocity", "effort")
            if limit is not None and name in limit.attrib
        }
        whole = self.recipe.range_rad
        lower, upper = given.get("lower", 0.0), given.get("upper", 0.0)
        if joint.get("type") == "continuous":
            lower, upper = -whole / 2, whole / 2
        elif lower >= upper:
            raise ConfigError(f"{where} has no range, got {lower:g} to {upper:g} rad; give its <limit> lower < upper")
        elif upper - lower > whole:
            lower = min(max(-whole / 2, lower), upper - whole)
            upper = lower + whole
        place = list(self.joints).index(str(joint.get("name")))
        for what, stated in (("velocity", self.recipe.velocity), ("effort", self.recipe.effort)):
            if stated:
                given[what] = spread(stated, len(self.joints), what)[place]
            if given.get(what, 0.0) <= 0.0:
                raise ConfigError(f"{where} has no {what} limit; give --{what}")
        return lower, upper, given["velocity"], given["effort"]

    def values(self, tool: Gripper) -> dict[str, Any]:
        """Return the content of the robot's YAML file."""
        recipe, count = self.recipe, len(self.joints)
        limits = [self._limits(joint) for joint in self.joints.values()]
        self._require_home(limits)
        acceleration = spread(recipe.acceleration, count, "acceleration")
        jerk = spread(recipe.jerk, count, "jerk") if recipe.jerk else tuple(a / JERK_TIME_S for a in acceleration)
        efforts = [limit[3] for limit in limits]
        home = spread(recipe.home, count, "home") if recipe.home else tuple((low + up) / 2 for low, up, *_ in limits)
        stated = {
            "lower": [limit[0] for limit in limits],
            "upper": [limit[1] for limit in limits],
            "velocity": [limit[2] for limit in limits],
            "acceleration": list(acceleration),
            "jerk": [round(value, 6) for value in jerk],
            "effort": efforts,
        }
        # Weaker wrists do not keep the tool within 2 mm of its command; see config/robots/panda.yaml.
        return self._file(tool, stated, list(home), [max(effort, 50.0) for effort in efforts])

    def _require_home(self, limits: Iterable[Sequence[float]]) -> None:
        """Check that the recipe's home lies within the joints' limits, given lower and upper of each first [rad].

        Raises:
            ConfigError: Naming the first joint that is beyond.
        """
        recipe = self.recipe
        home = spread(recipe.home, len(self.joints), "home") if recipe.home else ()
        for name, angle, (lower, upper, *_) in zip(self.joints, home, limits, strict=False):
            if not lower <= angle <= upper:
                raise ConfigError(
                    f"home: joint '{name}' is at {angle:g} rad, beyond its limits {lower:.4g} to {upper:.4g} rad"
                )

    def _file(
        self, tool: Gripper, limits: dict[str, Any], home: list[float], motor_force: list[float], gain: float = 0.3
    ) -> dict[str, Any]:
        name = self.recipe.name
        return {
            "urdf": f"{name}/{name}.urdf",
            "srdf": f"{name}/{name}.srdf",
            "base_link": root_link(self.recipe, self.own(self.base)),
            "tcp_link": f"{name}_{tool.tcp.removeprefix(tool.prefix)}",
            "joint_names": [self.own(joint) for joint in self.joints],
            "limits": limits,
            "gripper": plain(tool.model(lambda inner: f"{name}_{inner}")),
            "home": home,
            "position_gain": gain,
            "motor_force": motor_force,
            **({"rotations": rotations} if (rotations := min(3, len(self.joints) - 3)) < 3 else {}),
            **({"start": start} if (start := self.start) else {}),
            **({"stand": area} if (area := self.stand) else {}),
        }


class ShippedArm(Arm):
    """The arm of a robot in ``config/robots``, without its gripper. Its meshes, limits and mount are taken over."""

    def __init__(self, recipe: RobotRecipe) -> None:
        """Find the robot's arm.

        Raises:
            ConfigError: When there is no such robot.
        """
        self.model: RobotModel = ModelLibrary().robot(recipe.arm)
        file = named_config("robots", recipe.arm)
        urdf = file.parent / self.model.urdf
        root = urdf_root(urdf)
        hand = self.model.gripper.links[0]
        (joint,) = (joint for joint in root.findall("joint") if _child(joint) == hand)
        self._at_hand = origin_pose(joint, str(urdf))
        for element in below(root, hand):
            root.remove(element)
        root.remove(joint)
        super().__init__(root, urdf, recipe, base=self.model.base_link, flange=_parent(joint))

    @property
    def mount(self) -> Pose:
        """Pose of the gripper in the flange: that of the robot's own, then the recipe's."""
        return self._at_hand @ super().mount

    @property
    def stand(self) -> list[float]:
        """That of the robot."""
        return list(self.model.stand)

    @property
    def start(self) -> list[float]:
        """The recipe's, or else that of the robot."""
        return super().start or list(self.model.start)

    def own(self, name: str) -> str:
        """Return the robot's name of a link or joint."""
        return f"{self.recipe.name}_{name.removeprefix(f'{self.recipe.arm}_')}"

    def home(self, folder: Path) -> Iterable[float]:
        """Return joint positions at home that hold the tool where the robot's own gripper is at home."""
        return same_place(self.model, self.recipe.name, folder)

    def _shapes(self, link: Element, folder: Path) -> list[Element]:
        meshes = LinkMeshes(self.recipe.name, folder, self.path, {}, triangles=0, collision_m=0.0)
        parts = [part for pair in self.model.close_pairs if pair.other == link.get("name") for part in pair.parts]
        made = []
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None or (shape.tag == "collision" and parts):
                if mesh is None:
                    made.append(shape)
                continue
            inner = str(mesh.get("filename")).removeprefix(f"package://{self.path.parent.name}/")
            shutil.copy(self.path.parent / inner, folder / inner)
            mesh.set("filename", f"package://{self.recipe.name}/{inner}")
            made.append(shape)
        for part in parts:
            inner = f"collision/{Path(part).name}"
            shutil.copy(part, folder / inner)
            made.append(meshes.element("collision", inner))
        return made

    def values(self, tool: Gripper) -> dict[str, Any]:
        """Return the content of the robot's YAML file."""
        limits = {name: list(numbers) for name, numbers in asdict(self.model.limits).items()}
        self._require_home(list(zip(limits["lower"], limits["upper"], strict=True)))
        home = list(spread(self.recipe.home, len(self.joints), "home") if self.recipe.home else self.model.home)
        return self._file(tool, limits, home, list(self.model.motor_force), self.model.position_gain)


def _child(joint: Element) -> str:
    part = joint.find("child")
    return "" if part is None else str(part.get("link"))


def _parent(joint: Element) -> str:
    part = joint.find("parent")
    return "" if part is None else str(part.get("link"))


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.10g}" for value in values)


def _yaml(recipe: RobotRecipe, values: dict[str, Any]) -> str:
    comment = f"# {recipe.title or recipe.name} with the gripper {recipe.gripper}."
    if recipe.source:
        comment += f" Source: {recipe.source}."
    limits = f"limits are those of {recipe.arm}" if recipe.arm else ACCELERATIONS
    comment += f"\n# Written by `roboxim robot new`; {limits}.\n"
    rounded = {
        name: [round(v, 6) if isinstance(v, float) and math.isfinite(v) else v for v in value]
        if isinstance(value, list)
        else value
        for name, value in values.items()
    }
    return comment + str(yaml.safe_dump(rounded, sort_keys=False, default_flow_style=None, width=120))
