"""Arms as their makers describe them: meshes, allowed pairs and limits that do not come from this repository.

Meshes and joints are those of the ``example-robot-data`` wheel; each arm says where its limits come from. UR5 and
xArm 7 carry the Panda's hand of the same wheel, mounted on the flange as ``config/robots`` mounts it. The Panda's
allowed pairs are those of its SRDF. UR5 and xArm 7 may touch only where links are joined or always touch: UR5's SRDF in
the wheel allows the forearm to run into the wrist.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cmeel
import numpy as np
import numpy.typing as npt
import pinocchio as pin

Array = npt.NDArray[np.float64]
DATA = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots"
SOURCE = DATA / "panda_description"
PACKAGES = [str(DATA.parents[1])]
HAND = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
FINGERS_M = 0.04
SAMPLES = 400


@dataclass(frozen=True, kw_only=True, eq=False)
class Machine:
    """An arm with the Panda's hand, fingers fully open."""

    name: str
    """As in ``config/robots``."""
    urdf: Path
    """The maker's description."""
    flange: str = ""
    """Frame that carries the hand, aligned with it; empty: the description has the hand."""
    lower: Array
    """Lower ends of the joints [rad]."""
    upper: Array
    """Upper ends of the joints [rad]."""
    velocity: Array
    """Limits [rad/s]."""
    acceleration: Array
    """Limits [rad/s^2]."""
    jerk: Array
    """Limits [rad/s^3]."""
    convex: bool = False
    """Whether each mesh fills its convex hull, so that overlapping hulls are a collision."""

    @property
    def dof(self) -> int:
        """Number of the arm's joints."""
        return len(self.lower)

    def full(self, joints: Array) -> Array:
        """Return the model's configuration for an arm configuration of shape (dof,)."""
        return np.concatenate([joints, [FINGERS_M, FINGERS_M]])


_PANDA_ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
MACHINES = {
    machine.name: machine
    for machine in (
        # https://frankaemika.github.io/docs/control_parameters.html
        Machine(
            name="panda",
            urdf=SOURCE / "urdf/panda.urdf",
            lower=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
            upper=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
            velocity=np.array([2.175] * 4 + [2.61] * 3),
            acceleration=_PANDA_ACCELERATION,
            jerk=500.0 * _PANDA_ACCELERATION,
            convex=True,
        ),
        # Speed: UR's data sheet, 180 degrees/s. Acceleration: ur_moveit_config, in 50 ms. Half of the joints' range.
        Machine(
            name="ur5",
            urdf=DATA / "ur_description/urdf/ur5_joint_limited_robot.urdf",
            flange="tool0",
            lower=np.full(6, -np.pi),
            upper=np.full(6, np.pi),
            velocity=np.full(6, np.pi),
            acceleration=np.full(6, 5.0),
            jerk=np.full(6, 100.0),
        ),
        # Speed and ranges: the URDF's. Acceleration: the user manual's 1145 degrees/s^2, reached in 50 ms.
        Machine(
            name="xarm7",
            urdf=DATA / "xarm_description/urdf/xarm7.urdf",
            flange="link_eef",
            lower=np.array([-np.pi, -2.059, -np.pi, -0.19198, -np.pi, -1.69297, -np.pi]),
            upper=np.array([np.pi, 2.0944, np.pi, 3.927, np.pi, np.pi, np.pi]),
            velocity=np.full(7, 3.14),
            acceleration=np.full(7, 20.0),
            jerk=np.full(7, 400.0),
        ),
    )
}


def machine(name: str) -> Machine:
    """Return an arm by name.

    Raises:
        ValueError: When no description of that arm is known here.
    """
    if name not in MACHINES:
        raise ValueError(f"no referee for the robot '{name}'; there is one for {', '.join(MACHINES)}")
    return MACHINES[name]


@cache
def model_of(name: str) -> pin.Model:
    """Return an arm's kinematic model; the fingers are its last two joints."""
    arm = machine(name)
    model = pin.buildModelFromUrdf(str(arm.urdf))
    if not arm.flange:
        return model
    hand = pin.buildModelFromXML(_hand_urdf())
    return pin.appendModel(model, hand, model.getFrameId(arm.flange), pin.SE3.Identity())


def geometry_of(name: str) -> pin.GeometryModel:
    """Return the collision meshes of an arm and its hand with the pairs to check."""
    arm = machine(name)
    bare = pin.buildModelFromUrdf(str(arm.urdf))
    geometry = pin.buildGeomFromUrdf(bare, str(arm.urdf), pin.GeometryType.COLLISION, package_dirs=PACKAGES)
    if arm.flange:
        hand = pin.buildModelFromXML(_hand_urdf())
        meshes = pin.buildGeomFromUrdfString(hand, _hand_urdf(), pin.GeometryType.COLLISION, package_dirs=PACKAGES)
        _, geometry = pin.appendModel(bare, hand, geometry, meshes, bare.getFrameId(arm.flange), pin.SE3.Identity())
    geometry.removeAllCollisionPairs()
    geometry.addAllCollisionPairs()
    pin.removeCollisionPairs(model_of(name), geometry, str(SOURCE / "srdf/panda.srdf"))
    if arm.flange:
        for pair in {*_joined(arm, geometry), *_always_touching(arm, geometry)}:
            geometry.removeCollisionPair(pin.CollisionPair(*pair))
    return geometry


def _joined(arm: Machine, geometry: pin.GeometryModel) -> list[tuple[int, int]]:
    """Return the pairs of links that a joint or a mount connects."""
    parents = model_of(arm.name).parents
    found = []
    for pair in geometry.collisionPairs:
        first, second = geometry.geometryObjects[pair.first], geometry.geometryObjects[pair.second]
        joints = first.parentJoint, second.parentJoint
        neighbours = parents[joints[0]] == joints[1] or parents[joints[1]] == joints[0]
        hand = first.name.startswith(HAND) or second.name.startswith(HAND)
        if joints[0] == joints[1] or (neighbours and not hand):
            found.append((pair.first, pair.second))
    return found


def _always_touching(arm: Machine, geometry: pin.GeometryModel) -> list[tuple[int, int]]:
    """Return the pairs that touch in every one of many states: parts mounted on each other, which no SRDF lists."""
    model = model_of(arm.name)
    data, placed = model.createData(), geometry.createData()
    hits = np.zeros(len(geometry.collisionPairs), int)
    for joints in np.random.default_rng(0).uniform(arm.lower, arm.upper, (SAMPLES, arm.dof)):
        pin.computeCollisions(model, data, geometry, placed, arm.full(joints), False)
        hits += [result.isCollision() for result in placed.collisionResults]
    pairs = [(pair.first, pair.second) for pair in geometry.collisionPairs]
    return [pair for pair, count in zip(pairs, hits, strict=True) if count == SAMPLES]


@cache
def _hand_urdf() -> str:
    """Return the description of the Panda's hand alone."""
    root = ElementTree.parse(SOURCE / "urdf/panda.urdf").getroot()
    links = {*HAND, "panda_hand_tcp"}
    for item in list(root):
        child = item.find("child")
        keep = (
            item.get("name") in links
            if item.tag == "link"
            else child is not None and child.get("link") in links - {"panda_hand"}
        )
        if not keep:
            root.remove(item)
    return ElementTree.tostring(root, encoding="unicode")
