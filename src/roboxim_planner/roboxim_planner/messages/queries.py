"""Converts requests of services and actions to queries, and answers back."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Pose as PoseMsg
from sensor_msgs.msg import JointState

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.messages.conversions import (
    TCP,
    WORLD,
    joints_from_msg,
    limited,
    naming,
    optional_pose,
    options_from_msg,
    plan_to_msg,
    pose_in_world,
    sample_period,
    trajectory_from_msg,
)
from roboxim_planner.messages.scenes import allowed_from_msg, opening_from_msg, scene_from_msg
from roboxim_planner.motions.retime import DEFAULT_TOLERANCE_RAD
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.queries import (
    Answer,
    IkQuery,
    JointsQuery,
    LineQuery,
    PoseQuery,
    Query,
    RetimeQuery,
    SequenceQuery,
)
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene
from roboxim_planner.sequence import Stage, StageGoal

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Common:
    """The common part of all motion requests, checked and converted."""

    planner: Planner
    """Planner of the robot."""
    scene: PlanningScene
    """Scene whose bodies to avoid."""
    start: Array | None
    """Arm joints at the start, shape (dof,) [rad]; none: the request needs no start."""
    options: MotionOptions
    """Limits, padding, seed."""
    period_s: float
    """Time between the points of the answer [s]."""
    tcp_poses: bool
    """Whether the answer includes the TCP's poses."""

    def target(self, msg: Any, frame: str, what: str) -> Pose:
        """Return a goal of the TCP in the world; ``what`` is its name in error messages."""
        return pose_in_world(msg, frame, self.planner.robot, self.scene.robot_pose, self.start, what=what)

    def fields(self) -> dict[str, Any]:
        """Return the fields that every query has."""
        start = () if self.start is None else tuple(self.start.tolist())
        robot = self.planner.robot.description.id
        return {"robot": robot, "scene": self.scene, "start": start, "options": self.options}


def start_from_msg(msg: JointState, robot: PlannerRobot, scene: PlanningScene, *, what: str = "start_state") -> Array:
    """Return a request's start configuration; if empty, the joint command of the scene's revision.

    Raises:
        InvalidRequestError: If it does not match the robot, or is empty without a revision.
    """
    if len(msg.position):
        return robot.check_joints(joints_from_msg(msg, robot.description, what=what), what=what)
    if not scene.joint_command:
        raise InvalidRequestError(f"{what} is empty, which is allowed only if episode_id and seq name the scene")
    return robot.check_joints(scene.joint_command, what=what)


def pose_query(common: Common, poses: Sequence[Any], frame: str) -> Query:
    """Return the query of a motion to any of several poses in a frame."""
    targets = tuple(common.target(pose, frame, _numbered("target", k, len(poses))) for k, pose in enumerate(poses))
    return PoseQuery(**common.fields(), targets=targets)


def _numbered(what: str, index: int, count: int) -> str:
    return what if count == 1 else f"{what} {index + 1} of {count}"


def joints_query(common: Common, target: JointState, named_state: str) -> Query:
    """Return the query of a motion to joint positions or a named state."""
    return JointsQuery(**common.fields(), goal=_joint_goal(common.planner, target, named_state))


def _joint_goal(planner: Planner, target: JointState, named_state: str) -> tuple[float, ...]:
    if len(target.position):
        goal = joints_from_msg(target, planner.robot.description, what="target")
        return tuple(planner.robot.check_joints(goal, what="target").tolist())
    if named_state:
        return tuple(planner.named_state(named_state).tolist())
    raise InvalidRequestError("give a target or a named_state")


def line_query(common: Common, msg: Any) -> Query:
    """Return the query of straight lines; ``msg`` is a request or goal with ``waypoints``."""
    return LineQuery(
        **common.fields(),
        waypoints=tuple(
            common.target(stamped.pose, stamped.header.frame_id, _numbered("waypoint", k, len(msg.waypoints)))
            for k, stamped in enumerate(msg.waypoints)
        ),
        min_fraction=float(msg.min_fraction) or 1.0,
        ignore_collisions=bool(msg.ignore_collisions),
    )


MAKERS: dict[str, Callable[[Common, Any], Query]] = {
    "plan_to_pose": lambda common, msg: pose_query(
        common, [msg.target.pose, *msg.alternatives], msg.target.header.frame_id
    ),
    "plan_to_joints": lambda common, msg: joints_query(common, msg.target, msg.named_state),
    "plan_cartesian": lambda common, msg: line_query(common, msg),
    "plan_sequence": lambda common, msg: sequence_query(common, msg.stages),
    "retime_path": lambda common, msg: retime_query(common, msg),
    "plan_motion": lambda common, msg: motion_query(common, msg),
}
"""Service name to the function that makes the query of its request or action goal; all of these have ``request``."""


def common_from_msg(msg: Any, planner: Planner, scene: PlanningScene, *, with_start: bool) -> Common:
    """Check and convert a ``MotionRequest``.

    Args:
        msg: The message.
        planner: Planner of the request's robot.
        scene: Scene of the request.
        with_start: Whether the request needs a start.
    """
    options, period = options_from_msg(msg), sample_period(msg)
    start = start_from_msg(msg.start_state, planner.robot, scene) if with_start else None
    return Common(
        planner=planner, scene=scene, start=start, options=options, period_s=period, tcp_poses=msg.with_tcp_poses
    )


def query_without_graph(service: str, msg: Any, library: ModelLibrary) -> tuple[Query, Planner]:
    """Return the query of a service's request and a planner for it, without a node.

    Args:
        service: One of `MAKERS`.
        msg: The request; without a robot, it is for the panda.
        library: Source of robots and objects.

    Raises:
        InvalidRequestError: If the request names a scene that only a running graph has, or is malformed.
    """
    request = msg.request
    if request.scene.episode_id:
        raise InvalidRequestError("a scene named by episode_id needs a running graph; give the objects in the request")
    planner = Planner(library.robot(request.robot or "panda"))
    scene = scene_from_msg(request.scene, None, library)
    common = common_from_msg(request, planner, scene, with_start=service != "retime_path")
    return MAKERS[service](common, msg), planner


def motion_query(common: Common, msg: Any) -> Query:
    """Return the query of a ``PlanMotion`` goal.

    Raises:
        InvalidRequestError: On an unknown kind, or goals in several frames.
    """
    if msg.kind == msg.JOINTS:
        return joints_query(common, msg.joint_target, msg.named_state)
    if msg.kind == msg.CARTESIAN:
        return line_query(common, msg)
    if msg.kind != msg.POSE:
        raise InvalidRequestError(f"kind must be POSE (0), JOINTS (1) or CARTESIAN (2), got {msg.kind}")
    frames = {pose.header.frame_id or WORLD for pose in msg.waypoints}
    if len(frames) != 1:
        raise InvalidRequestError(f"POSE needs at least one waypoint, all in one frame; got {sorted(frames)}")
    return pose_query(common, [pose.pose for pose in msg.waypoints], frames.pop())


def sequence_query(common: Common, stages: Sequence[Any]) -> Query:
    """Return the query of a sequence of ``MotionStage``."""
    made = tuple(_stage(common, msg, msg.name or str(k)) for k, msg in enumerate(stages, start=1))
    return SequenceQuery(**common.fields(), stages=made)


def _stage(common: Common, msg: Any, name: str) -> Stage:
    kinds = {msg.POSE: "pose", msg.JOINTS: "joints", msg.CARTESIAN: "cartesian"}
    if msg.kind not in kinds:
        raise InvalidRequestError(f"stage '{name}': kind must be POSE (0), JOINTS (1) or CARTESIAN (2), got {msg.kind}")
    kind = kinds[msg.kind]
    with naming(f"stage '{name}'"):
        joints = _joint_goal(common.planner, msg.joint_target, msg.named_state) if kind == "joints" else ()
    return Stage(
        kind=kind,
        name=name,
        goals=tuple(
            _stage_goal(common, stamped, bool(msg.relative), f"stage '{name}': {_numbered('goal', k, len(msg.goals))}")
            for k, stamped in enumerate(msg.goals)
        ),
        joints=joints,
        min_fraction=float(msg.min_fraction) or 1.0,
        ignore_collisions=bool(msg.ignore_collisions),
        attach=tuple(msg.attach),
        detach=tuple(msg.detach),
        gripper_opening=opening_from_msg(msg),
        allowed=allowed_from_msg(msg),
        options=limited(common.options, msg),
    )


def _stage_goal(common: Common, stamped: Any, relative: bool, what: str) -> StageGoal:
    frame = stamped.header.frame_id
    msg = stamped.pose
    if relative and not any((msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w)):
        msg = PoseMsg(position=msg.position)  # no rotation
    if frame == TCP:
        return StageGoal(pose=optional_pose(msg, what=what), frame=TCP)
    if not relative:
        return StageGoal(pose=common.target(msg, frame, what))
    axes = replace(common.target(PoseMsg(), frame, what), position=(0.0, 0.0, 0.0))  # the frame's axes in the world
    return StageGoal(pose=axes @ optional_pose(msg, what=what) @ axes.inverse(), relative=True)


def retime_query(common: Common, msg: Any) -> Query:
    """Return the query of a ``RetimePath`` request."""
    path = trajectory_from_msg(msg.path, common.planner.robot.description)["positions"]
    assert path is not None
    return RetimeQuery(
        **common.fields(),
        path=tuple(tuple(row) for row in path.tolist()),
        tolerance_rad=float(msg.path_tolerance) or DEFAULT_TOLERANCE_RAD,
        stop_at_points=bool(msg.stop_at_points),
        check_collisions=bool(msg.check_collisions),
    )


def ik_query(planner: Planner, scene: PlanningScene, msg: Any) -> Query:
    """Return the query of a ``ComputeIK`` request.

    Raises:
        InvalidRequestError: On an unknown mode or a seed state that does not match the robot.
        PlannerError: ``UNKNOWN_FRAME``.
    """
    modes = {msg.NEAREST: "nearest", msg.ANY: "any", msg.ALL: "all"}
    if msg.mode not in modes:
        raise InvalidRequestError(f"mode must be NEAREST (0), ANY (1) or ALL (2), got {msg.mode}")
    robot = planner.robot
    reference = planner.named_state("home")
    if len(msg.seed_state.position):
        given = joints_from_msg(msg.seed_state, robot.description, what="seed_state")
        reference = robot.check_joints(given, what="seed_state")
    return IkQuery(
        robot=robot.description.id,
        scene=scene,
        start=tuple(reference.tolist()),
        options=MotionOptions(seed=int(msg.seed)),
        target=pose_in_world(msg.target.pose, msg.target.header.frame_id, robot, scene.robot_pose),
        mode=modes[msg.mode],
        count=int(msg.max_solutions) or (0 if msg.mode == msg.ALL else 1),
        avoid_collisions=bool(msg.avoid_collisions),
    )


def fill_answer(response: Any, answer: Answer, common: Common, begun: float) -> None:
    """Put plans into a response that has ``plan`` (and perhaps ``goal_index``), or ``plans`` and ``goal_indices``.

    Args:
        response: Service response or action result.
        answer: Answer of the query.
        common: Common part of the request.
        begun: Time at which the work began, by ``time.monotonic`` [s].

    Raises:
        InvalidRequestError: When the answer would have too many points.
    """
    robot = common.planner.robot
    points = sum(plan.duration / common.period_s for plan in answer.plans)
    if points > limits.TRAJECTORY_POINTS:
        raise InvalidRequestError(
            f"the answer would have {points:.0f} points, {limits.TRAJECTORY_POINTS} are allowed; ask for a longer "
            "sample_period or more speed"
        )
    plans = [plan_to_msg(plan, robot, common.scene, common.period_s, common.tcp_poses) for plan in answer.plans]
    for plan in plans:
        plan.planning_time = time.monotonic() - begun
    if hasattr(response, "plans"):
        response.plans, response.goal_indices = plans, list(answer.goal_indices)
        return
    response.plan = plans[0]
    if hasattr(response, "goal_index"):
        response.goal_index = answer.goal_indices[0]
