"""A fuzzer over every service and action of a running graph, made from the interface definitions.

There are two kinds of requests: random ones, field by field (extremes, NaN, empty, huge, wrong names, random bytes),
and valid ones from a corpus with one or two fields changed, which reach deeper. The graph runs in a separate process,
so that the fuzzer detects its end.

From the command line, with a table of the responses::

    .venv/bin/python tests/fuzzer.py --requests 40 --seed 1
"""

from __future__ import annotations

import argparse
import array
import contextlib
import importlib
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ANSWER_S = 90.0
"""Longest wait for an answer, generous for a busy machine."""
EPISODE_S = 300.0
"""Longest wait for an episode, generous for a busy machine."""
STOP_AFTER_S = 3.0
"""Duration after which goals and steps are cancelled [s]."""
FLOATS = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-9, 1e9, 100.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324,
)  # fmt: skip
NAMES = (
    "", "robot", "table", "world", "tcp", "latest", "red_cube", "cube", "apple", "panda", "ur5", "raster", "tiny",
    "demo", "eval", "test", "expert", "policy", "sim", "panda_link0", "panda_joint1", "panda_joint7",
    "workspace", "wrist", "pick_up", "all", "none", "successful", "keep", "drop", "RRTConnect", "BITstar", "home",
    "target", "fuzz", "nobody",
)  # fmt: skip
HOSTILE = (
    "x" * 300, "x" * 9_999, "x" * 70_000, "/", "..", "../../../../etc/passwd", "a/b", "a b\n", "\t", "naïve 🤖", "%s%n",
    "(a+)+$", "[", "{", "[" * 5_000, '{"a": NaN}', "null", "1e999", '"\\ud800"', "&a [*a]", "{scene: {}}",
    "a: &a [x, x, x]\nb: &b [*a, *a, *a]\nc: [*b, *b]", "cells: [{tasks: [pick_cube], episodes: 1000000000}]",
    "skill: pick_up", "skill: nonsense", "!!python/object/apply:os.system ['true']", "roboxim://cube?scale=nan",
    "roboxim://cube?color=red&scale=1e9", "http://cube",
)  # fmt: skip
PARAMETERS = re.compile(r"parameter|type_description")
"""Services that rclpy offers for every node; called in every fifth round only."""
INT_BITS = re.compile(r"(u?)int(\d+)")


class Maker:
    """Creates random messages from their definitions."""

    def __init__(self, rng: random.Random) -> None:
        """Make nothing yet."""
        self.rng = rng
        self._small = False

    def message(self, cls: Any, depth: int = 0) -> Any:
        """Return a message with random values in every field."""
        msg = cls()
        for name, kind in cls.get_fields_and_field_types().items():
            setattr(msg, name, self.value(kind, depth))
        return msg

    def value(self, kind: str, depth: int = 0) -> Any:
        """Return a random value of a type, named as in `get_fields_and_field_types`."""
        if found := re.fullmatch(r"sequence<(.+?)(?:, *(\d+))?>", kind):
            return self._sequence(found[1], int(found[2]) if found[2] else None, depth)
        if found := re.fullmatch(r"(.+)\[(\d+)\]", kind):
            items = [self.value(found[1], depth + 1) for _ in range(int(found[2]))]
            return np.array(items, dtype=_numpy_type(found[1])) if "/" not in found[1] else items
        if "/" in kind:
            return self.message(_message_class(kind), depth + 1)
        return self._scalar(kind)

    def _scalar(self, kind: str) -> Any:
        rng = self.rng
        if kind == "boolean":
            return rng.random() < 0.5
        if kind in ("float", "double"):
            return rng.choice(FLOATS) if rng.random() < 0.7 else rng.uniform(-2, 2)
        if kind.startswith(("string", "wstring")):
            roll = rng.random()
            if roll < 0.6 or self._small:
                return rng.choice(NAMES)
            if roll < 0.9:
                return rng.choice(HOSTILE)
            return rng.randbytes(rng.randrange(200)).decode("utf-8", "replace").replace("\0", "?")
        if kind == "octet":
            return bytes([rng.randrange(256)])
        low, high = _int_range(kind)
        value = rng.choice((0, 1, 2, 3, 7, 100, -1, low, high, high - 1, rng.randint(low, high)))
        return min(max(value, low), high)

    def _sequence(self, element: str, most: int | None, depth: int) -> Any:
        composed = "/" in element or element.startswith("string")
        sizes = (0, 0, 1, 1, 2, 3) if depth > 2 else (0, 1, 1, 2, 3, 7)
        size = 0 if self._small else self.rng.choice(sizes)
        if not composed and not self._small and self.rng.random() < 0.1:
            size = self.rng.choice((1_000, 100_000))
        if composed and depth == 0 and self.rng.random() < 0.03:
            size = 12_000
        size = min(size, most) if most is not None else size
        if composed:
            self._small, before = self._small or size > 7, self._small  # a message of gigabytes tests the sender
            first = [self.value(element, depth + 1) for _ in range(min(size, 7))]
            self._small = before
            return first if size <= 7 else (first * (size // 7 + 1))[:size]
        items = [self._scalar(element) for _ in range(min(size, 50))]
        items = items if size <= 50 else (items * (size // 50 + 1))[:size]
        code = _array_code(element)
        return array.array(code, items) if code else items

    def mutate(self, msg: Any) -> str:
        """Change one random field of a message and return the field's path."""
        cls = type(msg)
        name, kind = self.rng.choice(sorted(cls.get_fields_and_field_types().items()) or [("", "")])
        if not name:
            return ""
        value = getattr(msg, name)
        if "/" in kind and not kind.startswith("sequence") and "[" not in kind:
            return f"{name}.{self.mutate(value)}"
        if kind.startswith("sequence") and "/" in kind and len(value) and self.rng.random() < 0.85:
            return f"{name}.{self.mutate(self.rng.choice(list(value)))}"
        setattr(msg, name, self.value(kind))
        return name


def _int_range(kind: str) -> tuple[int, int]:
    found = INT_BITS.fullmatch(kind)
    if found is None:
        return (0, 255)
    bits = int(found[2])
    return (0, 2**bits - 1) if found[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _numpy_type(kind: str) -> Any:
    return {"double": np.float64, "float": np.float32, "boolean": np.bool_}.get(kind) or np.dtype(kind)


def _array_code(kind: str) -> str:
    codes = {"double": "d", "float": "f", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h"}
    return {**codes, "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q"}.get(kind, "")


def _message_class(kind: str) -> Any:
    package, _, name = kind.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def interface(kind: str) -> Any:
    """Import the class of ``package/srv/Name`` or ``package/action/Name``."""
    package, middle, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{middle}"), name)


# ---------------------------------------------------------------- the graph


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


# ---------------------------------------------------------------- valid requests


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


# ---------------------------------------------------------------- fuzzing


@dataclass
class Report:
    """Statistics of the requests and their responses."""

    answers: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """Counts of responses by service: ``accepted`` or the error's name."""
    slowest: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Slowest response by service [s]."""
    internal: list[str] = field(default_factory=list)
    """Responses with ``INTERNAL``, which no request should get."""
    rss_mib: list[float] = field(default_factory=list)
    """Resident memory of the graph's process after each round [MiB]."""

    def table(self) -> str:
        """Return the table of the documentation."""
        lines = [
            "| service or action | requests | accepted | refused | slowest [s] | errors |",
            "| - | -: | -: | -: | -: | - |",
        ]
        for name, answers in sorted(self.answers.items()):
            total, accepted = sum(answers.values()), answers["accepted"]
            errors = ", ".join(f"{code} {n}" for code, n in answers.most_common() if code != "accepted")
            lines.append(
                f"| `{name}` | {total} | {accepted} | {total - accepted} | {self.slowest[name]:.1f} | {errors} |"
            )
        everything = sum((answers for answers in self.answers.values()), Counter())
        total = sum(everything.values())
        lines.append(f"| all | {total} | {everything['accepted']} | {total - everything['accepted']} | | |")
        return "\n".join(lines)


def verdict(answer: Any) -> tuple[str, str]:
    """Return ``accepted`` or the name of the error in a response or result, and its message."""
    from roboxim_core.errors import ErrorCode

    fields = answer.get_fields_and_field_types()
    if "error_code" in fields and "error_msg" in fields:
        return ("accepted" if not answer.error_code else ErrorCode(answer.error_code).name), answer.error_msg
    if fields.get("result") == "simulation_interfaces/Result":
        message = answer.result.error_message
        named = re.match(r"([A-Z_]+):", message)
        return ("accepted" if answer.result.result == 1 else named[1] if named else "REFUSED"), message
    if "error_code" in fields and "error_string" in fields:
        named = re.match(r"([A-Z_]+):", answer.error_string)
        return ("accepted" if not answer.error_code else named[1] if named else "REFUSED"), answer.error_string
    results = list(getattr(answer, "results", [])) if "SetParametersResult" in str(fields.get("results")) else []
    if fields.get("result") == "rcl_interfaces/SetParametersResult":
        results = [answer.result]
    if any(not result.successful for result in results):
        return "REFUSED", results[0].reason
    if fields.get("successful") == "boolean" and not answer.successful:
        return "REFUSED", ""
    return "accepted", ""


class Fuzzer:
    """Fuzzes a live graph."""

    def __init__(self, live: Live, seed: int) -> None:
        """List the graph's services and actions, and build the corpus."""
        self.live, self.rng = live, random.Random(seed)
        self.maker = Maker(self.rng)
        self.report = Report()
        self.corpus = corpus(live)
        node = live.clients.node
        services = {
            name.lstrip("/"): kinds[0]
            for name, kinds in node.get_service_names_and_types()
            if not name.startswith("/fuzzer")
        }
        self.actions = {
            name.removesuffix("/_action/send_goal"): kind.removesuffix("_SendGoal")
            for name, kind in services.items()
            if name.endswith("/_action/send_goal")
        }
        self.services = {name: kind for name, kind in services.items() if "/_action/" not in name}

    def run(self, requests: int, until: float = float("inf")) -> Report:
        """Send some requests to every service and action, in rounds.

        Args:
            requests: Number of requests to each.
            until: Time on the monotonic clock after which no further round starts.
        """
        doors = [("service", name) for name in sorted(self.services)] + [
            ("action", name) for name in sorted(self.actions)
        ]
        for number in range(requests):
            self.rng.shuffle(doors)
            chosen = [door for door in doors if number % 5 == 0 or not PARAMETERS.search(door[1])]
            for place, (kind, name) in enumerate(chosen):
                if place % 12 == 0:
                    self.heal()
                (self.service if kind == "service" else self.action)(name)
                if time.monotonic() > until:
                    break
            self.report.rss_mib.append(self.live.rss_mib())
            if time.monotonic() > until:
                break
        return self.report

    def heal(self) -> None:
        """Prepare the graph so that requests reach deep: load a scene and release it."""
        from roboxim_interfaces.srv import LoadScene, ReleaseEpisode

        self.live.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
        answer = self.live.call(LoadScene, "sim/load_scene", self.corpus["sim/load_scene"]())
        assert answer.error_code == 0, f"the graph no longer takes a valid scene: {answer.error_msg}"

    def request(self, name: str, cls: Any) -> Any:
        """Return a random request, or a valid one with changed fields."""
        if name in self.corpus and self.rng.random() < 0.75:
            request = self.corpus[name]()
            for _ in range(self.rng.choice((0, 1, 1, 1, 2))):
                self.maker.mutate(request)
            return request
        return self.maker.message(cls)

    def note(self, name: str, answer: Any, began: float) -> None:
        """Note an answer."""
        code, message = verdict(answer)
        self.report.answers[name][code] += 1
        self.report.slowest[name] = max(self.report.slowest[name], time.monotonic() - began)
        if code == "INTERNAL":
            self.report.internal.append(f"{name}: {message}")

    def service(self, name: str) -> None:
        """Call a service once and check that it responds."""
        cls = interface(self.services[name])
        request = self.request(name, cls.Request)
        began = time.monotonic()
        if name == "sim/step_simulation":
            answer = self.stopped(lambda: self.live.call(cls, name, request))
        else:
            answer = self.live.call(cls, name, request)
        self.note(name, answer, began)

    def stopped(self, call: Callable[[], Any]) -> Any:
        """Make a call that may take long and stop it after a while."""
        import threading

        from simulation_interfaces.msg import SimulationState
        from simulation_interfaces.srv import SetSimulationState

        box: list[Any] = []
        thread = threading.Thread(target=lambda: box.append(call()), daemon=True)
        thread.start()
        thread.join(STOP_AFTER_S)
        while thread.is_alive():
            pause = SetSimulationState.Request(state=SimulationState(state=SimulationState.STATE_PAUSED))
            self.live.call(SetSimulationState, "sim/set_simulation_state", pause)
            thread.join(STOP_AFTER_S)
        return box[0]

    def action(self, name: str) -> None:
        """Send a goal once, cancel it after a while and check that it ends."""
        from roboxim_core.errors import RequestTimeoutError
        from roboxim_ros.actions import ActionCall

        cls = interface(self.actions[name])
        key = name if name in self.corpus and name not in self.services else f"action {name}"
        goal = self.request(key, cls.Goal)
        began = time.monotonic()
        with ActionCall(self.live.clients, cls, name) as call:
            box: list[Any] = []
            try:
                ended = call.run(goal, timeout_s=STOP_AFTER_S)
            except RequestTimeoutError:  # cancels the goal; the graph must be free for the next one
                del box
                self.report.answers[f"{name} (action)"]["cancelled"] += 1
                return
        code, message = verdict(ended.result)
        if code == "accepted" and ended.status != "succeeded":
            code = ended.status
        self.report.answers[f"{name} (action)"][code] += 1
        key = f"{name} (action)"
        self.report.slowest[key] = max(self.report.slowest[key], time.monotonic() - began)
        if code == "INTERNAL":
            self.report.internal.append(f"{name}: {message}")


def episode_hash(live: Live) -> str:
    """Run an episode through the graph and return the hash of its last state."""
    from roboxim_interfaces.action import RunEpisodes
    from roboxim_interfaces.msg import RunConfig
    from roboxim_interfaces.srv import ReleaseEpisode

    from roboxim_ros.actions import ActionCall

    live.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
    config = RunConfig(
        run_seed=3, purpose="test", actor="policy", image_width=32, image_height=32, max_steps=8, settle_ticks=1,
        keep="none",
    )  # fmt: skip
    with ActionCall(
        live.clients, RunEpisodes, "evaluator/run_episodes"
    ) as action:  # it has no limit, unlike the service
        answer = action.run(RunEpisodes.Goal(config=config, indices=[0]), timeout_s=EPISODE_S).result
    assert answer.error_code == 0, answer.error_msg
    return str(answer.results[0].final_state_hash)


def main() -> int:
    """Fuzz a graph and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--requests", type=int, default=20, help="requests to each service and action")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, live_graph(Path(folder)) as live:
        before = episode_hash(live)
        fuzzer = Fuzzer(live, options.seed)
        try:
            report = fuzzer.run(options.requests)
            same = episode_hash(live) == before
        finally:
            print(fuzzer.report.table())  # noqa: T201
            print("\n".join(Counter(fuzzer.report.internal)) or "no INTERNAL error")  # noqa: T201
            print("memory [MiB]", json.dumps([round(value) for value in fuzzer.report.rss_mib]))  # noqa: T201
            if live.process.poll() is not None:
                print((Path(folder) / "graph.log").read_text()[-5000:])  # noqa: T201
            Path("/tmp/fuzz_graph.log").write_bytes((Path(folder) / "graph.log").read_bytes()[-5_000_000:])
    print("the same episode as before:", same)  # noqa: T201
    return 0 if same and not report.internal else 1


if __name__ == "__main__":
    sys.exit(main())
