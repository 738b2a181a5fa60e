"""The planner's model of a robot: kinematics by Pinocchio, collision geometry as convex hulls, limits.

The collision meshes of the URDF are replaced by their convex hulls. A hull never misses a contact of its mesh and is an
order of magnitude faster to check.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from roboxim_core.errors import ConfigError, InvalidRequestError, one_of
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose
from roboxim_planner.collisions.covers import cover_box, cover_hull, cover_round
from roboxim_planner.collisions.geometry import convex_hull, mesh_points
from roboxim_planner.native import native

Array = npt.NDArray[np.float64]
_INSIDE_RAD = 4e-3


def se3(pose: Pose) -> pin.SE3:
    """Convert a pose to Pinocchio's rigid transform."""
    return pin.SE3(pose_matrix(pose))


def pose_matrix(pose: Pose) -> Array:
    """Return a pose as a homogeneous matrix, shape (4, 4); ten times as fast as scipy."""
    x, y, z, w = pose.quat_xyzw
    s = 2.0 / (x * x + y * y + z * z + w * w)
    px, py, pz = pose.position
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), px],
            [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w), py],
            [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y), pz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkShape:
    """A convex part of a link, for the native kernel."""

    link: str
    """Name of the link."""
    joint: int
    """Index of the arm joint that the part moves with; -1: the base."""
    item: native.Item
    """The shape."""
    close: bool
    """Whether it is checked only against one other link; see `ClosePair`."""


class PlannerRobot:
    """A robot model loaded for planning. Not thread-safe: Pinocchio's data is scratch space.

    All poses are in the frame of the robot's base; the pose of the base in the world belongs to the scene.
    """

    def __init__(self, robot: RobotModel) -> None:
        """Load the URDF and SRDF.

        Args:
            robot: The robot's description.

        Raises:
            ConfigError: If the URDF lacks a joint or link that the description names.
            InvalidRequestError: If a mesh of a close pair cannot be read.
        """
        self.description = robot
        self.kinematics = ArmKinematics(robot)
        self.model = pin.buildModelFromUrdf(str(robot.urdf))
        self.dof = len(robot.joint_names)
        self._joint_ids = [self.model.getJointId(name) for name in robot.joint_names]
        self.arm_indices = np.array([self.model.joints[i].idx_q for i in self._joint_ids])
        """Indices of the arm's joints in Pinocchio's configurations."""
        fingers = (*robot.gripper.joint_names, *(follower.name for follower in robot.gripper.followers))
        self._finger_q = np.array([self.model.joints[self.model.getJointId(n)].idx_q for n in fingers], dtype=int)
        self.tcp_frame = self.model.getFrameId(robot.tcp_link)
        self.links = self.kinematics.link_names
        self.lower = np.array(robot.limits.lower)
        self.upper = np.array(robot.limits.upper)
        self.max_velocity = np.array(robot.limits.velocity)
        self.max_acceleration = np.array(robot.limits.acceleration)
        self.max_jerk = np.array(robot.limits.jerk)
        self.geometry = self._load_geometry(robot)
        """Convex collision geometry and the pairs of links to check; parts of close pairs come last."""
        self.whole_shapes = len(self.geometry.geometryObjects)
        """Number of leading shapes of ``geometry`` that are checked against everything."""
        self._add_close_pairs(robot)
        self.item_links = tuple(self.model.frames[item.parentFrame].name for item in self.geometry.geometryObjects)
        """Link of each collision shape."""
        self.self_pairs = tuple((pair.first, pair.second) for pair in self.geometry.collisionPairs)
        """Pairs of collision shapes that may not touch."""
        self.scratch = self.model.createData()
        self._shapes = lru_cache(maxsize=16)(self._link_shapes)

    def _load_geometry(self, robot: RobotModel) -> pin.GeometryModel:
        folders = [str(folder) for folder in robot.urdf.resolve().parents]
        geometry = pin.buildGeomFromUrdf(self.model, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders)
        for item in geometry.geometryObjects:
            if isinstance(item.geometry, coal.BVHModelBase):
                item.geometry.buildConvexHull(True, "Qt")
                item.geometry = item.geometry.convex
                item.meshScale = np.ones(3)
            item.geometry.computeLocalAABB()
        geometry.addAllCollisionPairs()
        pin.removeCollisionPairs(self.model, geometry, str(robot.srdf))
        return geometry

    def _add_close_pairs(self, robot: RobotModel) -> None:
        """Add the parts of close pairs to the geometry."""
        links = [self.model.frames[item.parentFrame].name for item in self.geometry.geometryObjects]
        for pair in robot.close_pairs:
            for name in (pair.link, pair.other):
                if name not in links:
                    known = one_of(sorted(set(links)), name)
                    raise ConfigError(f"robot '{robot.id}': close_pairs: no link '{name}' with geometry; {known}")
            other = self.geometry.geometryObjects[links.index(pair.other)]
            for file in pair.parts:
                shape = coal.Convex(convex_hull(mesh_points(file, 1.0)))
                shape.computeLocalAABB()
                frame = self.model.frames[other.parentFrame]
                item = pin.GeometryObject(Path(file).stem, other.parentJoint, other.parentFrame, frame.placement, shape)
                index = self.geometry.addGeometryObject(item)
                for k in (k for k, name in enumerate(links) if name == pair.link):
                    self.geometry.addCollisionPair(pin.CollisionPair(k, index))

    @cached_property
    def arm(self) -> native.Arm:
        """The arm's kinematics in the native kernel.

        Raises:
            ConfigError: If the description does not list the joints from base to tip.
        """
        if self._joint_ids != sorted(self._joint_ids):
            raise ConfigError(f"robot '{self.description.id}': joint_names must go from the base to the tip")
        return self.kinematics.native_arm()

    @cached_property
    def arm_within_limits(self) -> native.Arm:
        """The arm with slightly tighter limits, so that a smooth curve through configurations keeps the real ones."""
        return self.kinematics.native_arm(_INSIDE_RAD)

    def link_shapes(self, opening: float) -> tuple[LinkShape, ...]:
        """Return the links' convex parts in the order of ``geometry``, with the fingers at an opening of 0..1."""
        return self._shapes(round(opening, 6))

    def _link_shapes(self, opening: float) -> tuple[LinkShape, ...]:
        data = self._at_zero(opening)
        shapes = []
        for index, part in enumerate(self.geometry.geometryObjects):
            joint = self._moves_with(part.parentJoint)
            frame = pin.SE3.Identity() if joint < 0 else data.oMi[self._joint_ids[joint]]
            pose = frame.actInv(data.oMi[part.parentJoint]) * part.placement
            kind, size, spheres = native_shape(part.geometry)
            placed = np.column_stack([spheres[:, :3] @ pose.rotation.T + pose.translation, spheres[:, 3]])
            item = native.Item(joint, kind, size, pose.homogeneous, placed)
            link = self.model.frames[part.parentFrame].name
            shapes.append(LinkShape(link=link, joint=joint, item=item, close=index >= self.whole_shapes))
        return tuple(shapes)

    def _at_zero(self, opening: float) -> pin.Data:
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.full(np.zeros(self.dof), opening))
        return data

    def _moves_with(self, joint: int) -> int:
        """Return the index of the arm joint that a joint of Pinocchio moves with; -1: none."""
        while joint and joint not in self._joint_ids:
            joint = self.model.parents[joint]
        return self._joint_ids.index(joint) if joint else -1

    def full(self, joints: npt.ArrayLike, opening: float = 1.0) -> Array:
        """Return Pinocchio's full configurations (arm and fingers) for arm configurations.

        Args:
            joints: Arm joints [rad], shape (dof,) or (N, dof).
            opening: Gripper opening, 1 = open, 0 = closed.
        """
        arm = np.asarray(joints, dtype=float)
        q = np.tile(pin.neutral(self.model), (*arm.shape[:-1], 1))
        q[..., self.arm_indices] = arm
        gripper = self.description.gripper
        driven = (gripper.driven(opening),) * len(gripper.joint_names)
        q[..., self._finger_q] = (*driven, *gripper.followed(driven))
        return q

    def fk(self, joints: npt.ArrayLike, link: str = "", fingers: Sequence[float] = ()) -> Pose:
        """Return the pose of a link in the robot's base.

        Args:
            joints: Arm joints [rad], shape (dof,).
            link: Name of the link; empty: the TCP.
            fingers: Positions of the fingers' driven joints [m or rad]; empty: closed.

        Raises:
            InvalidRequestError: If there is no such link.
        """
        if not link:
            return self.kinematics.fk(joints)
        if link not in self.kinematics.link_names:
            names = one_of(self.kinematics.link_names, link)
            raise InvalidRequestError(f"robot '{self.description.id}' has no link '{link}'; {names}")
        return self.kinematics.link_poses(joints, fingers)[link]

    def tcp_poses(self, joints: npt.ArrayLike) -> list[Pose]:
        """Return the poses of the TCP in the robot's base along a path of arm configurations, shape (N, dof)."""
        path = np.atleast_2d(np.asarray(joints, dtype=float))
        return [Pose.from_matrix(matrix) for matrix in self.arm.tcp_poses(path)]

    def check_joints(self, joints: npt.ArrayLike, *, what: str) -> Array:
        """Check arm joint positions of a request.

        Args:
            joints: Positions [rad].
            what: Name of the positions in error messages, e.g. ``"start"``.

        Returns:
            The positions, shape (dof,) [rad].

        Raises:
            InvalidRequestError: On a wrong number of joints or a number that is not finite.
        """
        values = np.asarray(joints, dtype=float)
        if values.shape != (self.dof,):
            raise InvalidRequestError(
                f"{what}: robot '{self.description.id}' has {self.dof} arm joints, got an array of shape {values.shape}"
            )
        if not np.isfinite(values).all():
            raise InvalidRequestError(f"{what}: joint positions must be finite, got {values.tolist()}")
        return values

    def limit_violations(self, joints: Array, *, tolerance: float = 1e-6) -> tuple[str, ...]:
        """Return a sentence for each joint limit that a configuration breaks by more than a tolerance [rad]."""
        return tuple(
            f"{name} at {value:.4f} rad is outside [{low:.4f}, {high:.4f}]"
            for name, value, low, high in zip(self.description.joint_names, joints, self.lower, self.upper, strict=True)
            if not low - tolerance <= value <= high + tolerance
        )


def native_shape(shape: coal.CollisionGeometry) -> tuple[str, Array, Array]:
    """Convert a convex shape for the native kernel.

    Returns:
        Its kind, its sizes or points, and spheres that cover it (see `covers`).

    Raises:
        InvalidRequestError: If the planner does not support the shape.
    """
    if isinstance(shape, coal.Box):
        size = 2.0 * np.array(shape.halfSide)
        return "box", size, cover_box(size)
    if isinstance(shape, coal.Sphere):
        return "sphere", np.array([shape.radius]), np.array([[0.0, 0.0, 0.0, shape.radius]])
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        kind = "cylinder" if isinstance(shape, coal.Cylinder) else "capsule"
        length = 2.0 * shape.halfLength
        return kind, np.array([shape.radius, length]), cover_round(shape.radius, length, capped=kind == "capsule")
    if isinstance(shape, coal.ConvexBase):
        points = np.array(shape.points())
        return "hull", points, cover_hull(points)
    raise InvalidRequestError(f"the planner cannot check a {type(shape).__name__}; use boxes, cylinders, hulls, meshes")
