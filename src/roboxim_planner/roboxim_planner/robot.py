"""The robot as the planner sees it: kinematics by Pinocchio, collision geometry as convex hulls, limits.

The collision meshes of the URDF are replaced by their convex hulls: a hull never misses a contact of its mesh and is an
order of magnitude faster to check.
"""

from __future__ import annotations

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose

Array = npt.NDArray[np.float64]


def se3(pose: Pose) -> pin.SE3:
    """Turn a pose into Pinocchio's rigid transform."""
    return pin.SE3(pose.rotation.as_matrix(), np.array(pose.position))


class PlannerRobot:
    """A robot model loaded for planning. One object serves one thread: Pinocchio's data is scratch space.

    Everything is in the frame of the robot's base; the pose of the base in the world belongs to the scene.
    """

    def __init__(self, robot: RobotModel) -> None:
        """Load the URDF and SRDF.

        Args:
            robot: The robot's description.

        Raises:
            ConfigError: When the URDF lacks a joint or link that the description names.
        """
        self.description = robot
        self.kinematics = ArmKinematics(robot)
        self.model = pin.buildModelFromUrdf(str(robot.urdf))
        self.dof = len(robot.joint_names)
        self._joint_ids = [self.model.getJointId(name) for name in robot.joint_names]
        self._arm_q = np.array([self.model.joints[i].idx_q for i in self._joint_ids])
        self._finger_q = np.array(
            [self.model.joints[self.model.getJointId(n)].idx_q for n in robot.gripper.joint_names], dtype=int
        )
        self.tcp_frame = self.model.getFrameId(robot.tcp_link)
        self.links = self.kinematics.link_names
        self.lower = np.array(robot.limits.lower)
        self.upper = np.array(robot.limits.upper)
        self.max_velocity = np.array(robot.limits.velocity)
        self.max_acceleration = np.array(robot.limits.acceleration)
        self.max_jerk = np.array(robot.limits.jerk)
        self.geometry = self._load_geometry(robot)
        self.reach = self._lever_arms()

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

    def _lever_arms(self) -> Array:
        """Bound how far any point of the arm can be from each joint's axis, shape (dof,) [m]."""
        reach = np.zeros(self.model.njoints)
        for item in self.geometry.geometryObjects:
            far = np.linalg.norm(item.placement.act(item.geometry.aabb_center)) + item.geometry.aabb_radius
            reach[item.parentJoint] = max(reach[item.parentJoint], far)
        for i in range(self.model.njoints - 1, 0, -1):
            parent = self.model.parents[i]
            travel = 0.0 if i in self._joint_ids else 0.05
            reach[parent] = max(
                reach[parent], reach[i] + travel + np.linalg.norm(self.model.jointPlacements[i].translation)
            )
        return reach[self._joint_ids]

    def full(self, joints: npt.ArrayLike, opening: float = 1.0) -> Array:
        """Return Pinocchio's full configurations for arm configurations.

        Args:
            joints: Arm joints [rad], shape (dof,) or (N, dof).
            opening: Gripper opening, 1 = open, 0 = closed.
        """
        arm = np.asarray(joints, dtype=float)
        q = np.tile(pin.neutral(self.model), (*arm.shape[:-1], 1))
        q[..., self._arm_q] = arm
        q[..., self._finger_q] = opening * self.description.gripper.max_opening_m / 2
        return q

    def fk(self, joints: npt.ArrayLike, link: str = "") -> Pose:
        """Return the pose of a link in the robot's base.

        Args:
            joints: Arm joints [rad], shape (dof,).
            link: Name of the link; empty: the tcp.

        Raises:
            InvalidRequestError: When there is no such link.
        """
        if not link:
            return self.kinematics.fk(joints)
        if link not in self.kinematics.link_names:
            names = one_of(self.kinematics.link_names, link)
            raise InvalidRequestError(f"robot '{self.description.id}' has no link '{link}'; {names}")
        return self.kinematics.link_poses(joints)[link]

    def tcp_poses(self, joints: npt.ArrayLike) -> list[Pose]:
        """Return the tcp in the robot's base along a path of arm configurations of shape (N, dof)."""
        return [self.kinematics.fk(q) for q in np.atleast_2d(np.asarray(joints, dtype=float))]

    def check_joints(self, joints: npt.ArrayLike, *, what: str) -> Array:
        """Check arm joint positions at the door.

        Args:
            joints: Positions [rad].
            what: What they are, for the message, e.g. ``"start"``.

        Returns:
            Array of shape (dof,).

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
        """Say which joint limits a configuration breaks by more than a tolerance [rad], as sentences."""
        return tuple(
            f"{name} at {value:.4f} rad is outside [{low:.4f}, {high:.4f}]"
            for name, value, low, high in zip(self.description.joint_names, joints, self.lower, self.upper, strict=True)
            if not low - tolerance <= value <= high + tolerance
        )
