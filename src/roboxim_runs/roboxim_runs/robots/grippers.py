"""Grippers, which `roboxim robot new` mounts on an arm: each is a YAML file of ``config/grippers``."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

from roboxim_core.config import load_config, named_config
from roboxim_core.errors import ConfigError
from roboxim_core.models.description import GripperModel

Element = ElementTree.Element


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper: a YAML file of ``config/grippers``, with names as in its URDF."""

    urdf: Path
    """URDF that has it, relative to the file; its meshes are ``package://<name of the URDF's folder>/...``."""
    root: str
    """Its root link: z points out of the flange, and the fingers open along y. A joint above it is replaced."""
    tcp: str
    """Frame of the tool centre point, as of a robot."""
    prefix: str = ""
    """Prefix of all its names, replaced by the robot's."""
    gripper: GripperModel
    """Fingers, opening, force and speed."""

    def model(self, rename: Callable[[str], str]) -> GripperModel:
        """Return the gripper of a robot, given how names without prefix become the robot's."""

        def own(name: str) -> str:
            return rename(name.removeprefix(self.prefix))

        return replace(
            self.gripper,
            joint_names=tuple(map(own, self.gripper.joint_names)),
            links=tuple(map(own, self.gripper.links)),
            followers=tuple(
                replace(follower, name=own(follower.name), leader=own(follower.leader))
                for follower in self.gripper.followers
            ),
        )


def gripper(name: str) -> Gripper:
    """Return a gripper.

    Args:
        name: Name in ``config/grippers``, or a YAML file.

    Raises:
        ConfigError: When there is none of that name, or its file is invalid.
    """
    file = named_config("grippers", name)
    tool = load_config(file, Gripper)
    urdf = (file.parent / tool.urdf).resolve()
    if not urdf.is_file():
        raise ConfigError(f"{file}: urdf: no such file: {urdf}")
    return replace(tool, urdf=urdf)


def below(root: Element, link: str) -> list[Element]:
    """Return the links and joints of a URDF from a link on, without the joint above it."""
    above = {joint.find("child").get("link"): joint for joint in root.findall("joint")}  # type: ignore[union-attr]

    def inside(name: str) -> bool:
        while name != link:
            if name not in above:
                return False
            name = str(above[name].find("parent").get("link"))  # type: ignore[union-attr]
        return True

    links = [element for element in root.findall("link") if inside(str(element.get("name")))]
    return [*links, *(joint for child, joint in above.items() if child != link and inside(str(child)))]


def mounted(tool: Gripper, robot: str, folder: Path, rename: Callable[[str], str]) -> list[Element]:
    """Return a gripper's links and joints for another robot, and copy its meshes into that robot's folder.

    Args:
        tool: The gripper.
        robot: Id of the robot.
        folder: The robot's folder; meshes go to ``visual`` and ``collision`` there.
        rename: Maps names without prefix to the robot's.
    """
    kept = below(ElementTree.parse(tool.urdf).getroot(), tool.root)
    for element in kept:
        for part in element.iter():
            for key in ("name", "link", "joint"):
                if part.get(key) and part.tag in ("link", "joint", "parent", "child", "mimic"):
                    part.set(key, rename(str(part.get(key)).removeprefix(tool.prefix)))
            if part.tag == "mesh":
                inner = str(part.get("filename")).removeprefix(f"package://{tool.urdf.parent.name}/")
                shutil.copy(tool.urdf.parent / inner, folder / inner)
                part.set("filename", f"package://{robot}/{inner}")
    return kept
