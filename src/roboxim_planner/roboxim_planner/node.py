"""The planner node: thin services around `pipeline.Planner`."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from roboxim_interfaces.action import PlanMotion
from roboxim_interfaces.msg import MotionRequest
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import (
    CheckState,
    CheckTrajectory,
    ComputeFK,
    ComputeIK,
    PlanCartesian,
    PlanToJoints,
    PlanToPose,
)

from roboxim_core.errors import ErrorCode, InvalidRequestError, RequestTimeoutError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_planner import conversions as convert
from roboxim_planner.paths import Watch
from roboxim_planner.pipeline import MotionOptions, PathIncompleteError, Plan, Planner, PlannerConfig
from roboxim_planner.scene import PlanningScene
from roboxim_planner.tracker import SceneTracker
from roboxim_ros import qos
from roboxim_ros.conversions import fill_pose, from_msg
from roboxim_ros.node import RoboximNode

FEEDBACK_PERIOD_S = 0.1


def _parameter(default: Any, description: str, *limits: float) -> Any:
    metadata: dict[str, Any] = {"description": description}
    if limits:
        metadata["range"] = limits
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class PlannerNodeConfig:
    """Parameters of the planner node."""

    robot: str = _parameter("panda", "id of the robot model that requests without one mean")
    timeout_s: float = _parameter(5.0, "wall-clock limit of requests without one [s]", 0.001, 600.0)
    padding_m: float = _parameter(0.005, "distance that searches keep from obstacles by default [m]", 0.0, 0.1)
    scene_wait_s: float = _parameter(1.0, "longest wait for a scene revision that is still under way [s]", 0.0, 60.0)


@dataclass(frozen=True, kw_only=True)
class _Request:
    """A motion request, checked and converted."""

    planner: Planner
    scene: PlanningScene
    start: Any
    options: MotionOptions
    watch: Watch
    period_s: float
    tcp_poses: bool
    begun: float


class PlannerNode(RoboximNode):
    """Serves ``planner/*``. Requests are answered one at a time; the scene's topics are heard meanwhile."""

    executor_threads = 3
    """One for requests, one for the scene's topics, one for cancelling."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Make the node; see `RoboximNode`."""
        super().__init__("planner", context=context, namespace=namespace, parameters=parameters)
        self._config = self.declare_config(PlannerNodeConfig)
        self._library = ModelLibrary()
        self._planners: dict[str, Planner] = {}
        self._busy = threading.Lock()
        self._planner(self._config.robot)
        self._tracker = SceneTracker(self._library)
        topics = MutuallyExclusiveCallbackGroup()
        self.create_subscription(SceneSpecMsg, "sim/scene", self._on_scene, qos.LATCHED, callback_group=topics)
        self.create_subscription(StateRecordMsg, "sim/state", self._on_state, qos.STATE, callback_group=topics)
        requests = MutuallyExclusiveCallbackGroup()
        for kind, name, handler in (
            (PlanToPose, "plan_to_pose", self._on_plan_to_pose),
            (PlanToJoints, "plan_to_joints", self._on_plan_to_joints),
            (PlanCartesian, "plan_cartesian", self._on_plan_cartesian),
            (ComputeIK, "compute_ik", self._on_compute_ik),
            (ComputeFK, "compute_fk", self._on_compute_fk),
            (CheckState, "check_state", self._on_check_state),
            (CheckTrajectory, "check_trajectory", self._on_check_trajectory),
        ):
            self.serve(kind, f"planner/{name}", self._one_at_a_time(handler), callback_group=requests)
        self._action = ActionServer(
            self,
            PlanMotion,
            "planner/plan_motion",
            execute_callback=self._on_plan_motion,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
            result_timeout=10,
        )

    def destroy_node(self) -> None:
        """Destroy the node."""
        self._action.destroy()
        super().destroy_node()

    def _on_scene(self, msg: SceneSpecMsg, info: dict[str, Any]) -> None:
        self._tracker.scene_arrived(from_msg(msg, SceneSpec), info["source_timestamp"])

    def _on_state(self, msg: StateRecordMsg, info: dict[str, Any]) -> None:
        sent_ns = info["source_timestamp"]
        self._tracker.state_arrived(msg.episode_id, int(msg.seq), lambda: from_msg(msg, StateRecord), sent_ns)

    def _one_at_a_time(self, handler: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def guarded(request: Any, response: Any) -> None:
            with self._busy:
                handler(request, response)

        return guarded

    def _planner(self, robot_id: str) -> Planner:
        robot_id = robot_id or self._config.robot
        if robot_id not in self._planners:
            config = PlannerConfig(padding_m=self._config.padding_m)
            self._planners[robot_id] = Planner(self._library.robot(robot_id), config)
        return self._planners[robot_id]

    def _scene(self, msg: Any) -> PlanningScene:
        """Return a request's scene, waiting a moment for a revision that is still under way."""
        named = None
        if msg.episode_id:
            named = self._tracker.revision(msg.episode_id, int(msg.seq), self._config.scene_wait_s)
        return convert.scene_from_msg(msg, named)

    def _start(self, msg: Any, planner: Planner, scene: PlanningScene, *, what: str = "start_state") -> Any:
        if len(msg.position):
            return convert.joints_from_msg(msg, planner.robot.description, what=what)
        if not scene.joint_command:
            raise InvalidRequestError(f"{what} is empty; it may be only when the scene is named by episode_id and seq")
        return np.array(scene.joint_command)

    def _request(self, msg: MotionRequest, cancelled: Callable[[str, int], None] | None = None) -> _Request:
        begun = time.monotonic()
        timeout = float(msg.timeout) or self._config.timeout_s
        if not (math.isfinite(timeout) and timeout > 0.0):
            raise InvalidRequestError(f"timeout must be a positive number of seconds, got {timeout}")

        def watch(stage: str, iterations: int) -> None:
            if time.monotonic() - begun > timeout:
                raise RequestTimeoutError(
                    f"time out after {timeout:g} s in stage '{stage}', {iterations} iterations; give more time"
                )
            if cancelled is not None:
                cancelled(stage, iterations)

        options = convert.options_from_msg(msg)
        period = convert.sample_period(msg)
        planner = self._planner(msg.robot)
        scene = self._scene(msg.scene)
        start = self._start(msg.start_state, planner, scene)
        return _Request(
            planner=planner, scene=scene, start=start, options=options, watch=watch, period_s=period,
            tcp_poses=bool(msg.with_tcp_poses), begun=begun,
        )  # fmt: skip

    def _answer(self, request: _Request, plan: Plan, response: Any) -> None:
        msg = convert.plan_to_msg(plan, request.planner.robot, request.scene, request.period_s, request.tcp_poses)
        request.watch("answer", 0)
        msg.planning_time = time.monotonic() - request.begun
        response.plan = msg

    def _targets(self, request: _Request, poses: list[Any], frame: str) -> list[Pose]:
        start = request.planner.robot.check_joints(request.start, what="start_state")
        robot, base = request.planner.robot, request.scene.robot_pose
        return [convert.pose_in_world(pose, frame, robot, base, start) for pose in poses]

    def _on_plan_to_pose(self, msg: PlanToPose.Request, response: PlanToPose.Response) -> None:
        response.goal_index = -1
        request = self._request(msg.request)
        poses = [msg.target.pose, *msg.alternatives]
        plan = self._to_pose(request, poses, msg.target.header.frame_id)
        self._answer(request, plan, response)
        response.goal_index = plan.goal_index

    def _to_pose(self, request: _Request, poses: list[Any], frame: str) -> Plan:
        targets = self._targets(request, poses, frame)
        return request.planner.plan_to_pose(request.scene, request.start, targets, request.options, request.watch)

    def _on_plan_to_joints(self, msg: PlanToJoints.Request, response: PlanToJoints.Response) -> None:
        request = self._request(msg.request)
        self._answer(request, self._to_joints(request, msg.target, msg.named_state), response)

    def _to_joints(self, request: _Request, target: Any, named_state: str) -> Plan:
        planner = request.planner
        if len(target.position):
            goal = convert.joints_from_msg(target, planner.robot.description, what="target")
        elif named_state:
            goal = planner.named_state(named_state)
        else:
            raise InvalidRequestError("give a target or a named_state")
        return planner.plan_to_joints(request.scene, request.start, goal, request.options, request.watch)

    def _on_plan_cartesian(self, msg: PlanCartesian.Request, response: PlanCartesian.Response) -> None:
        request = self._request(msg.request)
        self._answer_cartesian(request, msg, response)

    def _answer_cartesian(self, request: _Request, msg: Any, response: Any) -> None:
        """Answer with the plan; a line that ends early answers with its part and an error."""
        targets = [t for p in msg.waypoints for t in self._targets(request, [p.pose], p.header.frame_id)]
        try:
            plan = request.planner.plan_cartesian(
                request.scene,
                request.start,
                targets,
                request.options,
                min_fraction=float(msg.min_fraction) or 1.0,
                ignore_collisions=bool(msg.ignore_collisions),
                watch=request.watch,
            )
        except PathIncompleteError as error:
            self._answer(request, error.partial, response)
            raise
        self._answer(request, plan, response)

    def _on_compute_ik(self, msg: ComputeIK.Request, response: ComputeIK.Response) -> None:
        planner = self._planner(msg.robot)
        robot = planner.robot.description
        scene = self._scene(msg.scene)
        near = np.array(robot.home)
        if len(msg.seed_state.position):
            near = convert.joints_from_msg(msg.seed_state, robot, what="seed_state")
        target = convert.pose_in_world(msg.target.pose, msg.target.header.frame_id, planner.robot, scene.robot_pose)
        solutions = planner.inverse_kinematics(
            target,
            near,
            scene=scene if msg.avoid_collisions else None,
            robot_pose=scene.robot_pose,
            count=int(msg.max_solutions) or 1,
            seed=int(msg.seed),
        )
        response.solutions = [convert.joints_to_msg(q, robot) for q in solutions]

    def _on_compute_fk(self, msg: ComputeFK.Request, response: ComputeFK.Response) -> None:
        planner = self._planner(msg.robot)
        robot = planner.robot
        joints = robot.check_joints(convert.joints_from_msg(msg.state, robot.description, what="state"), what="state")
        base = convert.optional_pose(msg.robot_pose_in_world)
        links = list(msg.links) or [robot.description.tcp_link]
        poses = [base @ robot.fk(joints, link) for link in links]
        for pose in poses:
            stamped = PoseStamped()
            stamped.header.frame_id = convert.WORLD
            fill_pose(stamped.pose, pose)
            response.poses.append(stamped)
        response.links = links

    def _on_check_state(self, msg: CheckState.Request, response: CheckState.Response) -> None:
        planner = self._planner(msg.robot)
        scene = self._scene(msg.scene)
        finding = planner.check_state(scene, self._start(msg.state, planner, scene, what="state"))
        response.valid = finding.valid
        response.contacts = [convert.contact_to_msg(contact) for contact in finding.contacts]
        response.violations = list(finding.violations)

    def _on_check_trajectory(self, msg: CheckTrajectory.Request, response: CheckTrajectory.Response) -> None:
        response.first_invalid_index = -1
        planner = self._planner(msg.request.robot)
        scene = self._scene(msg.request.scene)
        arrays = convert.trajectory_from_msg(msg.trajectory, planner.robot.description)
        finding = planner.check_trajectory(scene, **arrays, options=convert.options_from_msg(msg.request))
        response.valid = finding.valid
        response.first_invalid_index = finding.index
        response.contacts = [convert.contact_to_msg(contact) for contact in finding.contacts]
        response.violations = list(finding.violations)

    def _on_plan_motion(self, goal: ServerGoalHandle) -> PlanMotion.Result:
        result = PlanMotion.Result(goal_index=-1)
        begun, last = time.monotonic(), 0.0

        def progress(stage: str, iterations: int) -> None:
            nonlocal last
            if goal.is_cancel_requested:
                raise RoboximError(f"cancelled in stage '{stage}'", ErrorCode.CANCELLED)
            now = time.monotonic()
            if now - last > FEEDBACK_PERIOD_S:
                last = now
                goal.publish_feedback(PlanMotion.Feedback(stage=stage, iterations=iterations, elapsed=now - begun))

        with self.answering("planner/plan_motion", result), self._busy:
            self._plan_motion(goal.request, self._request(goal.request.request, progress), result)
        if result.error_code == ErrorCode.CANCELLED and goal.is_cancel_requested:
            goal.canceled()
        elif result.error_code:
            goal.abort()
        else:
            goal.succeed()
        return result

    def _plan_motion(self, msg: PlanMotion.Goal, request: _Request, result: PlanMotion.Result) -> None:
        if msg.kind == PlanMotion.Goal.JOINTS:
            self._answer(request, self._to_joints(request, msg.joint_target, msg.named_state), result)
        elif msg.kind == PlanMotion.Goal.CARTESIAN:
            self._answer_cartesian(request, msg, result)
        elif msg.kind == PlanMotion.Goal.POSE:
            frames = {pose.header.frame_id for pose in msg.waypoints}
            if len(frames) != 1:
                raise InvalidRequestError(f"POSE needs at least one waypoint, all in one frame; got {sorted(frames)}")
            plan = self._to_pose(request, [pose.pose for pose in msg.waypoints], frames.pop())
            self._answer(request, plan, result)
            result.goal_index = plan.goal_index
        else:
            raise InvalidRequestError(f"kind must be POSE (0), JOINTS (1) or CARTESIAN (2), got {msg.kind}")
