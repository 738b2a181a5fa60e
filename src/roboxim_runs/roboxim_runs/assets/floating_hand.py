"""A floating Panda hand that tries a grasp: it closes, lifts, and the object must come along."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pybullet

from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import GraspAnnotation, ObjectModel
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_sim import bodies, robot_body
from roboxim_sim.bullet import BulletClient

HAND_TO_TCP_M = 0.1034
"""Distance from the hand's frame to the tool centre point [m]."""
FINGER_Z_M = 0.0584
"""Distance from the hand's frame to the fingers' frames [m]."""
TIP = ((0.0175, 0.0152, 0.0185), (0.0, 0.00758, 0.04525))
"""Extents and middle of a fingertip's box in its finger's frame; the other finger's is its mirror image [m]."""
TIP_BEYOND_TCP_M = FINGER_Z_M + TIP[1][2] + TIP[0][2] / 2 - HAND_TO_TCP_M
"""How far the fingertips reach beyond the tool centre point [m]."""
HALF_TIP_M = 0.009
"""Half the fingertips' extent across the closing direction, rounded up [m]."""
CLEARANCE_M = 0.002
"""Gap between the fingertips and the table at a new grasp [m]."""
FORCE_N = 20.0
"""Force of a finger [N]."""
LIFT_M = 0.12
"""Height by which the hand lifts [m]."""
WIDE_M = 0.12
"""Objects wider than this on their shorter side must hang level, or the far edge tips over obstacles [m]."""
INSIDE_M = 1e-3
"""Depth to which the open hand may be inside the object or the table [m]."""
PLACE = (0.5, 0.0)
"""Where on the table the object stands [m]."""
BLOCKED = "the open "
"""How the reason begins of a grasp for which the open hand has no room."""
PARTS = {-1: "hand", 0: "left finger", 1: "right finger"}


def lowest_tip(position: npt.ArrayLike, axes: npt.ArrayLike) -> float:
    """Return the height of the lowest point of the fingertips at a grasp [m].

    Args:
        position: Tool centre point, shape (3,), z up [m].
        axes: Axes of the hand as columns, shape (3, 3): z is its approach, y the closing direction.
    """
    x, _, z = np.asarray(axes).T
    return float(np.asarray(position)[2] + TIP_BEYOND_TCP_M * min(0.0, z[2]) - HALF_TIP_M * abs(x[2]))


class FloatingHand:
    """The Panda's hand and fingertips on a moving anchor, with the simulator's own finger parameters."""

    def __init__(self, client: BulletClient, pose_tcp: Pose, opening_m: float) -> None:
        """Place the hand.

        Args:
            client: PyBullet client, see `roboxim_sim.bodies.configure`.
            pose_tcp: Pose of the tool centre point in the world.
            opening_m: Distance of the fingers [m].
        """
        self.client = client
        hand = {"halfExtents": [0.031, 0.1, 0.03], "collisionFramePosition": [0.0, 0.0, 0.035]}
        boxes = [client.createCollisionShape(pybullet.GEOM_BOX, **hand)]
        size, (x, y, z) = TIP
        for side in (1, -1):
            boxes.append(
                client.createCollisionShape(
                    pybullet.GEOM_BOX, halfExtents=[v / 2 for v in size], collisionFramePosition=[x, side * y, z]
                )
            )
        base = pose_tcp @ Pose(position=(0.0, 0.0, -HAND_TO_TCP_M))
        self.id = client.createMultiBody(
            2.0,
            boxes[0],
            basePosition=base.position,
            baseOrientation=base.quat_xyzw,
            linkMasses=[0.1, 0.1],
            linkCollisionShapeIndices=boxes[1:],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0.0, 0.0, FINGER_Z_M]] * 2,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * 2,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
            linkParentIndices=[0, 0],
            linkJointTypes=[pybullet.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
        )
        self.anchor = client.createConstraint(
            self.id, -1, -1, -1, pybullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], base.position,
            childFrameOrientation=base.quat_xyzw,
        )  # fmt: skip
        client.changeConstraint(self.anchor, maxForce=500.0)
        self.base = base
        for number in (0, 1):
            client.resetJointState(self.id, number, opening_m / 2)
            client.changeDynamics(
                self.id,
                number,
                lateralFriction=robot_body.FINGER_FRICTION,
                spinningFriction=robot_body.FINGER_SPINNING,
                frictionAnchor=1,
                contactStiffness=robot_body.FINGER_STIFFNESS,
                contactDamping=robot_body.FINGER_DAMPING,
                jointLowerLimit=0.0,
                jointUpperLimit=0.04,
            )
        gear = client.createConstraint(self.id, 0, self.id, 1, pybullet.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0])
        client.changeConstraint(gear, gearRatio=-1, erp=robot_body.GEAR_ERP, maxForce=robot_body.GEAR_FORCE_N)

    def inside(self, body: int) -> str:
        """Return the part of the hand that is inside a body; empty: none is."""
        for number, part in PARTS.items():
            near = self.client.getClosestPoints(self.id, body, 0.05, linkIndexA=number)
            if min((point[8] for point in near), default=1.0) <= -INSIDE_M:
                return part
        return ""

    def run(self, seconds: float, opening_m: float, way: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Move the hand along a straight line while its fingers go to an opening.

        Args:
            seconds: Duration [s].
            opening_m: Target distance of the fingers [m].
            way: Displacement [m].
        """
        start, steps = self.base, round(240 * seconds)
        for step in range(steps):
            x, y, z = np.add(start.position, np.multiply(way, (step + 1) / steps)).tolist()
            self.base = Pose(position=(x, y, z), quat_xyzw=start.quat_xyzw)
            self.client.changeConstraint(self.anchor, self.base.position, self.base.quat_xyzw, maxForce=500.0)
            for number in (0, 1):
                self.client.setJointMotorControl2(
                    self.id, number, pybullet.POSITION_CONTROL, targetPosition=opening_m / 2, force=FORCE_N,
                    positionGain=robot_body.FINGER_GAIN,
                )  # fmt: skip
            self.client.stepSimulation()


class Floating(Protocol):
    """A gripper that moves without an arm."""

    @property
    def id(self) -> int:
        """Its body."""
        ...

    def inside(self, body: int) -> str:
        """Return the part of the gripper that is inside a body; empty: none is."""
        ...

    def run(self, seconds: float, opening_m: float, way: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Move along a straight line while the fingers go to an opening."""
        ...


def try_grasp(
    client: BulletClient,
    model: ObjectModel,
    grasp: GraspAnnotation,
    make: Callable[[BulletClient, Pose, float], Floating] = FloatingHand,
) -> str:
    """Close a floating gripper on an object that stands on a table, and lift it.

    Args:
        client: PyBullet client; its world is emptied first.
        model: The object.
        grasp: The grasp.
        make: Makes the gripper at a pose of its tool centre point with an opening; the Franka hand by default.

    Returns:
        Why the grasp fails: the open hand is inside the object or the table, or the object is not lifted, turns or
        shifts in the hand. Empty: it holds.
    """
    bodies.configure(client, 240.0)
    names = bodies.build_table(client, TableSpec())
    pose = Pose(position=(*PLACE, model.rest_height))
    held = bodies.ObjectBody(client, model, EntitySpec(name="it", model=model.id, pose=pose))
    links = object_link_poses(model, {})
    hand = make(client, pose @ links[grasp.link or model.links[0].name] @ grasp.pose, grasp.opening_m)
    table = next(body for body, what in names.items() if what == "table")
    for body, other in ((held.id, "object"), (table, "table")):
        if part := hand.inside(body):
            return f"{BLOCKED}{part} is inside the {other}"
    hand.run(0.5, 0.0)
    hand.run(1.0, 0.0, (0.0, 0.0, LIFT_M))
    hand.run(0.5, 0.0)
    joints = held.read_joints()[0]
    end = held.read(joints, joints)[0].pose
    rose = end.position[2] - pose.position[2]
    if rose <= 0.6 * LIFT_M:
        return f"it rose by {rose:.3f} m only"
    turned = distance(Pose(quat_xyzw=pose.quat_xyzw), Pose(quat_xyzw=end.quat_xyzw))[1]
    if turned >= math.radians(12 if min(model.size[:2]) > WIDE_M else 30):
        return f"it turned by {math.degrees(turned):.0f} deg in the hand"
    shift = math.hypot(end.position[0] - PLACE[0], end.position[1] - PLACE[1])
    return f"it moved by {shift:.3f} m in the hand" if shift >= 0.03 else ""
