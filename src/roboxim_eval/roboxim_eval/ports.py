"""The episode loop's ports as ROS clients, so that `roboxim_core.episode` runs over a graph."""

from __future__ import annotations

import array
import json
import threading
import zlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rclpy.context import Context
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from roboxim_interfaces.msg import ActionSemantics as ActionSemanticsMsg
from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg
from roboxim_interfaces.msg import EpisodeStep as EpisodeStepMsg
from roboxim_interfaces.msg import RecordedTick, TickNotice
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.msg import TaskSpec as TaskSpecMsg
from roboxim_interfaces.srv import (
    CloseEpisode,
    GenerateEpisode,
    Judge,
    LoadScene,
    OpenEpisode,
    ReleaseEpisode,
    Tick,
)
from sensor_msgs.msg import Image
from simulation_interfaces.srv import GetSimulatorFeatures

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode import Draw, EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import (
    ErrorCode,
    EvaluationError,
    RequestTimeoutError,
    RoboximError,
    SimError,
    UnavailableError,
    raise_for_code,
)
from roboxim_core.policies import Observation
from roboxim_core.poses import IDENTITY
from roboxim_core.proprioception import Proprioception
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.local import ticks as local_ticks
from roboxim_ros.local.calls import LocalCall
from roboxim_ros.local.recording import RECORD_ARRIVING, RECORD_RECEIVED, RECORD_STEP, RECORD_STORE
from roboxim_ros.messages.conversions import from_msg, image_from_msg, stamp_to_ns, to_msg
from roboxim_ros.policy_service import PolicyClient

SERVICE_TIMEOUT_S = 120.0
"""Longest wait for the answer of a node that is alive [s]; a dead node is detected sooner."""
MESSAGE_TIMEOUT_S = 60.0
"""Longest wait for an image of a tick, or for the recorder to acknowledge the tick [s]."""


class TaskClient:
    """Client of the task node: draws episodes and judges ticks."""

    def __init__(self, clients: Clients) -> None:
        """Store the clients."""
        self._clients = clients

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        """Draw the task and scene of a seed path."""
        request = GenerateEpisode.Request(
            run_seed=seed.run_seed, purpose=seed.purpose, index=seed.index, attempt=seed.attempt,
            task_config=task_config,
        )  # fmt: skip
        answer = self._clients.call(GenerateEpisode, "tasks/generate_episode", request, timeout_s=2 * SERVICE_TIMEOUT_S)
        return Draw(
            task=from_msg(answer.task, TaskSpec), scene=from_msg(answer.scene, SceneSpec),
            max_steps=answer.max_steps, config_json=answer.task_config_json or "{}",
        )  # fmt: skip

    def start(self, episode_id: str, task: TaskSpec, state: StateRecord) -> Verdict:
        """Start judging an episode; return the verdict on tick 0."""
        return self._judge(episode_id, state, task)

    def judge(self, state: StateRecord) -> Verdict:
        """Judge the next tick of the episode."""
        return self._judge(state.episode_id, state, None)

    def _judge(self, episode_id: str, state: StateRecord, task: TaskSpec | None) -> Verdict:
        call = self._clients.send_local("tasks/judge", episode_id, state, task)
        if call is not None:
            verdict: Verdict = self._clients.value_of(call, "tasks/judge", SERVICE_TIMEOUT_S)
            return verdict
        request = Judge.Request(
            episode_id=episode_id, task=[to_msg(task, TaskSpecMsg)] if task else [], state=to_msg(state, StateRecordMsg)
        )
        answer = self._clients.call(Judge, "tasks/judge", request, timeout_s=SERVICE_TIMEOUT_S)
        return from_msg(answer.verdict, Verdict)


class SimClient:
    """Client of the simulator: services for states, topics for images; plain values if it is in this process."""

    def __init__(self, clients: Clients, holder: str = "") -> None:
        """Store the clients.

        Args:
            clients: The clients.
            holder: Name of the holder of the sim's lease; a restarted holder takes over the lease of its own name.
                Empty: take no lease.
        """
        self._clients = clients
        self._holder = holder
        self.meanwhile: Callable[[], None] = lambda: None
        """Function that is called in the caller's thread while the sim computes a tick; it raises nothing."""
        self._arrived = threading.Condition()
        self._notice: TickNotice | None = None
        self._images: dict[str, dict[int, Image]] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._renderer = ""
        self._base = IDENTITY
        self._notices = clients.node.resolve_topic_name("sim/ticks")

    @property
    def renderer(self) -> str:
        """Renderer and device with which the sim will draw the next scene; `load` checks it."""
        answer = self._clients.call(GetSimulatorFeatures, "sim/get_simulator_features", GetSimulatorFeatures.Request())
        info = json.loads(answer.features.custom_info)
        self._renderer = f"{info['renderer']} ({info['device']})"
        return self._renderer

    def watch(self, cameras: tuple[str, ...]) -> None:
        """Subscribe to cameras and to the notices of ticks; repeated calls subscribe once."""
        if cameras and not self._subscriptions:
            self._clients.node.create_subscription(TickNotice, "sim/ticks", self._on_notice, qos.EVENTS)
        for camera in cameras:
            if camera not in self._subscriptions:
                self._images[camera] = {}
                self._subscriptions[camera] = self._clients.node.create_subscription(
                    Image, f"camera/{camera}/image", lambda msg, name=camera: self._on_image(name, msg), qos.EVENTS
                )

    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics | None = None) -> StateRecord:
        """Rebuild the world for actions of a meaning (default: end-effector deltas); settle; return tick 0.

        Raises:
            EvaluationError: When the images come from another renderer than `renderer` has named.
        """
        self._base = scene.robot.pose
        request = LoadScene.Request(
            episode_id=episode_id, scene=to_msg(scene, SceneSpecMsg), holder=self._holder,
            semantics=[to_msg(semantics, ActionSemanticsMsg)] if semantics else [],
        )  # fmt: skip
        answer = self._clients.call(LoadScene, "sim/load_scene", request, timeout_s=2 * SERVICE_TIMEOUT_S)
        expected, self._renderer = self._renderer, ""
        if expected and answer.renderer != expected:
            raise EvaluationError(
                f"'{episode_id}' names the renderer {expected}, but the sim draws with {answer.renderer}; was the sim "
                "restarted meanwhile? Run the episode again"
            )
        return from_msg(answer.state, StateRecord)

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action; return tick ``seq``."""
        call = self._clients.send_local("sim/tick", episode_id, seq, action)
        if call is not None:
            self.meanwhile()
            record: StateRecord = self._clients.value_of(call, "sim/tick", SERVICE_TIMEOUT_S)
            return record
        request = Tick.Request(episode_id=episode_id, seq=seq, action=array.array("f", action.tolist()))
        answer = self._clients.call(Tick, "sim/tick", request, timeout_s=SERVICE_TIMEOUT_S, meanwhile=self.meanwhile)
        return from_msg(answer.state, StateRecord)

    def release(self, episode_id: str) -> None:
        """Release the lease; if the sim is dead or leased to another holder, only log a warning."""
        try:
            self._clients.call(
                ReleaseEpisode,
                "sim/release_episode",
                ReleaseEpisode.Request(episode_id=episode_id),
                timeout_s=MESSAGE_TIMEOUT_S,
            )
        except (RequestTimeoutError, UnavailableError, SimError) as error:
            self._clients.node.get_logger().warning(f"could not release '{episode_id}': {error}")

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        """Wait for the complete observation of a tick.

        Raises:
            EvaluationError: ``OBSERVATION_MISSING``, with the names of the missing images.
        """
        images: dict[str, Any] = {}
        tick = local_ticks.shown(self._clients.node.context, self._notices, state.episode_id, state.seq)
        if tick is not None:
            images = {camera: tick.images[camera].rgb for camera in cameras if camera in tick.images}
            _require_cameras(cameras, tick.images)
        elif cameras:
            self.watch(cameras)
            with self._arrived:
                complete = self._arrived.wait_for(
                    lambda: self._collect(state, cameras, images), timeout=MESSAGE_TIMEOUT_S
                )
            if not complete:
                missing = [camera for camera in cameras if camera not in images]
                raise EvaluationError(
                    f"tick {state.seq} of '{state.episode_id}': no image of {', '.join(missing) or 'the tick'} within "
                    f"{MESSAGE_TIMEOUT_S:g} s; is the camera in the scene and its publisher alive?",
                    ErrorCode.OBSERVATION_MISSING,
                )
        return Observation(
            seq=state.seq, stamp_ns=state.stamp_ns, images=images, proprio=Proprioception.of(state, self._base)
        )

    def _collect(self, state: StateRecord, cameras: tuple[str, ...], images: dict[str, Any]) -> bool:
        notice = self._notice
        if notice is None or (notice.episode_id, notice.seq) != (state.episode_id, state.seq):
            return False
        expected = dict(zip(notice.topics, notice.image_crc32, strict=True))
        for camera in cameras:
            topic = f"camera/{camera}/image"
            _require_cameras((camera,), [name.split("/")[1] for name in expected if name.endswith("/image")])
            msg = self._images[camera].get(state.stamp_ns)
            if msg is not None and camera not in images and zlib.crc32(msg.data) == expected[topic]:
                images[camera] = image_from_msg(msg)
        return len(images) == len(cameras)

    def _on_notice(self, msg: TickNotice) -> None:
        with self._arrived:
            self._notice = msg
            self._arrived.notify_all()

    def _on_image(self, camera: str, msg: Image) -> None:
        with self._arrived:
            kept = self._images[camera]
            kept[stamp_to_ns(msg.header.stamp)] = msg
            while len(kept) > 4:
                del kept[next(iter(kept))]
            self._arrived.notify_all()


def _require_cameras(wanted: Iterable[str], there: Iterable[str]) -> None:
    """Refuse cameras that the sim does not have."""
    there = list(there)
    for camera in wanted:
        if camera not in there:
            raise EvaluationError(
                f"the sim publishes no camera '{camera}'; it has {there}", ErrorCode.OBSERVATION_MISSING
            )


class RecorderClient:
    """Client of the recorder: opens a bag, sends a step per tick, waits for its acknowledgement, closes the bag."""

    def __init__(self, clients: Clients, output_dir: str) -> None:
        """Subscribe to the recorder's acknowledgements.

        Args:
            clients: The clients.
            output_dir: Absolute folder of the run, for the bags.
        """
        self._clients = clients
        self._output_dir = output_dir
        self._acknowledged = threading.Condition()
        self._last = RecordedTick()
        self._open = ""
        self._sent: tuple[str, int] | None = None
        """Episode and tick of the step that the recorder has not yet acknowledged."""
        self._call: LocalCall | None = None
        """The same step's call, if the recorder is in this process."""
        clients.node.create_subscription(RecordedTick, "recorder/recorded", self._on_recorded, qos.EVENTS)
        self._publisher: Publisher = clients.node.create_publisher(EpisodeStepMsg, "evaluator/step", qos.EVENTS)

    def open(self, info: EpisodeInfo) -> None:
        """Open the episode's bag."""
        request = OpenEpisode.Request(info=to_msg(info, EpisodeInfoMsg), output_dir=self._output_dir)
        self._clients.call(OpenEpisode, "recorder/open_episode", request, timeout_s=SERVICE_TIMEOUT_S)
        self._open = info.episode_id

    def step(self, step: EpisodeStep) -> None:
        """Send a tick's step; `wait_written` waits for the recorder's acknowledgement.

        A recorder of this process gets it by a call. It is then published only if there are other subscribers.
        """
        self._sent = self._call = None  # a refused step is not waited for
        taken = self._clients.send_local(RECORD_STEP, step)
        if taken is None or not self._clients.value_of(taken, RECORD_STEP, MESSAGE_TIMEOUT_S):
            self._call = None if taken is None else self._clients.send_local(RECORD_ARRIVING, step)
            if taken is not None and self._call is None:
                raise UnavailableError(f"the recorder ended before tick {step.seq} of '{step.episode_id}'")
            self._sent = step.episode_id, step.seq
        if taken is None or self._publisher.get_subscription_count() > 1:
            self._publisher.publish(to_msg(step, EpisodeStepMsg))

    def wait_written(self) -> None:
        """Wait until the bag has the complete tick of the last step.

        Raises:
            RoboximError: The error with which the recorder rejected the tick, or a time-out.
        """
        if self._sent is None:
            return
        (episode_id, seq), self._sent = self._sent, None
        if self._call is not None:
            self._clients.value_of(self._call, RECORD_ARRIVING, MESSAGE_TIMEOUT_S)
            return
        with self._acknowledged:
            done = self._acknowledged.wait_for(
                lambda: (self._last.episode_id, self._last.seq) == (episode_id, seq), timeout=MESSAGE_TIMEOUT_S
            )
            last = self._last
        if not done:
            raise RequestTimeoutError(
                f"the recorder did not acknowledge tick {seq} of '{episode_id}' within "
                f"{MESSAGE_TIMEOUT_S:g} s; it hangs, has died, or lacks a message of the tick"
            )
        raise_for_code(last.error_code, last.error_msg)

    def store(self) -> None:
        """Store the ticks that a recorder of this process has taken. Slow: call it while no caller waits."""
        self._clients.send_local(RECORD_STORE)

    def close(self, result: EpisodeResult, keep: str, received: Sequence[str] = ()) -> str:
        """Close the bag; return its path relative to the output folder.

        Only a recorder of this process gets the instructions that the policy received.
        """
        self.wait_written()
        call = self._clients.send_local(RECORD_RECEIVED, (result.episode_id, tuple(received)))
        if call is not None:
            self._clients.value_of(call, RECORD_RECEIVED, MESSAGE_TIMEOUT_S)
        request = CloseEpisode.Request(result=to_msg(result, EpisodeResultMsg), keep=keep)
        answer = self._clients.call(CloseEpisode, "recorder/close_episode", request, timeout_s=SERVICE_TIMEOUT_S)
        self._open = ""
        return str(answer.bag)

    def abort(self) -> None:
        """Drop the open bag, if any, after a fault."""
        if not self._open:
            return
        request = CloseEpisode.Request(keep="drop")
        request.result.episode_id = self._open
        self._open = ""
        try:
            self.wait_written()  # a late error must not affect the next attempt, which has the same episode id
        except RoboximError as error:
            self._clients.node.get_logger().info(f"the dropped bag lacks its last tick: {error}")
        try:
            self._clients.call(CloseEpisode, "recorder/close_episode", request, timeout_s=MESSAGE_TIMEOUT_S, wait_s=0.5)
        except RoboximError as error:
            self._clients.node.get_logger().warning(f"could not drop the open bag: {error}")

    def _on_recorded(self, msg: RecordedTick) -> None:
        with self._acknowledged:
            self._last = msg
            self._acknowledged.notify_all()


class RosPorts:
    """All five ports over one set of clients."""

    def __init__(self, context: Context, namespace: str) -> None:
        """Create the clients.

        Args:
            context: An initialised rclpy context.
            namespace: Namespace of the graph.
        """
        self.clients = Clients("evaluator_clients", context=context, namespace=namespace)
        self.tasks = TaskClient(self.clients)
        self.sim = SimClient(self.clients, holder="evaluator")
        self.recorder = RecorderClient(self.clients, "")
        self.sim.meanwhile = self.recorder.store

    def for_run(self, actor: str, timeout_s: float, output_dir: str) -> tuple[PolicyClient, RecorderClient]:
        """Return the actor and the recorder of a run.

        Args:
            actor: Namespace of the policy or expert that acts.
            timeout_s: Longest wait for an action [s].
            output_dir: Absolute folder of the run.
        """
        self.recorder._output_dir = output_dir
        return PolicyClient(self.clients, actor, timeout_s), self.recorder

    def close(self) -> None:
        """Close the clients."""
        self.clients.close()
