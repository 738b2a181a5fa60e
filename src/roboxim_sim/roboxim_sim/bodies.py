"""The objects and the table as PyBullet bodies, built from the shared models.

The constants below were tuned together for grasps that hold at 240 Hz; each comes with its reason. The bodies have no
visual shapes: the renderers have their own meshes, and loading visual shapes would take most of a reset.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.errors import ConfigError, ErrorCode, SimError
from roboxim_core.models.description import MAX_SHAPES, JointModel, LinkModel, ObjectModel, Shape
from roboxim_core.models.visuals import FLOOR_Z
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_core.state import EntityState
from roboxim_sim.bullet import BulletClient, pybullet

if TYPE_CHECKING:
    import trimesh

SOLVER_ITERATIONS = 50
"""More iterations or a higher physics rate gain nothing measurable."""
SPRING_GAIN = 0.1
"""Position gain of a joint that springs back: it returns within about 0.1 s without bouncing."""


def configure(client: BulletClient, rate_hz: float) -> None:
    """Empty the world and set the physics parameters.

    Args:
        client: PyBullet client.
        rate_hz: Physics steps per second.
    """
    client.resetSimulation()
    client.setGravity(0.0, 0.0, -9.81)
    client.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / rate_hz, numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
    )


def build_table(client: BulletClient, table: TableSpec) -> dict[int, str]:
    """Build the table and the floor.

    Returns:
        Names by body id.
    """
    x, y, z = table.center
    wide, deep, thick = table.size
    shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[wide / 2, deep / 2, thick / 2])
    top = client.createMultiBody(0.0, shape, basePosition=[x, y, z - thick / 2])
    plane = client.createCollisionShape(pybullet.GEOM_PLANE)
    floor = client.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, FLOOR_Z])
    for body in (top, floor):
        client.changeDynamics(body, -1, lateralFriction=table.friction, restitution=0.0)
    return {top: "table", floor: "floor"}


class ObjectBody:
    """An object in PyBullet.

    PyBullet computes the inertia of a link: exactly of one box, sphere or cylinder; of several shapes, a capsule or a
    hull it takes that of a solid box around them.
    """

    def __init__(self, client: BulletClient, model: ObjectModel, entity: EntitySpec) -> None:
        """Build an object.

        Args:
            client: PyBullet client.
            model: The object, with its modifiers.
            entity: The object's name, pose and joint positions.
        """
        self._client, self.name, self.model = client, entity.name, model
        joints = _parents_first(model)
        links = {link.name: link for link in model.links}
        order = [model.links[0].name, *(joint.child for joint in joints)]
        self.link_names = {number - 1: name for number, name in enumerate(order)}
        self.link_names[-1] = ""
        centers = [_center_of_mass(links[name]) for name in order]
        shapes = [_collision_shape(client, links[name].collision) for name in order]
        kinds = {"prismatic": pybullet.JOINT_PRISMATIC, "revolute": pybullet.JOINT_REVOLUTE}
        count = len(joints)
        self._center = Pose(position=centers[0])
        start = entity.pose @ self._center if self._center != IDENTITY else entity.pose
        self.id = client.createMultiBody(
            baseMass=0.0 if entity.fixed else model.links[0].mass,
            baseCollisionShapeIndex=shapes[0],
            basePosition=entity.pose.position,
            baseOrientation=entity.pose.quat_xyzw,
            baseInertialFramePosition=centers[0],
            linkMasses=[links[joint.child].mass for joint in joints],
            linkCollisionShapeIndices=shapes[1:],
            linkVisualShapeIndices=[-1] * count,
            linkPositions=[joint.pose.position for joint in joints],
            linkOrientations=[joint.pose.quat_xyzw for joint in joints],
            linkInertialFramePositions=centers[1:],
            linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)] * count,
            linkParentIndices=[order.index(joint.parent) for joint in joints],
            linkJointTypes=[kinds[joint.kind] for joint in joints],
            linkJointAxis=[joint.axis for joint in joints],
        )
        client.resetBasePositionAndOrientation(self.id, start.position, start.quat_xyzw)
        friction = model.friction
        for number, name in enumerate(order, -1):
            client.changeDynamics(
                self.id,
                number,
                lateralFriction=friction.lateral,
                spinningFriction=friction.spinning,
                rollingFriction=friction.rolling if _can_roll(links[name]) else 0.0,
                restitution=0.0,
            )
        self.joint_names = tuple(joint.name for joint in joints)
        for number, joint in enumerate(joints):
            self._prepare_joint(number, joint, entity.joint_positions.get(joint.name, 0.0))

    def set_state(
        self,
        pose: Pose | None = None,
        linear: Sequence[float] = (0.0, 0.0, 0.0),
        angular: Sequence[float] = (0.0, 0.0, 0.0),
        joint_positions: dict[str, float] | None = None,
    ) -> None:
        """Set the base's pose and velocities in the world and the joint positions [m or rad].

        The linear velocity is that of the base's centre of mass [m/s].
        """
        if pose is not None:
            base = pose @ self._center if self._center != IDENTITY else pose
            self._client.resetBasePositionAndOrientation(self.id, base.position, base.quat_xyzw)
            self._client.resetBaseVelocity(self.id, linear, angular)
        for name, position in (joint_positions or {}).items():
            self._client.resetJointState(self.id, self.joint_names.index(name), position)

    def read_joints(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return positions [m or rad] and velocities [m/s or rad/s] of the joints."""
        if not self.joint_names:
            return (), ()
        states = self._client.getJointStates(self.id, range(len(self.joint_names)))
        return tuple(s[0] for s in states), tuple(s[1] for s in states)

    def read(
        self, lowest: tuple[float, ...], highest: tuple[float, ...], fastest_fall: float = 0.0
    ) -> tuple[EntityState, tuple[float, ...]]:
        """Return the state and the joint velocities.

        Args:
            lowest: Lowest joint positions during the tick [m or rad].
            highest: Highest joint positions during the tick [m or rad].
            fastest_fall: Largest downward speed of the base's centre of mass during the tick [m/s].
        """
        position, quat = self._client.getBasePositionAndOrientation(self.id)
        linear, angular = self._client.getBaseVelocity(self.id)
        pose = Pose(position=position, quat_xyzw=quat)
        if self._center != IDENTITY:
            pose = pose @ self._center.inverse()
        joints, speeds = self.read_joints()
        state = EntityState(
            name=self.name,
            pose=pose,
            linear_velocity=linear,
            angular_velocity=angular,
            fastest_fall=fastest_fall,
            joint_names=self.joint_names,
            joint_positions=joints,
            joint_lowest=lowest,
            joint_highest=highest,
        )
        return state, speeds

    def _prepare_joint(self, number: int, joint: JointModel, position: float) -> None:
        self._client.changeDynamics(
            self.id, number, jointLowerLimit=joint.lower, jointUpperLimit=joint.upper, jointDamping=joint.damping
        )
        self._client.resetJointState(self.id, number, position)
        # Every joint gets a motor of known force, because PyBullet's default motor resists strongly.
        if joint.spring > 0:
            self._client.setJointMotorControl2(
                self.id,
                number,
                pybullet.POSITION_CONTROL,
                targetPosition=0.0,
                force=joint.spring,
                positionGain=SPRING_GAIN,
            )
        else:
            self._client.setJointMotorControl2(
                self.id, number, pybullet.VELOCITY_CONTROL, targetVelocity=0.0, force=joint.resistance
            )


_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""Temporary folders, kept until the process ends."""


def _parents_first(model: ObjectModel) -> list[JointModel]:
    known, ordered, pending = {model.links[0].name}, [], list(model.joints)
    while pending:
        ready = [joint for joint in pending if joint.parent in known]
        if not ready:
            raise ConfigError(f"object '{model.id}': joints {[j.name for j in pending]} do not lead to the base")
        ordered += ready
        known |= {joint.child for joint in ready}
        pending = [joint for joint in pending if joint not in ready]
    return ordered


def _can_roll(link: LinkModel) -> bool:
    """Return whether a link has round shapes; rolling friction has no effect on other shapes and only costs time."""
    return any(shape.kind != "box" for shape in link.collision)


def _center_of_mass(link: LinkModel) -> tuple[float, float, float]:
    """Return the centre of mass of the volumes [m]."""
    volumes = np.array([_volume(shape) for shape in link.collision])
    centers = np.array([shape.pose.apply(_hull(shape.mesh).center_mass * shape.scale) if shape.kind == "hull"
                        else shape.pose.position for shape in link.collision])  # fmt: skip
    x, y, z = (volumes @ centers / volumes.sum()).tolist() if len(volumes) else (0.0, 0.0, 0.0)
    return x, y, z


def _volume(shape: Shape) -> float:
    size = shape.size
    if shape.kind == "box":
        return float(np.prod(size))
    if shape.kind == "sphere":
        return float(4 / 3 * np.pi * size[0] ** 3)
    if shape.kind == "hull":
        return float(_hull(shape.mesh).volume * shape.scale**3)
    ends = 4 / 3 * size[0] if shape.kind == "capsule" else 0.0
    return float(np.pi * size[0] ** 2 * (size[1] + ends))


@lru_cache(maxsize=64)
def _hull(path: str) -> trimesh.Trimesh:
    import trimesh

    hull: trimesh.Trimesh = trimesh.load_mesh(path).convex_hull
    return hull


MESH_MARGIN_M = 0.001
"""Margin that PyBullet adds to the convex parts of a mesh on every side [m]. Hulls of objects keep it: they collide
that much too far out, and recorded states depend on it."""


def _with_boxes_in_a_file(shapes: Sequence[Shape]) -> list[Shape]:
    """Return the same geometry with fewer shapes: the boxes become convex parts of one mesh file."""
    boxes = tuple(shape for shape in shapes if shape.kind == "box")
    others = [shape for shape in shapes if shape.kind != "box"]
    return [*others, Shape(kind="hull", mesh=_boxes_file(boxes))]


@lru_cache(maxsize=256)
def _boxes_file(boxes: tuple[Shape, ...]) -> str:
    """Write an OBJ file with one object for each box, shrunk by the margin, and return its path."""
    import trimesh

    lines: list[str] = []
    for number, box in enumerate(boxes):
        half = np.maximum(np.asarray(box.size) / 2 - MESH_MARGIN_M, 1e-4)
        solid = trimesh.creation.box(extents=2 * half)
        lines.append(f"o box_{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in box.pose.apply(solid.vertices)]
        lines += [f"f {a} {b} {c}" for a, b, c in solid.faces + 1 + 8 * number]
    folder = tempfile.TemporaryDirectory(prefix="roboxim-boxes-")
    _KEPT.append(folder)
    file = Path(folder.name) / "boxes.obj"
    file.write_text("\n".join(lines) + "\n")
    return str(file)


_KINDS = {
    "box": pybullet.GEOM_BOX,
    "sphere": pybullet.GEOM_SPHERE,
    "cylinder": pybullet.GEOM_CYLINDER,
    "capsule": pybullet.GEOM_CAPSULE,
    "hull": pybullet.GEOM_MESH,
}


def _collision_shape(client: BulletClient, shapes: Sequence[Shape]) -> int:
    if not shapes:
        return -1
    for shape in shapes:
        if shape.kind not in _KINDS:
            raise ConfigError(f"unknown collision shape '{shape.kind}'; expected one of: {', '.join(_KINDS)}")
    if len(shapes) > MAX_SHAPES:
        shapes = _with_boxes_in_a_file(shapes)
    size = [shape.size or (0.0,) for shape in shapes]
    made = client.createCollisionShapeArray(
        shapeTypes=[_KINDS[shape.kind] for shape in shapes],
        halfExtents=[[v / 2 for v in s] if len(s) == 3 else [0.0, 0.0, 0.0] for s in size],
        radii=[s[0] for s in size],
        lengths=[s[1] if len(s) == 2 else 0.0 for s in size],
        fileNames=[shape.mesh for shape in shapes],
        meshScales=[[shape.scale] * 3 for shape in shapes],
        collisionFramePositions=[shape.pose.position for shape in shapes],
        collisionFrameOrientations=[shape.pose.quat_xyzw for shape in shapes],
    )
    if made < 0:
        raise SimError(f"PyBullet cannot build the collision shapes {shapes}", ErrorCode.SIM_FAULT)
    return int(made)
