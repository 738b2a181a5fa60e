"""Kinematics of a robot model with Pinocchio; the inverse kinematics run in the native kernel.

The inverse kinematics follow a moving target from tick to tick: they start at the present joints and stay near them.
They are local and deterministic on purpose; the planner searches for solutions of distant poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, one_of
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Array, Pose, distance
from roboxim_planner_native import Arm

if TYPE_CHECKING:
    import pinocchio as pin

    from roboxim_core.models.library import ModelLibrary

POSITION_TOLERANCE_M = 1e-7
ROTATION_TOLERANCE_RAD = 1e-6
MAX_ITERATIONS = 30
POSTURE_GAIN = 0.02
"""Fraction of the distance to the posture that a call of `ArmKinematics.ik_near` covers."""
POSITION_FIRST = 16
"""Descents in which an arm whose tool turns in fewer than three directions gives up rotation for position."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IkResult:
    """Result of the local inverse kinematics."""

    joints: Array
    """Arm joint positions [rad]."""
    converged: bool
    """Whether the pose is reached within 0.1 um and 1 urad."""
    placed: bool
    """Whether the position is reached within 0.1 um."""
    position_error_m: float
    """Distance of the tool centre point from the target [m]."""
    rotation_error_rad: float
    """Angle from the target [rad]."""


class ArmKinematics:
    """An arm with its gripper. Poses are in the robot's base frame. Not thread-safe: make one per thread.

    Note: Pinocchio orders joints depth first, and ``joint_names`` of the model may have another order, so every vector
    is reordered by index maps.
    """

    def __init__(self, model: RobotModel) -> None:
        """Load the model's URDF.

        Raises:
            ConfigError: When the URDF lacks a joint or link that the model names, or a joint is continuous.
        """
        import pinocchio as pin

        self.model = model
        self._pin = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self._pin.createData()
        self._q = pin.neutral(self._pin)
        followers = [follower.name for follower in model.gripper.followers]
        for name in (*model.joint_names, *model.gripper.joint_names, *followers):
            if not self._pin.existJointName(name):
                raise ConfigError(f"{model.urdf} has no joint '{name}'; {one_of(self._pin.names, name)}")
            if (joint := self._pin.joints[self._pin.getJointId(name)]).nq != 1:
                raise ConfigError(
                    f"{model.urdf}: joint '{name}' has {joint.nq} numbers, expected 1: a continuous joint must be "
                    "written as revolute, with lower and upper limits"
                )
        self._arm = self._places(model.joint_names)
        self._fingers, self._followers = self._places(model.gripper.joint_names), self._places(followers)
        self._frames = {
            frame.name: index for index, frame in enumerate(self._pin.frames) if frame.type == pin.FrameType.BODY
        }
        for link in (model.base_link, model.tcp_link, *model.gripper.links):
            if link not in self._frames:
                raise ConfigError(f"{model.urdf} has no link '{link}'; {one_of(self._frames, link)}")
        self._tcp = self._frames[model.tcp_link]
        self.lower = np.array(model.limits.lower)
        self.upper = np.array(model.limits.upper)
        self.velocity = np.array(model.limits.velocity)
        self._order = np.argsort(self._arm)
        """Indices into the model's joints that sort them from the base to the tip."""
        self._ids = [self._pin.getJointId(model.joint_names[k]) for k in self._order]
        pin.framesForwardKinematics(self._pin, self._data, self._q)
        joint = self._moves_with(self._pin.frames[self._tcp].parentJoint)
        frame = pin.SE3.Identity() if joint < 0 else self._data.oMi[self._ids[joint]]
        self.tcp_attachment: tuple[int, Array] = joint, frame.actInv(self._data.oMf[self._tcp]).homogeneous
        """Index of the arm joint, from the base to the tip, that the TCP moves with (-1: none), and its pose in that
        joint's frame, shape (4, 4)."""
        self._native = self.native_arm()

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links, base first."""
        return tuple(self._frames)

    def fk(self, joints: npt.ArrayLike) -> Pose:
        """Return the pose of the tool centre point in the base.

        Args:
            joints: Arm joint positions, shape (n,) [rad].
        """
        return _pose(self._place(joints))

    def link_poses(self, joints: npt.ArrayLike, fingers: Sequence[float] = ()) -> dict[str, Pose]:
        """Return the pose of every link in the base.

        Args:
            joints: Arm joint positions, shape (n,) [rad].
            fingers: Positions of the fingers' driven joints [m or rad]; empty: closed.
        """
        import pinocchio as pin

        gripper = self.model.gripper
        driven = fingers if len(fingers) else (gripper.driven(0.0),) * len(gripper.joint_names)
        self._q[self._fingers] = driven
        if gripper.followers:
            self._q[self._followers] = gripper.followed(driven)
        self._q[self._arm] = joints
        pin.framesForwardKinematics(self._pin, self._data, self._q)
        return {name: _pose(self._data.oMf[index]) for name, index in self._frames.items()}

    def jacobian(self, joints: npt.ArrayLike) -> Array:
        """Return the Jacobian of the tool centre point, base-aligned axes, shape (6, n): linear rows first [m/rad]."""
        import pinocchio as pin

        self._q[self._arm] = joints
        full = pin.computeFrameJacobian(
            self._pin, self._data, self._q, self._tcp, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        return np.asarray(full[:, self._arm])

    def within_limits(self, joints: npt.ArrayLike, margin: float = 0.0) -> bool:
        """Return whether all joints are inside their limits by a margin [rad]."""
        q = np.asarray(joints, dtype=float)
        return bool(np.all(q >= self.lower + margin) and np.all(q <= self.upper - margin))

    def reach(self, pose: Pose, near: npt.ArrayLike) -> Array:
        """Return arm joint positions that reach a pose, close to given ones.

        Args:
            pose: Pose of the tool centre point in the base.
            near: Arm joint positions where the search starts, shape (n,) [rad].

        Raises:
            InvalidRequestError: With code ``INVALID_ACTION`` when the local search finds none within 0.1 um and 1 urad.
        """
        found = self.ik_near(pose, near)
        if not found.converged:
            raise InvalidRequestError(
                f"no joints near {np.round(np.asarray(near, dtype=float), 3).tolist()} reach {pose}: the best are "
                f"{1e3 * found.position_error_m:.2f} mm and {found.rotation_error_rad:.4f} rad off; ask for a pose in "
                "reach, or one closer to where the arm is",
                ErrorCode.INVALID_ACTION,
            )
        return found.joints

    def ik_near(
        self,
        target: Pose,
        seed: npt.ArrayLike,
        *,
        posture: npt.ArrayLike | None = None,
        max_step: npt.ArrayLike | None = None,
    ) -> IkResult:
        """Follow a target pose from a nearby configuration: damped least squares inside the joint limits.

        An arm whose tool turns in fewer than three directions (`RobotModel.rotations`) reaches the position first, and
        as much of the rotation as it can there.

        Args:
            target: Pose of the tool centre point in the base.
            seed: Arm joint positions to start at, shape (n,) [rad].
            posture: Joint positions that the redundant degrees of freedom move towards, shape (n,) [rad]; None: they
                do not move.
            max_step: Largest change of each joint from the seed, shape (n,) [rad]; None: only the joint limits apply.

        Returns:
            The closest configuration found within a fixed number of iterations.
        """
        start = np.asarray(seed, dtype=float)
        pull = np.empty(0)
        if posture is not None:
            pull = POSTURE_GAIN * (np.asarray(posture, dtype=float) - start)[self._order]
        largest = np.empty(0) if max_step is None else np.asarray(max_step, dtype=float)[self._order]
        joints, position_error_m, rotation_error_rad = self._follow(target, start[self._order], pull, largest)
        if self.model.rotations < 3 and rotation_error_rad >= ROTATION_TOLERANCE_RAD:
            joints, position_error_m = self._place_first(target, joints, start[self._order], largest)
            rotation_error_rad = distance(self.fk(self._ordered(joints)), target)[1]
        return IkResult(
            joints=self._ordered(joints),
            converged=position_error_m < POSITION_TOLERANCE_M and rotation_error_rad < ROTATION_TOLERANCE_RAD,
            placed=position_error_m < POSITION_TOLERANCE_M,
            position_error_m=position_error_m,
            rotation_error_rad=rotation_error_rad,
        )

    def _follow(self, target: Pose, start: Array, pull: Array, largest: Array) -> tuple[Array, float, float]:
        """Return joints and errors of one descent; all joints are in the kernel's order."""
        joints, position_error_m, rotation_error_rad = self._native.follow(
            target.position,
            target.quat_xyzw,
            start.tolist(),
            pull=pull.tolist(),
            largest_change=largest.tolist(),
            iterations=MAX_ITERATIONS,
            position_tolerance=POSITION_TOLERANCE_M,
            rotation_tolerance=ROTATION_TOLERANCE_RAD,
        )
        return np.asarray(joints), position_error_m, rotation_error_rad

    def _place_first(self, target: Pose, joints: Array, start: Array, largest: Array) -> tuple[Array, float]:
        """Give up the rotation that a compromise has not reached, until the position is.

        A descent divides the error of a pose out of reach between position and rotation. The next one asks for the
        rotation that it did reach, so that what is left of the error is a fraction of that before.
        """
        left, error_m = np.empty(0), math.inf
        for _ in range(POSITION_FIRST):
            if largest.size:
                left = np.maximum(largest - np.abs(joints - start), 0.0)
            reached = Pose(position=target.position, quat_xyzw=self.fk(self._ordered(joints)).quat_xyzw)
            joints, error_m, _ = self._follow(reached, joints, np.empty(0), left)
            if error_m < POSITION_TOLERANCE_M:
                break
        return joints, error_m

    def _ordered(self, joints: Array) -> Array:
        """Return joints of the kernel in the model's order."""
        found = np.empty(len(joints))
        found[self._order] = joints
        return found

    def _places(self, names: Sequence[str]) -> npt.NDArray[np.int64]:
        """Return the indices of joints in Pinocchio's configurations."""
        return np.array([self._pin.joints[self._pin.getJointId(name)].idx_q for name in names], dtype=int)

    def _place(self, joints: npt.ArrayLike) -> pin.SE3:
        import pinocchio as pin

        self._q[self._arm] = joints
        pin.forwardKinematics(self._pin, self._data, self._q)
        return pin.updateFramePlacement(self._pin, self._data, self._tcp)

    def native_arm(self, margin: float = 0.0) -> Arm:
        """Return the native kernel's model of the arm, with joints ordered from the base to the tip.

        Args:
            margin: By how much its limits are tighter [rad].
        """
        import pinocchio as pin

        pin.computeJointJacobians(self._pin, self._data, pin.neutral(self._pin))
        axes, prismatic = [], []
        for i in self._ids:
            motion = pin.getJointJacobian(self._pin, self._data, i, pin.LOCAL)[:, self._pin.joints[i].idx_v]
            prismatic.append(bool(np.linalg.norm(motion[3:]) < 0.5))
            axes.append(np.array(motion[:3] if prismatic[-1] else motion[3:]))
        parents = [self._moves_with(self._pin.parents[i]) for i in self._ids]
        frames = [self._data.oMi[i] for i in self._ids]
        bases = [pin.SE3.Identity() if k < 0 else frames[k] for k in parents]
        tcp_joint, tcp = self.tcp_attachment
        return Arm(
            parents=parents,
            placements=np.array([base.actInv(frame).homogeneous for base, frame in zip(bases, frames, strict=True)]),
            axes=np.array(axes),
            prismatic=prismatic,
            lower=self.lower[self._order] + margin,
            upper=self.upper[self._order] - margin,
            tcp_joint=tcp_joint,
            tcp=tcp,
        )

    def _moves_with(self, joint: int) -> int:
        """Return the index, from the base to the tip, of the arm joint that moves a Pinocchio joint; -1: none does."""
        while joint > 0 and joint not in self._ids:
            joint = self._pin.parents[joint]
        return self._ids.index(joint) if joint > 0 else -1


class Arms(dict[str, ArmKinematics]):
    """The arms of a library by robot, each made when it is asked for. Not thread-safe, as they are."""

    def __init__(self, library: ModelLibrary) -> None:
        """Make no arm yet."""
        super().__init__()
        self._library = library

    def __missing__(self, robot: str) -> ArmKinematics:
        """Make an arm.

        Raises:
            ConfigError: When there is no such robot, or as `ArmKinematics`.
        """
        arm = self[robot] = ArmKinematics(self._library.robot(robot))
        return arm


def _pose(placement: pin.SE3) -> Pose:
    import pinocchio as pin

    return Pose.from_quaternion(placement.translation, pin.Quaternion(placement.rotation))
