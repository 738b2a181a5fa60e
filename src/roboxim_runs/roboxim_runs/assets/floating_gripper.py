"""A floating gripper of any kind that tries a grasp: a gripper of ``config/grippers`` on three prismatic joints.

It is a separate robot, so its fingers, motors and contacts are those of the simulator's arms
(`roboxim_sim.robot_body`). The Franka hand has a simpler one, see `roboxim_runs.assets.floating_hand`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import JointLimits, RobotModel
from roboxim_core.poses import Pose
from roboxim_core.specs import RobotSpec
from roboxim_runs.assets.floating_hand import Floating, FloatingHand
from roboxim_runs.robots.grippers import gripper, mounted
from roboxim_sim.bullet import BulletClient, bullet_client
from roboxim_sim.robot_body import RobotBody

FRANKA_HAND = "franka_hand"
"""The gripper of `FloatingHand`."""
AXES = ("1 0 0", "0 1 0", "0 0 1")
REACH_M = 0.5
"""How far each of the three joints goes either way [m]."""
FORCE_N = 500.0
"""Force of each of them [N]."""
GAIN = 0.3
"""Position gain of each of them."""
INSIDE_M = 1e-3
"""Depth to which the open gripper may be inside something [m]."""


def floating(name: str) -> Callable[[BulletClient, Pose, float], Floating]:
    """Return what makes a gripper's floating form at a pose of its tool centre point with an opening.

    Args:
        name: Name in ``config/grippers``.
    """
    return FloatingHand if name == FRANKA_HAND else partial(FloatingGripper, name)


class FloatingGripper:
    """A gripper that moves without an arm."""

    def __init__(self, name: str, client: BulletClient, pose_tcp: Pose, opening_m: float) -> None:
        """Place the gripper.

        Args:
            name: Name in ``config/grippers``.
            client: PyBullet client, see `roboxim_sim.bodies.configure`.
            pose_tcp: Pose of the tool centre point in the world.
            opening_m: Distance of the fingers [m].
        """
        self.client = client
        self._model = gantry(name)
        base = pose_tcp @ _tcp_in_base(name).inverse()
        self._turn = base.rotation.inv()
        self._joints = np.zeros(3)
        self._widest_m = self._model.gripper.max_opening_m
        spec = RobotSpec(model=name, pose=base, gripper_opening=min(1.0, opening_m / self._widest_m))
        self._body = RobotBody(client, self._model, spec, (0.0, 0.0, 0.0))
        self.id = self._body.id

    def inside(self, body: int) -> str:
        """Return the link of the gripper that is inside a body; empty: none is."""
        near = self.client.getClosestPoints(self.id, body, 0.0)
        deepest = min(near, key=lambda point: point[8], default=None)
        if deepest is None or deepest[8] > -INSIDE_M:
            return ""
        return self._body.link_names[deepest[3]].replace("_", " ")

    def run(self, seconds: float, opening_m: float, way: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Move the gripper along a straight line while its fingers go to an opening.

        Args:
            seconds: Duration [s].
            opening_m: Target distance of the fingers [m].
            way: Displacement in the world [m].
        """
        start, steps = self._joints, round(240 * seconds)
        along = self._turn.apply(way)
        for step in range(steps):
            self._joints = start + along * (step + 1) / steps
            self._body.drive_arm(self._joints.tolist(), (along / seconds).tolist())
            self._body.drive_gripper(opening_m / self._widest_m)
            self.client.stepSimulation()
            self._body.after_step()


@lru_cache(maxsize=8)
def gantry(name: str) -> RobotModel:
    """Return a robot that is a gripper on three prismatic joints.

    Args:
        name: Name in ``config/grippers``.

    Raises:
        ConfigError: When there is no such gripper.
    """
    tool = gripper(name)
    if tool.gripper.one_jaw:
        raise ConfigError(f"gripper '{name}' has one moving jaw; grasps are searched with two: take another gripper")
    held = tempfile.TemporaryDirectory(prefix="roboxim-gripper-")
    _KEPT.append(held)
    folder = Path(held.name) / "gantry"
    for part in ("visual", "collision"):
        (folder / part).mkdir(parents=True)
    root = ElementTree.Element("robot", {"name": "gantry"})
    links = ["base", "along_x", "along_y", tool.root.removeprefix(tool.prefix)]
    for link in links[:3]:
        element = ElementTree.SubElement(ElementTree.SubElement(root, "link", {"name": link}), "inertial")
        ElementTree.SubElement(element, "mass", {"value": "1"})
        ElementTree.SubElement(element, "inertia", {"ixx": "0.01", "iyy": "0.01", "izz": "0.01"} | _NO_PRODUCTS)
    joints = tuple(f"joint_{axis}" for axis in "xyz")
    for joint, axis, parent, child in zip(joints, AXES, links, links[1:], strict=False):
        element = ElementTree.SubElement(root, "joint", {"name": joint, "type": "prismatic"})
        ElementTree.SubElement(element, "parent", {"link": parent})
        ElementTree.SubElement(element, "child", {"link": child})
        ElementTree.SubElement(element, "axis", {"xyz": axis})
        limits = {"lower": str(-REACH_M), "upper": str(REACH_M), "effort": str(FORCE_N), "velocity": "10"}
        ElementTree.SubElement(element, "limit", limits)
    root.extend(mounted(tool, "gantry", folder, lambda own: own))
    urdf = folder / "gantry.urdf"
    ElementTree.ElementTree(root).write(urdf, encoding="utf-8")
    many = (1.0, 1.0, 1.0)
    return RobotModel(
        id=name, urdf=urdf, srdf=urdf, base_link="base", tcp_link=tool.tcp.removeprefix(tool.prefix),
        joint_names=joints, gripper=tool.model(lambda own: own), home=(0.0, 0.0, 0.0), position_gain=GAIN,
        motor_force=(FORCE_N,) * 3, rotations=0,
        limits=JointLimits(
            lower=(-REACH_M,) * 3, upper=(REACH_M,) * 3, velocity=many, acceleration=many, jerk=many,
            effort=(FORCE_N,) * 3,
        ),
    )  # fmt: skip


_NO_PRODUCTS = {"ixy": "0", "ixz": "0", "iyz": "0"}
_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""Temporary folders, kept until the process ends."""


@lru_cache(maxsize=8)
def _tcp_in_base(name: str) -> Pose:
    """Return the pose of the tool centre point in the base of a gripper's robot, with its joints at 0."""
    model = gantry(name)
    with bullet_client() as client:
        body = RobotBody(client, model, RobotSpec(model=name), (0.0, 0.0, 0.0))
        link = next(number for number, link in body.link_names.items() if link == model.tcp_link)
        position, turn = client.getLinkState(body.id, link, computeForwardKinematics=True)[4:6]
        return Pose(position=tuple(position), quat_xyzw=tuple(turn))
