"""A floating gripper executes every annotated grasp: it closes and lifts, and the object must come along."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pybullet
import pytest

from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_sim import bodies
from roboxim_sim.bullet import BulletClient

LIBRARY = ModelLibrary()
HAND_TO_TCP_M = 0.1034
FINGER_Z_M = 0.0584
TIP = ((0.0175, 0.0152, 0.0185), (0.0, 0.00758, 0.04525))
"""Extents and middle of a fingertip's box in its finger's frame; the other finger's is its mirror image [m]."""
LIFT_M = 0.12
WIDE_M = 0.12
"""Objects wider than this on their shorter side must hang level, or the far edge tips over obstacles [m]."""


def cases() -> list[tuple[str, str, str, int]]:
    found = []
    for object_id in LIBRARY.object_ids:
        size = LIBRARY.object_modifiers(object_id).get("size")
        for word in size.factors if size else [""]:
            grasps = LIBRARY.object(object_id).grasps
            found += [(object_id, word, grasp.name, k) for k, grasp in enumerate(grasps)]
    return found


class FloatingGripper:
    """The Panda's hand and fingertips on a moving anchor, with the simulator's own finger parameters."""

    def __init__(self, client: BulletClient, pose_tcp: Pose, opening_m: float) -> None:
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
                lateralFriction=bodies.FINGER_FRICTION,
                spinningFriction=bodies.FINGER_SPINNING,
                frictionAnchor=1,
                contactStiffness=bodies.FINGER_STIFFNESS,
                contactDamping=bodies.FINGER_DAMPING,
                jointLowerLimit=0.0,
                jointUpperLimit=0.04,
            )
        gear = client.createConstraint(self.id, 0, self.id, 1, pybullet.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0])
        client.changeConstraint(gear, gearRatio=-1, erp=bodies.GEAR_ERP, maxForce=bodies.GEAR_FORCE_N)

    def run(self, seconds: float, opening_m: float, way: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        start, steps = self.base, round(240 * seconds)
        for step in range(steps):
            x, y, z = np.add(start.position, np.multiply(way, (step + 1) / steps)).tolist()
            self.base = Pose(position=(x, y, z), quat_xyzw=start.quat_xyzw)
            self.client.changeConstraint(self.anchor, self.base.position, self.base.quat_xyzw, maxForce=500.0)
            for number in (0, 1):
                self.client.setJointMotorControl2(
                    self.id, number, pybullet.POSITION_CONTROL, targetPosition=opening_m / 2, force=20.0,
                    positionGain=bodies.FINGER_GAIN,
                )  # fmt: skip
            self.client.stepSimulation()


@pytest.fixture(scope="module")
def client() -> Iterator[BulletClient]:
    made = BulletClient()
    yield made
    made.disconnect()


@pytest.mark.slow
@pytest.mark.parametrize(("object_id", "size", "name", "index"), cases())
def test_a_grasp_holds(object_id: str, size: str, name: str, index: int, client: BulletClient) -> None:
    model = LIBRARY.object(object_id, {"size": size} if size else {})
    grasp = model.grasps[index]
    bodies.configure(client, 240.0)
    names = bodies.build_table(client, TableSpec())
    pose = Pose(position=(0.5, 0.0, model.rest_height))
    held = bodies.ObjectBody(client, model, EntitySpec(name="it", model=object_id, pose=pose))
    links = object_link_poses(model, {})
    gripper = FloatingGripper(client, pose @ links[grasp.link or model.links[0].name] @ grasp.pose, grasp.opening_m)
    table = next(body for body, what in names.items() if what == "table")
    for number, what in ((-1, "hand"), (0, "left finger"), (1, "right finger")):
        for body, other in ((held.id, object_id), (table, "table")):
            near = client.getClosestPoints(gripper.id, body, 0.05, linkIndexA=number)
            assert min((point[8] for point in near), default=1.0) > -1e-3, f"the open {what} is inside the {other}"
    gripper.run(0.5, 0.0)
    gripper.run(1.0, 0.0, (0.0, 0.0, LIFT_M))
    gripper.run(0.5, 0.0)
    joints = held.read_joints()[0]
    end = held.read(joints, joints)[0].pose
    rose = end.position[2] - pose.position[2]
    turned = distance(Pose(quat_xyzw=pose.quat_xyzw), Pose(quat_xyzw=end.quat_xyzw))[1]
    assert rose > 0.6 * LIFT_M, f"it rose by {rose:.3f} m only"
    most_deg = 12 if min(model.size[:2]) > WIDE_M else 30
    assert turned < math.radians(most_deg), f"it turned by {math.degrees(turned):.0f} deg in the hand"
    assert np.hypot(end.position[0] - 0.5, end.position[1]) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("part", ["top", "middle", "bottom"])
def test_a_handle_opens_and_closes_its_drawer(part: str, index: int, client: BulletClient) -> None:
    model = LIBRARY.object("cabinet")
    handle = next(handle for handle in model.handles if handle.name == part)
    grasp = handle.grasps[index]
    bodies.configure(client, 240.0)
    names = bodies.build_table(client, TableSpec())
    pose = Pose(position=(0.4, 0.0, model.rest_height))
    cabinet = bodies.ObjectBody(client, model, EntitySpec(name="it", model="cabinet", pose=pose, fixed=True))
    gripper = FloatingGripper(client, pose @ object_link_poses(model, {})[grasp.link] @ grasp.pose, grasp.opening_m)
    table = next(body for body, what in names.items() if what == "table")
    for number in (-1, 0, 1):
        for body in (cabinet.id, table):
            near = client.getClosestPoints(gripper.id, body, 0.05, linkIndexA=number)
            assert min((point[8] for point in near), default=1.0) > -1e-3, "the open gripper is inside something"
    out = (pose.rotation * handle.pose.rotation).apply([0.13, 0.0, 0.0])
    gripper.run(0.4, 0.0)
    gripper.run(1.5, 0.0, tuple(out))
    others = [k for k, name in enumerate(cabinet.joint_names) if name != handle.joint]
    own = cabinet.joint_names.index(handle.joint)
    assert cabinet.read_joints()[0][own] > 0.11
    assert max(cabinet.read_joints()[0][k] for k in others) < 0.01
    gripper.run(1.5, 0.0, tuple(-out))
    assert cabinet.read_joints()[0][own] < 0.02
