"""The graph that the fuzzer sends requests to, and valid requests to each of its services and actions."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ANSWER_S = 90.0
"""Longest wait for an answer, generous for a busy machine."""
EPISODE_S = 300.0
"""Longest wait for an episode, generous for a busy machine."""
STOP_AFTER_S = 3.0
"""Duration after which goals and steps are cancelled [s]."""


@dataclass
class Live:
    """A graph in a separate process, and its clients in this one."""

    clients: Any
    process: subprocess.Popen[bytes]
    folder: Path

    def rss_mib(self) -> float:
        """Return the resident memory of the graph's process [MiB]."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024  # type: ignore[index]

    def call(self, kind: Any, name: str, request: Any, timeout_s: float = ANSWER_S) -> Any:
        """Call a service and return its response, successful or not."""
        return self.clients.call(kind, name, request, timeout_s=timeout_s, check=False)


@contextlib.contextmanager
def live_graph(folder: Path) -> Iterator[Live]:
    """Start a whole graph, with the random policy, in a separate process."""
    from roboxim_bringup.graph import GraphConfig, PolicyLaunch
    from roboxim_bringup.process import spawn, stop
    from roboxim_core.config import to_json
    from roboxim_ros.clients import Clients, wait_until
    from roboxim_ros.host import NodeHost
    from roboxim_ros.runs import activate_transport, free_domain

    parameters: dict[str, dict[str, Any]] = {
        "sim": {"renderer": "tiny", "motion_timeout_s": 20.0},
        "tasks": {"visible": False, "planner_timeout_s": 20.0},
        "planner": {"dumps_kept": 0},
        "recorder": {"output_root": str(folder)},
        "evaluator": {"service_timeout_s": STOP_AFTER_S},
    }
    config = GraphConfig(parameters=parameters, policies=(PolicyLaunch(spec="random"),))
    activate_transport()
    with free_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with open(folder / "graph.log", "wb") as log:
            process = spawn("roboxim_bringup.worker", [to_json(config)], output=log)
        try:
            with NodeHost(domain_id=domain) as host, Clients("fuzzer", context=host.context) as clients:
                found = wait_until(lambda: "evaluator" in clients.node.get_node_names(), 120.0)
                assert found, (folder / "graph.log").read_text()[-3000:]
                yield Live(clients, process, folder)
        finally:
            stop([process])


def corpus(live: Live) -> dict[str, Callable[[], Any]]:
    """Return functions that create valid requests, by service or action; they query the graph for values."""
    from control_msgs.action import FollowJointTrajectory, GripperCommand
    from roboxim_interfaces import action, srv
    from roboxim_interfaces.msg import EpisodeResult, RunConfig
    from simulation_interfaces.action import SimulateSteps
    from simulation_interfaces.srv import GetEntityState, SetEntityState, SpawnEntity, StepSimulation
    from trajectory_msgs.msg import JointTrajectoryPoint

    draw = live.call(
        srv.GenerateEpisode, "tasks/generate_episode", srv.GenerateEpisode.Request(run_seed=1, purpose="test")
    )
    assert draw.error_code == 0, draw.error_msg
    scene, task = draw.scene, draw.task
    for camera in scene.cameras:
        camera.width = camera.height = 32
    loaded = live.call(srv.LoadScene, "sim/load_scene", srv.LoadScene.Request(scene=scene, episode_id="fuzz"))
    assert loaded.error_code == 0, loaded.error_msg
    state = loaded.state
    snapshot = live.call(srv.TakeSnapshot, "sim/take_snapshot", srv.TakeSnapshot.Request()).snapshot_json
    live.call(srv.ReleaseEpisode, "sim/release_episode", srv.ReleaseEpisode.Request())
    joints, home = list(state.robot.joint_names), list(state.robot.joint_positions)
    motion = _motion(joints, home)
    near = [position + 0.05 for position in home]
    planned = live.call(srv.PlanToJoints, "planner/plan_to_joints", _to_joints(srv, motion, joints, near))
    assert planned.error_code == 0, planned.error_msg
    step = FollowJointTrajectory.Goal()
    step.trajectory.joint_names = joints
    step.trajectory.points = [JointTrajectoryPoint(positions=near)]
    step.trajectory.points[0].time_from_start.sec = 1
    grip = GripperCommand.Goal()
    grip.command.position = 0.04
    folder = str(live.folder / "bags")
    opened = srv.OpenEpisode.Request(output_dir=folder, info=_episode_info(task, scene))
    config = RunConfig(
        run_seed=1, purpose="test", actor="policy", image_width=32, image_height=32, max_steps=3, settle_ticks=1,
        output_dir=folder, keep="none",
    )  # fmt: skip
    spawn = SpawnEntity.Request(name="new_cube", allow_renaming=True)
    spawn.entity_resource.uri = "cube"
    spawn.initial_pose.pose.position.x, spawn.initial_pose.pose.position.z = 0.5, 0.3
    entity = state.entities[0].name
    cartesian, sequence = _cartesian(srv, motion), _sequence(srv, motion, joints, near)
    window = srv.Act.Request(episode_id="fuzz", instruction=task.instruction)
    requests: dict[str, Any] = {
        "sim/load_scene": srv.LoadScene.Request(scene=scene, episode_id=""),
        "sim/tick": srv.Tick.Request(episode_id="", seq=1, action=[0.0] * 7),
        "sim/restore_snapshot": srv.RestoreSnapshot.Request(snapshot_json=snapshot),
        "sim/render_state": srv.RenderState.Request(scene=scene, state=state),
        "sim/step_simulation": StepSimulation.Request(steps=24),
        "sim/get_entity_state": GetEntityState.Request(entity=entity),
        "sim/set_entity_state": SetEntityState.Request(entity=entity),
        "sim/spawn_entity": spawn,
        "sim/simulate_steps": SimulateSteps.Goal(steps=24),
        "arm_controller/follow_joint_trajectory": step,
        "gripper_controller/gripper_cmd": grip,
        "planner/plan_to_joints": _to_joints(srv, motion, joints, near),
        "planner/plan_cartesian": cartesian,
        "planner/plan_sequence": sequence,
        "action planner/plan_sequence": action.PlanSequence.Goal(request=sequence.request, stages=sequence.stages),
        "recorder/open_episode": opened,
        "recorder/close_episode": srv.CloseEpisode.Request(result=EpisodeResult(episode_id="fuzz"), keep="drop"),
        "planner/retime_path": _retime(srv, motion, joints, home, near),
        "planner/check_trajectory": srv.CheckTrajectory.Request(request=motion, trajectory=planned.plan.trajectory),
        "tasks/generate_episode": srv.GenerateEpisode.Request(run_seed=1, purpose="test"),
        "tasks/judge": srv.Judge.Request(episode_id="fuzz", task=[task], state=state),
        "expert/reset_policy": srv.ResetPolicy.Request(
            episode_id="fuzz", instruction=task.instruction, task=[task], scene=[scene]
        ),
        "policy/reset_policy": srv.ResetPolicy.Request(episode_id="fuzz", instruction=task.instruction),
        "expert/act": window,
        "policy/act": window,
        "evaluator/run_episodes": srv.RunEpisodes.Request(config=config, indices=[0]),
        "action evaluator/run_episodes": action.RunEpisodes.Goal(config=config, indices=[0]),
    }
    for name, cls in (("plan_to_pose", srv.PlanToPose), ("compute_ik", srv.ComputeIK)):
        request = cls.Request()
        with contextlib.suppress(AttributeError):
            request.request = motion
        with contextlib.suppress(AttributeError):
            request.target.pose.position.x, request.target.pose.position.z = 0.5, 0.4
            request.target.pose.orientation.x, request.target.pose.orientation.w = 1.0, 0.0
        requests[f"planner/{name}"] = request
    return {name: (lambda request=request: deepcopy(request)) for name, request in requests.items()}


def _motion(joints: list[str], home: list[float]) -> Any:
    from roboxim_interfaces.msg import MotionRequest

    motion = MotionRequest(robot="panda", timeout=2.0)
    motion.start_state.name, motion.start_state.position = joints, home
    return motion


def _to_joints(srv: Any, motion: Any, joints: list[str], positions: list[float]) -> Any:
    request = srv.PlanToJoints.Request(request=deepcopy(motion))
    for goal in ("target", "goal", "goal_state"):
        if hasattr(request, goal):
            state = getattr(request, goal)
            state.name, state.position = joints, positions
    return request


def _cartesian(srv: Any, motion: Any) -> Any:
    """Return a request for a line of 5 cm down from the start."""
    from geometry_msgs.msg import PoseStamped

    waypoint = PoseStamped()
    waypoint.header.frame_id = "tcp"
    waypoint.pose.position.z, waypoint.pose.orientation.w = 0.05, 1.0
    return srv.PlanCartesian.Request(request=deepcopy(motion), waypoints=[waypoint])


def _sequence(srv: Any, motion: Any, joints: list[str], positions: list[float]) -> Any:
    """Return a request for a motion to joint positions and a line from there."""
    from roboxim_interfaces.msg import MotionStage

    free = MotionStage(kind=MotionStage.JOINTS, name="free")
    free.joint_target.name, free.joint_target.position = joints, positions
    line = MotionStage(kind=MotionStage.CARTESIAN, name="line", goals=_cartesian(srv, motion).waypoints)
    return srv.PlanSequence.Request(request=deepcopy(motion), stages=[free, line])


def _episode_info(task: Any, scene: Any) -> Any:
    from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg

    from roboxim_core.actions import ActionSemantics
    from roboxim_core.episode import EpisodeInfo
    from roboxim_core.specs import SceneSpec, TaskSpec
    from roboxim_ros.messages.conversions import from_msg, to_msg

    info = EpisodeInfo(
        episode_id="fuzz", run_seed=1, purpose="test", index=0, attempt=0, task=from_msg(task, TaskSpec),
        scene=from_msg(scene, SceneSpec), semantics=ActionSemantics(), actor="policy",
    )  # fmt: skip
    return to_msg(info, EpisodeInfoMsg)


def _retime(srv: Any, motion: Any, joints: list[str], start: list[float], end: list[float]) -> Any:
    from trajectory_msgs.msg import JointTrajectoryPoint

    request = srv.RetimePath.Request(request=deepcopy(motion))
    request.path.joint_names = joints
    request.path.points = [JointTrajectoryPoint(positions=start), JointTrajectoryPoint(positions=end)]
    return request
