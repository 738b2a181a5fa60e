"""The arm's and the gripper's actions, compatible with the joint trajectory and gripper controllers of ROS.

They advance simulated time themselves and run only outside an episode.
"""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action.server import ServerGoalHandle

from roboxim_core.errors import ErrorCode, InvalidRequestError, RoboximError
from roboxim_core.poses import Array
from roboxim_core.state import StateRecord
from roboxim_ros.messages.conversions import fill_stamp, stamp_to_ns
from roboxim_sim.ports import SimServer
from roboxim_sim.tolerances import GOAL_TOLERANCE_RAD, JointStates, Tolerance, tolerance, violation
from roboxim_sim.trajectories import JointTrajectory

GOAL_TIME_S = 0.5
"""Default time that the arm may take to reach its goal after the trajectory's end [s]."""
MAX_GOAL_TIME_S = 60.0
"""Largest goal time tolerance that a goal may request [s]."""
GRIPPER_TOLERANCE_M = 0.003
STALL_SPEED_M_S = 0.002
"""Speed below which fingers that have not reached their goal have stalled."""


class Turn:
    """An awaitable that yields to the executor once: rclpy resumes a waiting coroutine only when something wakes it."""

    def __init__(self, node: SimServer) -> None:
        """Yield to the other callbacks of the given node."""
        self._node = node

    def __await__(self) -> Generator[None, None, None]:
        """Yield once."""
        if self._node.executor is not None:
            self._node.executor.wake()
        yield


async def published_states(
    node: SimServer, goal: ServerGoalHandle, motion: Generator[StateRecord, None, None]
) -> AsyncGenerator[StateRecord, None]:
    """Publish and yield every state of a motion; stop the motion if its goal is cancelled.

    Args:
        node: The sim node.
        goal: The goal.
        motion: Advances time with every state; always closed at the end.

    Raises:
        RequestTimeoutError: When the motion takes longer than the node's ``motion_timeout_s``.
        RoboximError: Any error of the motion.
    """
    deadline = time.monotonic() + node.config.motion_timeout_s
    try:
        for record in motion:
            node.publish(record)
            yield record
            await Turn(node)
            if goal.is_cancel_requested:
                return
            if time.monotonic() > deadline:
                raise node.overtime()
    finally:
        motion.close()


class GoalError(Exception):
    """A trajectory goal is invalid, or its tolerances were violated."""

    def __init__(self, code: int, message: str) -> None:
        """Set an error code of `FollowJointTrajectory` and the message."""
        super().__init__(message)
        self.code = code


_Result = FollowJointTrajectory.Result


@dataclass(frozen=True, kw_only=True)
class _Goal:
    """A validated trajectory goal."""

    trajectory: JointTrajectory
    path: dict[str, Tolerance]
    end: dict[str, Tolerance]
    goal_time_s: float


class ArmController:
    """Executes trajectories with the error codes and tolerances of `FollowJointTrajectory`."""

    def __init__(self, node: SimServer) -> None:
        """Control the arm of a node's world."""
        self._node, self._world = node, node.world

    async def follow(self, goal: ServerGoalHandle) -> Any:
        """Execute a goal and return the result."""
        result = _Result()
        try:
            target = self._checked(goal.request)
            await self._move(goal, target)
            if goal.is_cancel_requested:
                goal.canceled()
                result.error_string = "cancelled; the arm stays where it was"
            else:
                goal.succeed()
        except GoalError as error:
            goal.abort()
            result.error_code, result.error_string = error.code, str(error)
        except RoboximError as error:
            goal.abort()
            result.error_code, result.error_string = _Result.INVALID_GOAL, f"{error.code.name}: {error}"
        return result

    async def _move(self, goal: ServerGoalHandle, target: _Goal) -> None:
        """Follow the trajectory, then wait until the arm is within the goal tolerances."""
        trajectory, strayed = target.trajectory, ""
        start_ns = self._world.record.stamp_ns
        motion = self._world.follow(trajectory, settle_s=target.goal_time_s)
        states = published_states(self._node, goal, motion)
        async for record in states:
            time_s = 1e-9 * (record.stamp_ns - start_ns)
            desired = _desired(trajectory, time_s)
            actual = JointStates(positions=record.robot.joint_positions, velocities=record.robot.joint_velocities)
            goal.publish_feedback(_feedback(record, desired, time_s))
            ended = time_s > trajectory.duration_s - 1e-6
            strayed = violation(target.end if ended else target.path, desired, actual)
            if ended != bool(strayed):
                break
        await states.aclose()
        if strayed and not goal.is_cancel_requested:
            if ended:
                message = f"{strayed}, {target.goal_time_s:g} s after the trajectory's end; something is in the way"
                raise GoalError(_Result.GOAL_TOLERANCE_VIOLATED, message)
            raise GoalError(_Result.PATH_TOLERANCE_VIOLATED, f"{strayed}, {time_s:.3f} s after the start")

    def _checked(self, request: Any) -> _Goal:
        msg, model = request.trajectory, self._world.robot
        names = list(msg.joint_names)
        if sorted(names) != sorted(model.joint_names):
            raise GoalError(
                _Result.INVALID_JOINTS, f"the trajectory must move exactly {list(model.joint_names)}, got {names}"
            )
        if request.multi_dof_trajectory.points or request.component_path_tolerance or request.component_goal_tolerance:
            raise GoalError(_Result.INVALID_GOAL, "the arm has no planar or floating joints")
        goal_time_s = _duration_s(request.goal_time_tolerance)
        if not 0.0 <= goal_time_s <= MAX_GOAL_TIME_S:
            raise GoalError(
                _Result.INVALID_GOAL, f"goal_time_tolerance must be from 0 to {MAX_GOAL_TIME_S:g} s, got {goal_time_s}"
            )
        delay_s = self._delay_s(stamp_to_ns(msg.header.stamp))
        order = [names.index(name) for name in model.joint_names]
        positions = _matrix([p.positions for p in msg.points], order, "positions")
        trajectory = self._world.checked_trajectory(
            [delay_s + _duration_s(p.time_from_start) for p in msg.points],
            positions,
            _optional_matrix([p.velocities for p in msg.points], order, "velocities"),
            _optional_matrix([p.accelerations for p in msg.points], order, "accelerations"),
        )
        return _Goal(
            trajectory=trajectory,
            path=_tolerances(model.joint_names, request.path_tolerance, Tolerance()),
            end=_tolerances(model.joint_names, request.goal_tolerance, Tolerance(position=GOAL_TOLERANCE_RAD)),
            goal_time_s=goal_time_s or GOAL_TIME_S,
        )

    def _delay_s(self, stamp_ns: int) -> float:
        """Return the delay until the trajectory begins [s]; a stamp of 0 means now."""
        now_ns = self._world.record.stamp_ns
        if not stamp_ns:
            return 0.0
        if stamp_ns < now_ns:
            raise GoalError(
                _Result.OLD_HEADER_TIMESTAMP,
                f"the trajectory begins at {1e-9 * stamp_ns:.3f} s of simulated time, and it is {1e-9 * now_ns:.3f} s; "
                "leave the stamp 0 to begin at once",
            )
        return 1e-9 * (stamp_ns - now_ns)


class GripperController:
    """Opens and closes the gripper."""

    def __init__(self, node: SimServer) -> None:
        """Control the gripper of a node's world."""
        self._node, self._world = node, node.world

    async def grip(self, goal: ServerGoalHandle) -> Any:
        """Execute a goal and return the result; abort an invalid goal."""
        result, command = GripperCommand.Result(), goal.request.command
        try:
            wanted = command.position / self._world.robot.gripper.max_opening_m
            motion = self._world.move_gripper(wanted, command.max_effort if command.max_effort > 0 else None)
            async for record in published_states(self._node, goal, motion):
                goal.publish_feedback(self._progress(GripperCommand.Feedback(), record, command.position))
            self._progress(result, self._world.record, command.position)
            if goal.is_cancel_requested:
                goal.canceled()
            elif result.reached_goal or result.stalled:
                goal.succeed()
            else:
                self._node.get_logger().warning("gripper goal aborted: the fingers are still moving")
                goal.abort()
        except RoboximError as error:
            self._node.get_logger().warning(f"gripper goal refused: {error.code.name}: {error}")
            goal.abort()
        return result

    def _progress(self, msg: Any, record: StateRecord, wanted_m: float) -> Any:
        """Fill position, effort, stalled and reached_goal of a result or feedback message."""
        gripper = self._world.robot.gripper
        msg.position = record.robot.gripper_opening * gripper.max_opening_m
        msg.effort = _grip_force(record, gripper.links)
        msg.reached_goal = abs(msg.position - wanted_m) <= GRIPPER_TOLERANCE_M
        msg.stalled = not msg.reached_goal and max(map(abs, record.robot.finger_velocities)) < STALL_SPEED_M_S
        return msg


def _tolerances(joints: Sequence[str], given: Sequence[Any], default: Tolerance) -> dict[str, Tolerance]:
    """Return the tolerance of every joint."""
    found = dict.fromkeys(joints, default)
    for msg in given:
        if msg.name not in found:
            raise GoalError(_Result.INVALID_JOINTS, f"a tolerance names joint '{msg.name}', expected of {list(joints)}")
        found[msg.name] = tolerance(msg.name, msg.position, msg.velocity, msg.acceleration, default)
    return found


def _optional_matrix(rows: Sequence[Any], order: list[int], what: str) -> Array | None:
    """Return `_matrix`, or None if no point has values."""
    return _matrix(rows, order, what) if any(len(row) for row in rows) else None


def _matrix(rows: Sequence[Any], order: list[int], what: str) -> Array:
    """Return the points' values, shape (points, joints), with the joints in the model's order."""
    for index, row in enumerate(rows):
        if len(row) != len(order):
            raise InvalidRequestError(
                f"point {index} of the trajectory has {len(row)} {what}, expected one of each joint, {len(order)}",
                ErrorCode.TRAJECTORY_INVALID,
            )
    return np.array([list(row) for row in rows], dtype=float).reshape(len(rows), len(order))[:, order]


def _duration_s(msg: Any) -> float:
    return float(msg.sec + 1e-9 * msg.nanosec)


def _desired(trajectory: JointTrajectory, time_s: float) -> JointStates:
    positions, velocities = trajectory.sample(np.array([time_s])), trajectory.sample_velocities(np.array([time_s]))
    return JointStates(positions=positions[0].tolist(), velocities=velocities[0].tolist())


def _feedback(record: StateRecord, desired: JointStates, time_s: float) -> Any:
    robot = record.robot
    msg = FollowJointTrajectory.Feedback(joint_names=list(robot.joint_names))
    fill_stamp(msg.header.stamp, record.stamp_ns)
    msg.desired.positions, msg.desired.velocities = list(desired.positions), list(desired.velocities)
    msg.actual.positions, msg.actual.velocities = list(robot.joint_positions), list(robot.joint_velocities)
    msg.error.positions = [d - a for d, a in zip(desired.positions, robot.joint_positions, strict=True)]
    msg.error.velocities = [d - a for d, a in zip(desired.velocities, robot.joint_velocities, strict=True)]
    for point in (msg.desired, msg.actual, msg.error):
        fill_stamp(point.time_from_start, round(1e9 * time_s))
    return msg


def _grip_force(record: StateRecord, links: tuple[str, ...]) -> float:
    touching = (c for c in record.contacts if "robot" in (c.body_a, c.body_b))
    return max((c.force_last for c in touching if {c.link_a, c.link_b} & set(links)), default=0.0)
