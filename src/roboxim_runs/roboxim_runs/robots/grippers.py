"""Grippers that `roboxim robot new` mounts on an arm."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from roboxim_core.config import named_config
from roboxim_core.errors import ConfigError, one_of

Element = ElementTree.Element


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A gripper as part of another robot's description."""

    robot: str
    """Robot of ``config/robots`` that has it."""
    root: str
    """Its root link; the root's parent joint is replaced by the mount."""
    tcp: str
    """Frame of the tool centre point."""
    joints: tuple[str, ...]
    """Finger joints."""
    links: tuple[str, ...]
    """Links that may touch a held object; the hand first."""
    prefix: str
    """Prefix of all its names, replaced by the arm's."""
    max_opening_m: float
    """Total opening [m]."""
    force_n: float
    """Force of each finger [N]."""
    speed_m_s: float
    """Speed of each finger [m/s]."""


GRIPPERS = {
    "franka_hand": Gripper(
        robot="panda",
        root="panda_hand",
        tcp="panda_hand_tcp",
        joints=("panda_finger_joint1", "panda_finger_joint2"),
        links=("panda_hand", "panda_leftfinger", "panda_rightfinger"),
        prefix="panda_",
        max_opening_m=0.08,
        force_n=20.0,
        speed_m_s=0.1,
    )
}
"""Grippers by name."""


def gripper(name: str) -> Gripper:
    """Return a gripper.

    Raises:
        ConfigError: When there is none of that name.
    """
    if name not in GRIPPERS:
        raise ConfigError(f"no gripper '{name}'; {one_of(GRIPPERS, name)}")
    return GRIPPERS[name]


def mounted(tool: Gripper, robot: str, folder: Path, rename: Callable[[str], str]) -> list[Element]:
    """Return a gripper's links and joints for another robot, and copy its meshes into that robot's folder.

    Args:
        tool: The gripper.
        robot: Id of the robot.
        folder: The robot's folder; meshes go to ``visual`` and ``collision`` there.
        rename: Maps names without prefix to the robot's.
    """
    source = named_config("robots", tool.robot).parent / tool.robot
    root = ElementTree.parse(source / f"{tool.robot}.urdf").getroot()
    joints = {joint.find("child").get("link"): joint for joint in root.findall("joint")}  # type: ignore[union-attr]
    kept = []

    def below(link: str) -> bool:
        while link != tool.root:
            if link not in joints:
                return False
            link = str(joints[link].find("parent").get("link"))  # type: ignore[union-attr]
        return True

    for element in [*root.findall("link"), *root.findall("joint")]:
        link = str(element.get("name") if element.tag == "link" else element.find("child").get("link"))  # type: ignore[union-attr]
        if below(link) and not (element.tag == "joint" and link == tool.root):
            kept.append(element)
    for element in kept:
        for part in element.iter():
            for key in ("name", "link", "joint"):
                if str(part.get(key, "")).startswith(tool.prefix):
                    part.set(key, rename(str(part.get(key)).removeprefix(tool.prefix)))
            if part.tag == "mesh":
                inner = str(part.get("filename")).removeprefix(f"package://{tool.robot}/")
                shutil.copy(source / inner, folder / inner)
                part.set("filename", f"package://{robot}/{inner}")
    return kept
