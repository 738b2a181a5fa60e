"""Converts messages to the planner's values and back: joints, poses, options, trajectories, contacts."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Pose as PoseMsg
from roboxim_interfaces.msg import ContactPair as ContactPairMsg
from roboxim_interfaces.msg import MotionPlan as MotionPlanMsg
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, one_of
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import IDENTITY, Pose
from roboxim_planner.collisions.contacts import ContactPair
from roboxim_planner.constraint import Upright
from roboxim_planner.pipeline import MotionOptions, Plan
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene
from roboxim_ros.messages.conversions import fill_pose, pose_from_msg

Array = npt.NDArray[np.float64]
WORLD = "world"
TCP = "tcp"


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Prefix the message of an `InvalidRequestError` with the name of the part of the request."""
    try:
        yield
    except InvalidRequestError as error:
        error.args = (f"{what}: {error}",)
        raise


def optional_pose(msg: PoseMsg, *, what: str) -> Pose:
    """Convert a pose; a pose of zeros is the identity.

    Raises:
        InvalidRequestError: If it is not finite or its quaternion is not of unit norm; begins with ``what``.
    """
    p, q = msg.position, msg.orientation
    if not any((p.x, p.y, p.z, q.x, q.y, q.z, q.w)):
        return IDENTITY
    with naming(what):
        pose = pose_from_msg(msg)
        limits.require_finite("a position", pose.position, limits.LENGTH_M)
    return pose


def joints_from_msg(msg: JointState, robot: RobotModel, *, what: str) -> Array:
    """Return arm joint positions in the model's order from a joint state in any order.

    Raises:
        InvalidRequestError: On a wrong number of joints, or a name that is unknown, missing or given twice.
    """
    positions = list(msg.position)
    names = list(msg.name)
    if not names:
        if len(positions) != len(robot.joint_names):
            raise InvalidRequestError(
                f"{what}: robot '{robot.id}' has {len(robot.joint_names)} arm joints, got {len(positions)} positions"
            )
        return np.array(positions, dtype=float)
    if len(names) != len(positions) or len(set(names)) != len(names):
        raise InvalidRequestError(f"{what}: needs one position per name, each name once; got {len(names)} names "
                                  f"and {len(positions)} positions")  # fmt: skip
    followers = (follower.name for follower in robot.gripper.followers)
    known = (*robot.joint_names, *robot.gripper.joint_names, *followers)
    for name in names:
        if name not in known:
            raise InvalidRequestError(f"{what}: robot '{robot.id}' has no joint '{name}'; {one_of(known, name)}")
    missing = [name for name in robot.joint_names if name not in names]
    if missing:
        raise InvalidRequestError(f"{what}: no position for joint {', '.join(missing)}")
    return np.array([positions[names.index(name)] for name in robot.joint_names], dtype=float)


def fingers_from_msg(msg: JointState, robot: RobotModel) -> tuple[float, ...]:
    """Return the positions of the fingers' driven joints [m or rad] in a joint state; empty: it names none of them.

    A finger that it does not name moves as the other one. Joints that follow others are not read.

    Raises:
        InvalidRequestError: If a position is not finite.
    """
    given = dict(zip(msg.name, msg.position, strict=False))
    known = [float(given[name]) for name in robot.gripper.joint_names if name in given]
    if not np.isfinite(known).all():
        raise InvalidRequestError(f"state: positions of fingers must be finite, got {known}")
    return tuple(float(given.get(name, known[0])) for name in robot.gripper.joint_names) if known else ()


def joints_to_msg(joints: Array, robot: RobotModel) -> JointState:
    """Return a joint state of the arm."""
    msg = JointState()
    msg.name = list(robot.joint_names)
    msg.position = joints.tolist()
    return msg


def pose_in_world(
    msg: Any, frame: str, robot: PlannerRobot, robot_pose: Pose, start: Array | None = None, *, what: str = "target"
) -> Pose:
    """Convert a target pose to the world.

    Args:
        msg: ``geometry_msgs/Pose``.
        frame: ``world`` or empty, ``<robot>_base`` or the robot's base link, or ``tcp`` (at the start).
        robot: The robot.
        robot_pose: Pose of the robot's base in the world.
        start: Arm configuration at the start, for the frame ``tcp``; none: the request does not allow that frame.
        what: Name of the pose in error messages.

    Raises:
        InvalidRequestError: If it is not finite or its quaternion is not of unit norm.
        PlannerError: ``UNKNOWN_FRAME``.
    """
    base = f"{robot.description.id}_base"
    with naming(what):
        pose = pose_from_msg(msg)
        limits.require_finite("a position", pose.position, limits.LENGTH_M)
    if frame in ("", WORLD):
        return pose
    if frame in (base, robot.description.base_link):
        return robot_pose @ pose
    if frame == TCP and start is not None:
        return robot_pose @ robot.fk(start) @ pose
    known = (WORLD, base) if start is None else (WORLD, base, TCP)
    raise PlannerError(f"{what}: unknown frame '{frame}'; {one_of(known, frame)}", ErrorCode.UNKNOWN_FRAME)


def options_from_msg(msg: Any) -> MotionOptions:
    """Convert the limits of a ``MotionRequest``; zero means the default."""
    named: dict[str, Any] = {"planner": msg.planner_id} if msg.planner_id else {}
    padding = None if msg.scene.padding == 0.0 else float(msg.scene.padding)
    improve = int(msg.improve_iterations) or None
    options = MotionOptions(**named, padding_m=padding, improve_iterations=improve, seed=int(msg.seed))
    return limited(options, msg)


def limited(options: MotionOptions, msg: Any) -> MotionOptions:
    """Return options with the limits that a ``MotionRequest`` or a ``MotionStage`` gives; zero means none."""
    numbers = {
        "velocity_scaling": msg.max_velocity_scaling_factor,
        "acceleration_scaling": msg.max_acceleration_scaling_factor,
        "max_tcp_speed_m_s": msg.max_tcp_speed,
        "max_tcp_rot_speed_rad_s": msg.max_tcp_rot_speed,
    }
    given: dict[str, Any] = {name: float(value) for name, value in numbers.items() if value != 0.0}
    return replace(options, **given, upright=upright_from_msg(msg.path_constraints) or options.upright)


def upright_from_msg(msg: Any) -> Upright | None:
    """Convert ``PathConstraints``; none: the message has no constraint."""
    if msg.tilt_tolerance == 0.0:
        return None
    given = {"tool_axis": _vector(msg.tool_axis), "world_axis": _vector(msg.world_axis)}
    axes = {name: axis for name, axis in given.items() if any(axis)}
    return Upright(tolerance_rad=float(msg.tilt_tolerance), **axes)


def _vector(msg: Any) -> tuple[float, float, float]:
    return msg.x, msg.y, msg.z


def sample_period(msg: Any) -> float:
    """Return the sampling period of a ``MotionRequest`` [s].

    Raises:
        InvalidRequestError: If it is out of range.
    """
    period = float(msg.sample_period) or 0.01
    if not 0.001 <= period <= 0.1:
        raise InvalidRequestError(f"sample_period must be 0.001..0.1 s, got {period}")
    return period


def path_to_msg(path: Array, period_s: float, robot: RobotModel) -> JointTrajectory:
    """Convert a joint path to a message without velocities.

    Args:
        path: Shape (N, dof) [rad].
        period_s: Time from one row to the next [s].
        robot: The robot, which names the joints.
    """
    msg = JointTrajectory(joint_names=list(robot.joint_names))
    msg.header.frame_id = WORLD
    for number, row in enumerate(path.tolist()):
        seconds, nanoseconds = divmod(round(number * period_s * 1e9), 1_000_000_000)
        after = Duration(sec=seconds, nanosec=nanoseconds)
        msg.points.append(JointTrajectoryPoint(positions=row, time_from_start=after))
    return msg


def plan_to_msg(plan: Plan, robot: PlannerRobot, scene: PlanningScene, period_s: float, tcp_poses: bool) -> Any:
    """Return a ``MotionPlan`` message.

    Raises:
        PlannerError: See `Plan.points`.
    """
    samples = plan.points(period_s)
    msg = MotionPlanMsg(fraction=plan.fraction, route=plan.route)
    trajectory: JointTrajectory = msg.trajectory
    trajectory.header.frame_id = f"{robot.description.id}_base"
    trajectory.joint_names = list(robot.description.joint_names)
    trajectory.points = [
        JointTrajectoryPoint(
            positions=_numbers(q), velocities=_numbers(v), accelerations=_numbers(a), time_from_start=_duration(t)
        )
        for t, q, v, a in zip(
            samples.times.tolist(), samples.positions, samples.velocities, samples.accelerations, strict=True
        )
    ]
    if tcp_poses:
        poses = robot.tcp_poses(samples.positions)
        msg.tcp_poses = [fill_pose(PoseMsg(), scene.robot_pose @ pose) for pose in poses]
    return msg


def _numbers(row: Array) -> array[float]:
    """Return an array that a message accepts without checking every number."""
    return array("d", row.tobytes())


def _duration(seconds: float) -> Duration:
    nanoseconds = round(seconds * 1e9)
    return Duration(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def trajectory_from_msg(msg: JointTrajectory, robot: RobotModel) -> dict[str, Any]:
    """Return positions, times, velocities and accelerations of a trajectory; None for those that it lacks.

    Raises:
        InvalidRequestError: If some points lack values that others have, a number is not finite, or the joints do not
            match the robot's.
    """
    if not msg.points:
        raise InvalidRequestError("the trajectory has no point")
    names = list(msg.joint_names) or list(robot.joint_names)
    if sorted(names) != sorted(robot.joint_names):
        raise InvalidRequestError(
            f"the trajectory must name the joints of robot '{robot.id}', {', '.join(robot.joint_names)}; "
            f"got {', '.join(names)}"
        )
    order = [names.index(name) for name in robot.joint_names]
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
    return {
        "positions": _matrix([p.positions for p in msg.points], order, "positions", required=True),
        "times": times if times.any() else None,
        "velocities": _matrix([p.velocities for p in msg.points], order, "velocities"),
        "accelerations": _matrix([p.accelerations for p in msg.points], order, "accelerations"),
    }


def _matrix(rows: Sequence[Any], order: list[int], what: str, *, required: bool = False) -> Array | None:
    if not required and not any(len(row) for row in rows):
        return None
    for i, row in enumerate(rows):
        if len(row) != len(order):
            raise InvalidRequestError(f"point {i} of the trajectory has {len(row)} {what}, expected {len(order)}")
    values = np.array(rows, dtype=float)[:, order]
    for i in map(int, np.flatnonzero(~np.isfinite(values).all(axis=1))):
        raise InvalidRequestError(f"point {i} of the trajectory: {what} must be finite, got {values[i].tolist()}")
    if required and np.abs(values).max() > limits.JOINT_POSITION:
        raise InvalidRequestError(f"{what} of a trajectory must be within +-{limits.JOINT_POSITION:g}")
    return values


def contact_to_msg(contact: ContactPair) -> ContactPairMsg:
    """Return a ``ContactPair`` message."""
    msg = ContactPairMsg(body_a=contact.body_a, body_b=contact.body_b, depth=contact.depth)
    msg.position.x, msg.position.y, msg.position.z = contact.position
    return msg
