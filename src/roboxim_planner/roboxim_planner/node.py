"""The planner node: services and actions around `pipeline.Planner`."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, ParamSpec, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from roboxim_interfaces.action import PlanMotion, PlanSequence
from roboxim_interfaces.msg import MotionRequest
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import (
    CheckState,
    CheckTrajectory,
    ComputeFK,
    ComputeIK,
    GetState,
    PlanCartesian,
    PlanToJoints,
    PlanToPose,
    RetimePath,
)
from roboxim_interfaces.srv import PlanSequence as PlanSequenceSrv
from trajectory_msgs.msg import JointTrajectory

from roboxim_core import limits
from roboxim_core.errors import (
    ErrorCode,
    InvalidRequestError,
    PlannerError,
    RequestTimeoutError,
    RoboximError,
    UnavailableError,
)
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.surroundings import Surroundings
from roboxim_core.user_folders import expanded
from roboxim_planner.dumps import Dump, Outcome, Steps, dump_folder, write_dump
from roboxim_planner.messages import conversions as convert
from roboxim_planner.messages import queries
from roboxim_planner.messages.scenes import scene_from_msg
from roboxim_planner.motions.paths import Watch
from roboxim_planner.pipeline import MotionOptions, PathIncompleteError, Planner, PlannerConfig
from roboxim_planner.queries import Answer, Query, run_query
from roboxim_planner.scene import PlanningScene, SceneMaker
from roboxim_planner.tracker import SceneTracker
from roboxim_ros import qos
from roboxim_ros.clients import wait_until
from roboxim_ros.goal_queue import GoalQueue
from roboxim_ros.local import ticks as local_ticks
from roboxim_ros.local.ticks import LocalTick
from roboxim_ros.messages.conversions import fill_pose, from_msg
from roboxim_ros.node import RoboximNode, ended, parameter
from roboxim_ros.on_demand import OnDemandGroup

P = ParamSpec("P")
R = TypeVar("R")
FEEDBACK_PERIOD_S = 0.1
BUSY_S = 120.0
"""Longest wait of a service for the request before it, e.g. an action with a long time-out [s]."""
SHOWN_S = 0.05
"""Approximate time between the points of ``planner/last_path`` [s]."""
LATEST = "latest"
"""Episode id that stands for the newest state of the sim; for interactive use, since it is not reproducible."""


@dataclass(frozen=True, kw_only=True)
class PlannerNodeConfig:
    """Parameters of the planner node."""

    robot: str = parameter("panda", "id of the robot model for requests that name none")
    timeout_s: float = parameter(30.0, "wall-clock limit for requests that give none [s]", 0.001, limits.WALL_TIME_S)
    padding_m: float = parameter(
        PlannerConfig.padding_m, "distance that searches keep from obstacles by default [m]", 0.0, 0.1
    )
    scene_wait_s: float = parameter(5.0, "longest wait for a scene revision that has not arrived yet [s]", 0.0, 60.0)
    dump_dir: str = parameter("", "folder for dumps of failures; empty: roboxim/planner in the user's cache folder")
    dumps_kept: int = parameter(100, "largest number of dumps in the folder; 0: no dumps are written", 0, 100000)


class PlannerNode(RoboximNode):
    """Serves ``planner/*``. Requests are answered one at a time; the scene's topics are received meanwhile."""

    executor_threads = 3
    """One for services, one for goals, and one for topics and cancelling."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Make the node; see `RoboximNode`."""
        super().__init__("planner", context=context, namespace=namespace, parameters=parameters)
        self._config = self.declare_config(PlannerNodeConfig)
        self._library = ModelLibrary()
        self._planners: dict[str, Planner] = {}
        self._busy = threading.Lock()
        self._scenes = SceneMaker(self._library)
        self._planner(self._config.robot)
        self._tracker = SceneTracker(self._library)
        self.subscribe(
            SceneSpecMsg, "sim/scene", self._on_scene, qos.LATCHED, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._waiting = False
        self._states = OnDemandGroup()  # receives states only when a scene starts and for requests, not at every tick
        self._notices = self.resolve_topic_name("sim/ticks")
        self._taken: LocalTick | None = None
        if not local_ticks.announced(context, self._notices):
            self.subscribe(StateRecordMsg, "sim/state", self._on_state, qos.LATCHED, callback_group=self._states)
        self._last_path = self.create_publisher(JointTrajectory, "planner/last_path", qos.LATCHED)
        requests = MutuallyExclusiveCallbackGroup()
        for kind, name, handler in (
            (PlanToPose, "plan_to_pose", self._planning("plan_to_pose")),
            (PlanToJoints, "plan_to_joints", self._planning("plan_to_joints")),
            (PlanCartesian, "plan_cartesian", self._planning("plan_cartesian")),
            (PlanSequenceSrv, "plan_sequence", self._planning("plan_sequence")),
            (RetimePath, "retime_path", self._planning("retime_path")),
            (ComputeIK, "compute_ik", self._on_compute_ik),
            (ComputeFK, "compute_fk", self._on_compute_fk),
            (CheckState, "check_state", self._on_check_state),
            (CheckTrajectory, "check_trajectory", self._on_check_trajectory),
        ):
            self.serve(kind, f"planner/{name}", self._one_at_a_time(handler), callback_group=requests, inline=True)
        self.offer("planner/check_path", self._one_at_a_time(self._check_path), inline=True)
        goals = GoalQueue()
        self._actions = [
            self.serve_action(kind, f"planner/{name}", execute, queue=goals, callback_group=ReentrantCallbackGroup())
            for kind, name, execute in (
                (PlanMotion, "plan_motion", self._execute_motion),
                (PlanSequence, "plan_sequence", self._execute_sequence),
            )
        ]

    def destroy_node(self) -> None:
        """Destroy the node."""
        for action in self._actions:
            action.destroy()
        super().destroy_node()

    def _on_scene(self, msg: SceneSpecMsg, info: dict[str, Any]) -> None:
        self._tracker.scene_arrived(from_msg(msg, SceneSpec), info["source_timestamp"])
        self._subscribe_state()

    def _on_state(self, msg: StateRecordMsg, info: dict[str, Any]) -> None:
        sent_ns = info["source_timestamp"]
        self._tracker.state_arrived(
            msg.episode_id, int(msg.seq), msg.scene_hash, lambda: from_msg(msg, StateRecord), sent_ns
        )
        if not self._waiting:
            self._states.open = False

    def _revision(self, episode_id: str, seq: int) -> PlanningScene:
        """Return a revision of the scene; wait for it if it has not arrived yet."""
        if episode_id == LATEST:
            return self._latest()
        if local_ticks.announced(self.context, self._notices):
            wait_until(lambda: self._is_shown(episode_id, seq), self._config.scene_wait_s)
            return self._tracker.revision(episode_id, seq)
        self._states.take()
        self._waiting = True
        try:
            if not self._tracker.has(episode_id, seq):
                self._subscribe_state()
            return self._tracker.revision(episode_id, seq, self._config.scene_wait_s)
        finally:
            self._waiting = self._states.open = False

    def _is_shown(self, episode_id: str, seq: int) -> bool:
        """Take the newest state of a sim of this process; return whether the tracker can answer for a revision."""
        tick = local_ticks.newest(self.context, self._notices)
        if tick is not None and tick is not self._taken:
            self._taken, state = tick, tick.state
            self._tracker.state_arrived(state.episode_id, state.seq, state.scene_hash, lambda: state, time.time_ns())
        return self._tracker.knows(episode_id, seq)

    def _latest(self) -> PlanningScene:
        """Request the newest state from the sim, because the last one received on the topics may be older."""
        wait_s = self._config.scene_wait_s
        try:
            answer = self.clients_of_node.call(GetState, "sim/get_state", GetState.Request(), wait_s=wait_s)
        except (UnavailableError, RequestTimeoutError) as error:
            raise PlannerError(f"no latest scene: {error}", ErrorCode.STALE_SCENE) from None
        return PlanningScene.from_state(
            from_msg(answer.scene, SceneSpec), from_msg(answer.state, StateRecord), self._library
        )

    def _subscribe_state(self) -> None:
        self._states.open = True
        if self.executor is not None:
            self.executor.wake()

    def _one_at_a_time(self, handler: Callable[P, R]) -> Callable[P, R]:
        def guarded(*given: P.args, **named: P.kwargs) -> R:
            if not self._busy.acquire(timeout=BUSY_S):
                raise RequestTimeoutError(f"the planner has been busy with another request for {BUSY_S:g} s")
            try:
                return handler(*given, **named)
            finally:
                self._busy.release()

        return guarded

    def _planner(self, robot_id: str) -> Planner:
        robot_id = robot_id or self._config.robot
        if robot_id not in self._planners:
            config = PlannerConfig(padding_m=self._config.padding_m)
            planner = Planner(self._library.robot(robot_id), config)
            home = planner.named_state("home")
            near = np.clip(home + 1e-3, planner.robot.lower, planner.robot.upper)
            with contextlib.suppress(PlannerError):  # a first plan builds everything that is built on first use
                planner.plan_to_joints(PlanningScene(), home, near)
            self._planners[robot_id] = planner
        return self._planners[robot_id]

    def _scene(self, msg: Any) -> PlanningScene:
        """Return a request's scene; wait up to ``scene_wait_s`` for a revision that has not arrived yet."""
        named = None
        if msg.episode_id:
            named = self._revision(msg.episode_id, int(msg.seq))
        return scene_from_msg(msg, named, self._library)

    def _planner_and_scene(self, robot_id: str, msg: Any) -> tuple[Planner, PlanningScene]:
        """Return a request's scene and the planner of its robot; no robot: the named scene's, or the node's parameter.

        Raises:
            InvalidRequestError: If the request names another robot than its scene has.
        """
        scene = self._scene(msg)
        if scene.robot and robot_id and robot_id != scene.robot:
            raise InvalidRequestError(
                f"the scene's robot is '{scene.robot}', the request's '{robot_id}'; leave the request's empty"
            )
        return self._planner(robot_id or scene.robot), scene

    def _plan(
        self,
        msg: MotionRequest,
        make: Callable[[queries.Common], Query],
        response: Any,
        *,
        with_start: bool = True,
        progress: Callable[[str, int], None] = lambda *_: None,
        entered: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Answer a motion request.

        Args:
            msg: Common part of the motion requests.
            make: Makes the query from the checked common part.
            response: Filled with the plan or plans; a line that ends early gives its executable part and an error.
            with_start: Whether the request needs a start.
            progress: Called with stage and iterations; raises to cancel.
            entered: Called with the index of the stage of a sequence that is being planned.
        """
        begun = time.monotonic()
        watch = self._watch(float(msg.timeout), progress)
        planner, scene = self._planner_and_scene(msg.robot, msg.scene)
        common = queries.common_from_msg(msg, planner, scene, with_start=with_start)
        try:
            answer = self._run(common.planner, make(common), watch, entered)
        except PathIncompleteError as error:
            queries.fill_answer(response, Answer(plans=(error.partial,), goal_indices=(-1,)), common, begun)
            raise
        queries.fill_answer(response, answer, common, begun)
        if answer.plans:
            self._show(planner, np.concatenate([plan.sample(SHOWN_S).positions for plan in answer.plans]), SHOWN_S)

    def _show(self, planner: Planner, path: Array, period_s: float) -> None:
        """Publish the joint path of the newest motion, shape (N, dof) [rad], for viewers."""
        step = max(1, round(SHOWN_S / period_s))
        rows = np.concatenate([path[:-1:step], path[-1:]])
        self._last_path.publish(convert.path_to_msg(rows, step * period_s, planner.robot.description))

    def _watch(self, timeout_s: float, progress: Callable[[str, int], None] = lambda *_: None) -> Watch:
        """Return a watch that ends a request after a time.

        Args:
            timeout_s: Longest time from now [s]; 0: the node's parameter.
            progress: Called with stage and iterations as well.

        Raises:
            InvalidRequestError: When the time is out of range.
        """
        timeout = timeout_s or self._config.timeout_s
        limits.require_range("timeout", timeout, 0.0, limits.WALL_TIME_S)
        deadline = time.monotonic() + timeout

        def watch(stage: str, iterations: int) -> None:
            if time.monotonic() > deadline:
                raise RequestTimeoutError(
                    f"time out after {timeout:g} s in stage '{stage}', {iterations} iterations; increase the timeout"
                )
            progress(stage, iterations)

        return watch

    def _run(
        self,
        planner: Planner,
        query: Query,
        watch: Callable[[str, int], None],
        entered: Callable[[int], None] = lambda _: None,
    ) -> Answer:
        """Run a query; write a dump if a well-formed query fails, and append the dump's name to the message."""
        steps = Steps(watch)
        try:
            return run_query(query, planner, steps, entered)
        except RoboximError as error:
            if error.code not in (ErrorCode.CANCELLED, ErrorCode.INVALID_REQUEST):
                error.args = (f"{error}{self._dump(planner, query, str(error), error.code, steps.count)}",)
            raise
        except Exception as error:
            message = "".join(traceback.format_exception_only(error)).strip()
            self.get_logger().error(f"{message}{self._dump(planner, query, message, ErrorCode.INTERNAL, steps.count)}")
            raise

    def _dump(self, planner: Planner, query: Query, message: str, code: ErrorCode, steps: int) -> str:
        """Write a dump of a failure and return the text that names it, empty if there is no dump."""
        if not self._config.dumps_kept:
            return ""
        dump = Dump(
            query=query,
            outcome=Outcome(error_code=int(code), error_msg=message, steps=steps),
            config=planner.config,
            robot_digest=self._library.digest(query.robot),
        )
        folder = expanded(self._config.dump_dir) if self._config.dump_dir else dump_folder()
        name = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{query.kind}-{code.name.lower()}-{os.getpid()}"
        try:
            path = write_dump(dump, folder, name, kept=self._config.dumps_kept)
        except OSError as error:
            self.get_logger().warning(f"cannot write the dump of a failed request to {folder}: {error}")
            return ""
        return f"; dump: {path}"

    def _planning(self, name: str) -> Callable[[Any, Any], None]:
        """Return the handler of a planning service, one of `queries.MAKERS`."""
        make = queries.MAKERS[name]

        def handler(msg: Any, response: Any) -> None:
            if hasattr(response, "goal_index"):
                response.goal_index = -1
            self._plan(msg.request, lambda common: make(common, msg), response, with_start=name != "retime_path")

        return handler

    def _on_compute_ik(self, msg: ComputeIK.Request, response: ComputeIK.Response) -> None:
        watch = self._watch(0.0)
        planner, scene = self._planner_and_scene(msg.robot, msg.scene)
        query = queries.ik_query(planner, scene, msg)
        answer = self._run(planner, query, watch)
        response.solutions = [convert.joints_to_msg(q, planner.robot.description) for q in answer.solutions]

    def _on_compute_fk(self, msg: ComputeFK.Request, response: ComputeFK.Response) -> None:
        planner = self._planner(msg.robot)
        robot = planner.robot
        joints = robot.check_joints(convert.joints_from_msg(msg.state, robot.description, what="state"), what="state")
        fingers = convert.fingers_from_msg(msg.state, robot.description)
        base = convert.optional_pose(msg.robot_pose_in_world, what="robot_pose_in_world")
        links = list(msg.links) or [robot.description.tcp_link]
        poses = [base @ robot.fk(joints, link, fingers) for link in links]
        for pose in poses:
            stamped = PoseStamped()
            stamped.header.frame_id = convert.WORLD
            fill_pose(stamped.pose, pose)
            response.poses.append(stamped)
        response.links = links

    def _on_check_state(self, msg: CheckState.Request, response: CheckState.Response) -> None:
        planner, scene = self._planner_and_scene(msg.robot, msg.scene)
        state = queries.start_from_msg(msg.state, planner.robot, scene, what="state")
        finding = planner.check_state(scene, state)
        response.valid = finding.valid
        response.contacts = [convert.contact_to_msg(contact) for contact in finding.contacts]
        response.violations = list(finding.violations)

    def _on_check_trajectory(self, msg: CheckTrajectory.Request, response: CheckTrajectory.Response) -> None:
        response.first_invalid_index = -1
        watch = self._watch(float(msg.request.timeout))
        planner, scene = self._planner_and_scene(msg.request.robot, msg.request.scene)
        arrays = convert.trajectory_from_msg(msg.trajectory, planner.robot.description)
        finding = planner.check_trajectory(scene, **arrays, options=convert.options_from_msg(msg.request), watch=watch)
        response.valid = finding.valid
        response.first_invalid_index = finding.index
        response.contacts = [convert.contact_to_msg(contact) for contact in finding.contacts]
        response.violations = list(finding.violations)

    def _check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return the fault of a joint path; empty when it is valid. The path has shape (N, dof) [rad]."""
        watch = self._watch(0.0)
        planner = self._planner(around.scene.robot.model)
        times, options = np.arange(len(path)) * period_s, MotionOptions(padding_m=around.padding_m)
        finding = planner.check_trajectory(self._scenes.scene(around), path, times, options=options, watch=watch)
        if finding.valid:
            self._show(planner, path, period_s)
        return "" if finding.valid else str(finding)

    def _execute_motion(self, goal: ServerGoalHandle) -> PlanMotion.Result:
        return self._execute(goal, "plan_motion", PlanMotion.Result(goal_index=-1), PlanMotion.Feedback())

    def _execute_sequence(self, goal: ServerGoalHandle) -> PlanSequence.Result:
        feedback = PlanSequence.Feedback()

        def entered(index: int) -> None:
            feedback.stage_index = index

        return self._execute(goal, "plan_sequence", PlanSequence.Result(), feedback, entered)

    def _execute(
        self,
        goal: ServerGoalHandle,
        name: str,
        result: Any,
        feedback: Any,
        entered: Callable[[int], None] = lambda _: None,
    ) -> Any:
        begun, last = time.monotonic(), 0.0

        def progress(stage: str, iterations: int) -> None:
            nonlocal last
            if goal.is_cancel_requested:
                raise RoboximError(f"cancelled in stage '{stage}'", ErrorCode.CANCELLED)
            now = time.monotonic()
            if now - last > FEEDBACK_PERIOD_S:
                last = now
                feedback.stage, feedback.iterations, feedback.elapsed = stage, iterations, now - begun
                goal.publish_feedback(feedback)

        make, msg = queries.MAKERS[name], goal.request
        with self.answering(f"planner/{name}", result), self._busy:
            self._plan(msg.request, lambda common: make(common, msg), result, progress=progress, entered=entered)
        return ended(goal, result)
