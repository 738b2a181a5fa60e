"""A running graph of another process: its newest scene, state and pictures, and edits through its rooms' services.

The studio is one more participant: it subscribes while a page looks, and calls services. It starts and ends no node.

Non-obvious:
- Messages are kept as bytes and decoded only when they are drawn, so the studio's load does not depend on the graph's
  rate.
- The sim accepts edits during an episode and marks the episode as disturbed. The studio therefore asks first who holds
  the sim, and edits only between episodes: what was recorded without it is recorded with it, bit for bit.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import numpy as np
import numpy.typing as npt

from roboxim_core.closing import Closing
from roboxim_core.config import digest
from roboxim_core.errors import ConfigError, ErrorCode, RoboximError, SimError, UnavailableError
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import Scalar, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord

if TYPE_CHECKING:
    from roboxim_bringup.attach import Peer
    from roboxim_ros.runs import Run

Picture = npt.NDArray[np.uint8]
LAST_PATH = "planner/last_path"
CALL_S = 120.0
"""Longest wait for an answer; drawing a scene can take long on a busy machine [s]."""


def choose_graph(run_id: str | None = None) -> tuple[Run | None, tuple[Run, ...]]:
    """Return the graph to attach to, and the other live runs.

    Args:
        run_id: Name of a run; none: ``$ROBOXIM_RUN``, else the only run of ``roboxim up``.

    Returns:
        None as the graph when no run is named and no ``roboxim up`` is alive.

    Raises:
        ConfigError: When the named run is not alive, or several graphs are and none is named.
    """
    import os

    from roboxim_ros.runs import find_run, live_runs

    alive = live_runs()
    ups = [run for run in alive if run.kind == "up"]
    if run_id or os.environ.get("ROBOXIM_RUN"):
        chosen = find_run(run_id)
    elif len(ups) > 1:
        listing = "".join(f"\n  {run.id}  (started {run.started})" for run in ups)
        raise ConfigError(f"several graphs are running; choose one with --run ID, or name what to open:{listing}")
    elif not ups:
        return None, tuple(alive)
    else:
        chosen = ups[0]
    return chosen, tuple(run for run in alive if run.id != chosen.id)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a graph has published last."""

    scene: SceneSpec
    """The scene."""
    state: StateRecord
    """A state of it."""
    images: dict[str, Picture] = field(default_factory=dict)
    """Camera to picture, uint8, shape (height, width, 3); cameras that have published none are left out."""
    path: tuple[tuple[float, ...], ...] = ()
    """The planner's newest joint path of this robot [rad]; empty: it has planned none."""


class LiveGraph(Closing):
    """A participant in a running graph. A context manager; ending it does not change the graph."""

    def __init__(self, run: Run, others: Sequence[Run] = ()) -> None:
        """Join a run.

        Args:
            run: The run, see `choose_graph`.
            others: Other live runs, to name them.

        Raises:
            UnavailableError: When it has no sim.
        """
        from roboxim_bringup.attach import Peer, join_run

        self.run, self.others = run, tuple(others)
        """The run, and other live ones."""
        self.arrived = threading.Event()
        """Set when a message has come."""
        self._peer: Peer = Peer(join_run(run.id, None))
        self._lock = threading.RLock()
        self._raw: dict[str, bytes] = {}
        self._subscriptions: dict[str, Any] = {}
        self._scene: tuple[bytes, SceneSpec, str] | None = None
        self._path: tuple[bytes, tuple[str, ...], tuple[tuple[float, ...], ...]] | None = None
        try:
            topic = self._peer.look_for(self._find_scene, lambda: f"the run '{run.id}' has no sim to look at")
        except RoboximError:
            self._peer.close()
            raise
        self._prefix = topic.removesuffix("sim/scene")

    @property
    def alive(self) -> bool:
        """Whether a process of the run lives."""
        return bool(self.run.live_pids)

    def close(self) -> None:
        """Leave the graph, which keeps running."""
        self.rest()
        self._peer.close()

    # ---------------------------------------------------------------- looking

    def listen(self) -> None:
        """Subscribe to scene, state and planned path; cameras follow with the scene."""
        from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
        from roboxim_interfaces.msg import StateRecord as StateRecordMsg
        from trajectory_msgs.msg import JointTrajectory

        self._subscribe("sim/scene", SceneSpecMsg)
        self._subscribe("sim/state", StateRecordMsg)
        self._subscribe(LAST_PATH, JointTrajectory)

    def rest(self) -> None:
        """Subscribe to nothing: without a viewer the studio receives nothing."""
        self._keep(())
        with self._lock:
            self._raw.clear()
            self._scene = None

    def seen(self) -> Seen | None:
        """Return the newest scene with a state of it; None while they do not belong together, or none has come."""
        from rclpy.serialization import deserialize_message
        from roboxim_interfaces.msg import StateRecord as StateRecordMsg
        from sensor_msgs.msg import Image

        from roboxim_ros.messages.conversions import from_msg, image_from_msg

        with self._lock:
            raw = dict(self._raw)
        scene = self._newest_scene(raw.get("sim/scene"))
        if scene is None or "sim/state" not in raw:
            return None
        state = from_msg(deserialize_message(raw["sim/state"], StateRecordMsg), StateRecord)
        if state.scene_hash and state.scene_hash != scene[2]:
            return None
        images = {}
        for camera in scene[1].cameras:
            if (data := raw.get(f"camera/{camera.name}/image")) is not None:
                images[camera.name] = image_from_msg(deserialize_message(data, Image))
        return Seen(scene=scene[1], state=state, images=images, path=self._planned(raw.get(LAST_PATH), state))

    def _planned(self, data: bytes | None, state: StateRecord) -> tuple[tuple[float, ...], ...]:
        """Return the planner's newest path, decoded once; one of another robot is none."""
        from rclpy.serialization import deserialize_message
        from trajectory_msgs.msg import JointTrajectory

        if data is None:
            return ()
        if self._path is None or self._path[0] is not data:
            msg = deserialize_message(data, JointTrajectory)
            rows = tuple(tuple(map(float, point.positions)) for point in msg.points)
            self._path = data, tuple(msg.joint_names), rows
        _, names, rows = self._path
        return rows if names == state.robot.joint_names[: len(names)] else ()

    def _newest_scene(self, data: bytes | None) -> tuple[bytes, SceneSpec, str] | None:
        """Return the scene with its hash, decoded once, and subscribe to its cameras."""
        from rclpy.serialization import deserialize_message
        from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
        from sensor_msgs.msg import Image

        from roboxim_ros.messages.conversions import from_msg

        with self._lock:
            if data is None or (self._scene is not None and self._scene[0] == data):
                return self._scene
            scene = from_msg(deserialize_message(data, SceneSpecMsg), SceneSpec)
            newest = self._scene = (data, scene, digest(scene))
        cameras = [f"camera/{camera.name}/image" for camera in scene.cameras]
        self._keep(("sim/scene", "sim/state", LAST_PATH, *cameras))
        for topic in cameras:
            self._subscribe(topic, Image)
        return newest

    def _subscribe(self, topic: str, kind: Any) -> None:
        from roboxim_ros import qos

        def take(data: bytes) -> None:
            with self._lock:
                if topic in self._subscriptions:
                    self._raw[topic] = data
            self.arrived.set()

        with self._lock:
            if topic not in self._subscriptions:
                profile = qos.LATCHED if topic in ("sim/scene", LAST_PATH) else qos.STATE
                self._subscriptions[topic] = self._peer.node.create_subscription(
                    kind, f"{self._prefix}{topic}", take, profile, raw=True
                )
        self._peer.wake()

    def _keep(self, topics: Sequence[str]) -> None:
        """End the subscriptions to all other topics. Call it without the lock, which the peer's thread may wait for."""
        with self._lock:
            ended = [topic for topic in self._subscriptions if topic not in topics]
            subscriptions = [self._subscriptions.pop(topic) for topic in ended]
            for topic in ended:
                self._raw.pop(topic, None)
        for subscription in subscriptions:
            self._peer.clients.in_thread(partial(self._peer.node.destroy_subscription, subscription))

    def _find_scene(self) -> str | None:
        own = [f"{space.rstrip('/')}/sim/scene" for space in self.run.namespaces]
        topics = self._peer.topics()
        return next((topic for topic in own if topic in topics), None)

    # ---------------------------------------------------------------- editing, through the rooms' services

    def holder(self) -> str:
        """Return the episode that holds the sim; empty: none does.

        Raises:
            UnavailableError: When the graph does not answer.
        """
        from simulation_interfaces.srv import GetSimulatorFeatures

        answer = self._call(GetSimulatorFeatures, "sim/get_simulator_features")
        return str(json.loads(answer.features.custom_info).get("episode_id", ""))

    def move(self, entity: str, pose: Pose) -> None:
        """Put an object somewhere, at rest.

        Args:
            entity: Its name.
            pose: Its pose in the world.

        Raises:
            SimError: When an episode holds the sim, or there is no such object.
            UnavailableError: When the graph does not answer.
        """
        from simulation_interfaces.srv import SetEntityState

        from roboxim_ros.messages.conversions import fill_pose

        request = SetEntityState.Request(entity=entity)
        fill_pose(request.state.pose, pose)
        self._edit(SetEntityState, "sim/set_entity_state", request)

    def spawn(self, model: str, pose: Pose, modifiers: dict[str, Scalar] | None = None) -> str:
        """Add an object; returns its name.

        Args:
            model: Its model.
            pose: Its pose in the world.
            modifiers: Its modifiers.

        Raises:
            SimError: When an episode holds the sim, or there is no such model.
            UnavailableError: When the graph does not answer.
        """
        from simulation_interfaces.srv import SpawnEntity

        from roboxim_ros.messages.conversions import fill_pose

        request = SpawnEntity.Request(name=model, allow_renaming=True)
        request.entity_resource.uri = f"roboxim://{model}?{urlencode(modifiers or {})}"
        fill_pose(request.initial_pose.pose, pose)
        return str(self._edit(SpawnEntity, "sim/spawn_entity", request).entity_name)

    def delete(self, entity: str) -> None:
        """Remove an object.

        Raises:
            SimError: When an episode holds the sim, or there is no such object.
            UnavailableError: When the graph does not answer.
        """
        from simulation_interfaces.srv import DeleteEntity

        self._edit(DeleteEntity, "sim/delete_entity", DeleteEntity.Request(entity=entity))

    def reset(self) -> None:
        """Rebuild the scene as it was loaded.

        Raises:
            SimError: When an episode holds the sim.
            UnavailableError: When the graph does not answer.
        """
        from simulation_interfaces.srv import ResetSimulation

        self._edit(ResetSimulation, "sim/reset_simulation", ResetSimulation.Request(scope=255))

    def load(self, scene: SceneSpec) -> None:
        """Load another scene.

        Raises:
            SimError: When an episode holds the sim, or the scene cannot be built.
            UnavailableError: When the graph does not answer.
        """
        from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
        from roboxim_interfaces.srv import LoadScene

        from roboxim_ros.messages.conversions import to_msg

        self._call(LoadScene, "sim/load_scene", LoadScene.Request(scene=to_msg(scene, SceneSpecMsg)))

    def draw(self, task_config: str, seed: SeedPath) -> tuple[TaskSpec, SceneSpec]:
        """Let the graph's tasks room draw a task and its scene.

        Args:
            task_config: The task's YAML.
            seed: The seed path.

        Raises:
            TaskError: When no scene holds the task's constraints.
            UnavailableError: When the graph does not answer.
        """
        from roboxim_interfaces.srv import GenerateEpisode

        from roboxim_ros.messages.conversions import from_msg

        request = GenerateEpisode.Request(
            run_seed=seed.run_seed, purpose=seed.purpose, index=seed.index, attempt=seed.attempt,
            task_config=task_config,
        )  # fmt: skip
        answer = self._call(GenerateEpisode, "tasks/generate_episode", request)
        return from_msg(answer.task, TaskSpec), from_msg(answer.scene, SceneSpec)

    def _edit(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service that disturbs an episode, unless one is going on.

        Raises:
            SimError: When an episode holds the sim, or the service refuses.
        """
        from simulation_interfaces.msg import Result

        if episode := self.holder():
            raise SimError(
                f"the episode '{episode}' is going on in the graph; an edit would disturb it, wait for its end",
                ErrorCode.LEASE_HELD,
            )
        answer = self._call(kind, service, request)
        if answer.result.result != Result.RESULT_OK:
            raise SimError(f"{service}: {answer.result.error_message}", ErrorCode.INVALID_REQUEST)
        return answer

    def _call(self, kind: Any, service: str, request: Any = None) -> Any:
        if not self.alive:
            raise UnavailableError(f"the run '{self.run.id}' has ended; start another with: roboxim up")
        return self._peer.clients.call(kind, f"{self._prefix}{service}", request or kind.Request(), timeout_s=CALL_S)
