"""The sim node: serves the world and publishes its state and camera images.

Everything runs in the thread that spins the node: PyBullet and GL contexts belong to one thread. A long motion is a
coroutine that yields to the executor after every control period, so that it can be cancelled.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from rclpy.context import Context
from rclpy.publisher import Publisher
from roboxim_interfaces.msg import CameraImage
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import (
    GetState,
    LoadScene,
    ReleaseEpisode,
    RenderState,
    RestoreSnapshot,
    TakeSnapshot,
    Tick,
)

from roboxim_core import limits
from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.config import from_json, named_config, to_json
from roboxim_core.errors import ErrorCode, RequestTimeoutError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.plain_data.pictures import load_scenery
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.renderer import CameraImages, Renderer
from roboxim_ros import qos
from roboxim_ros.local import ticks as local_ticks
from roboxim_ros.local.ticks import LocalTick
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_sim.conversions import camera_kind, camera_msgs, camera_topics
from roboxim_sim.ports import SimConfig, SimServer
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import CameraRig
from roboxim_sim.rendering.states import StateRenderer
from roboxim_sim.ros import MotionActions, StandardServices
from roboxim_sim.snapshots import Snapshot
from roboxim_sim.tick_messages import KINDS, NOTICE, OF_SCENE, PreparedTick, TickMessages
from roboxim_sim.world import World

PROFILES = {topic: qos.LATCHED if topic in OF_SCENE else qos.STATE for topic in KINDS}
"""QoS by topic; camera topics use `qos.SENSOR`."""
LISTENERS_S = 0.1
"""Time between two checks for subscribers, for a sim that publishes nothing without them [s]."""


class SimNode(SimServer):
    """Serves a `World`. Publishes all topics of a tick, the notice last, before the tick's service responds."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Create the node and load its first scene; see `roboxim_ros.node.RoboximNode`.

        Raises:
            ConfigError: When a parameter or the scene is wrong.
            SimError: RENDERER_UNAVAILABLE when the scene has cameras and the renderer does not work on this machine.
        """
        super().__init__("sim", context=context, namespace=namespace, parameters=parameters)
        self.config = self.declare_config(SimConfig)
        self.library = ModelLibrary()
        self.world = World(self.library)
        self._renderer_name = self.config.renderer
        self._renderers: dict[tuple[str, str], Renderer] = {}
        self._rig: CameraRig | None = None
        self._states: dict[str, StateRenderer] = {}
        self._holder = ""
        self._tick_messages: TickMessages | None = None
        self._unpublished: PreparedTick | None = None  # tick with the scene's messages
        self._has_subscribers, self._look_by = False, 0.0
        self._scene_out = self.create_publisher(SceneSpecMsg, "sim/scene", qos.LATCHED)
        self._outputs: dict[str, Publisher] = {}
        self._notices = self.resolve_topic_name(NOTICE)
        local_ticks.announce(context, self._notices)
        for topic in KINDS:
            self._publisher(topic)

        self.serve(LoadScene, "sim/load_scene", self._on_load_scene)
        self.serve(Tick, "sim/tick", self._on_tick)
        self.offer("sim/tick", self.tick)
        self.serve(ReleaseEpisode, "sim/release_episode", self._on_release)
        self.serve(GetState, "sim/get_state", self._on_get_state)
        self.serve(TakeSnapshot, "sim/take_snapshot", self._on_take_snapshot)
        self.serve(RestoreSnapshot, "sim/restore_snapshot", self._on_restore_snapshot)
        self.serve(RenderState, "sim/render_state", self._on_render_state)
        self.offer("sim/segment", self._segment)
        self._standard = StandardServices(self)
        self._motions = MotionActions(self)
        if self.config.scene:
            self.load(load_scenery(named_config("scenes", self.config.scene), SceneSpec))

    def destroy_node(self) -> None:
        """Free the world and the renderers."""
        local_ticks.withdraw(self.context, self._notices)
        self._motions.destroy()
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self.world.close()
        super().destroy_node()

    # ---------------------------------------------------------------- shared by the handlers

    @property
    def renderer_info(self) -> dict[str, str]:
        """Name and device of the renderer for requests that name none; the reason if it does not work here."""
        return {
            "simulator": "RoboXim (PyBullet)",
            "renderer": self.config.renderer,
            "device": self._device(self.config.renderer),
        }

    def _device(self, renderer: str) -> str:
        """Return a renderer's device; if it does not work on this machine, the reason."""
        try:
            return self._renderer(renderer, "live").device
        except SimError as error:
            return f"unavailable: {error}"

    def overtime(self) -> RequestTimeoutError:
        """Return the error for a motion that takes too long."""
        return RequestTimeoutError(
            f"given up after {self.config.motion_timeout_s:g} s of wall-clock time (parameter motion_timeout_s); "
            "the simulation keeps the state that it has reached"
        )

    def load(
        self,
        scene: SceneSpec,
        episode_id: str = "",
        renderer: str = "",
        semantics: ActionSemantics | None = None,
    ) -> StateRecord:
        """Load a scene and publish tick 0; see `_replace_world`."""
        renderer = renderer or self.config.renderer
        return self._replace_world(scene, renderer, lambda: self.world.load(scene, episode_id, semantics))

    def _replace_world(self, scene: SceneSpec, renderer: str, make: Callable[[], StateRecord]) -> StateRecord:
        """Replace the world and publish its state.

        After a failure no episode holds the sim. A scene that is refused leaves the old one; otherwise none is loaded.

        Args:
            scene: Scene of the new world.
            renderer: Name of its renderer.
            make: Replaces the world and returns its state.
        """
        try:
            for camera in scene.cameras:
                limits.require_name("camera", camera.name, topic=True)
            if scene.cameras:
                self._renderer(renderer, "live")
            record = make()
        except Exception:
            self._forget(unload=not self.world.loaded)
            raise
        self._renderer_name = renderer
        try:
            self._show_world()
            self.publish(record)
        except Exception:
            self._forget(unload=True)
            raise
        return record

    def _forget(self, *, unload: bool) -> None:
        """Release the world; if it is unloaded, no longer show its last tick to this process."""
        self.world.release()
        if unload:
            self.world.unload()
            self._unpublished = None
            local_ticks.announce(self.context, self._notices)

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action of an episode and publish the tick."""
        record = self.world.tick(seq, np.asarray(action, dtype=np.float32), episode_id=episode_id)
        self.publish(record)
        return record

    def scene_changed(self) -> None:
        """Publish the scene and its state after entities were added or removed."""
        self._show_world()
        self.publish(self.world.record)

    def publish(self, record: StateRecord) -> None:
        """Publish all topics of a state, unless there are no subscribers (`SimConfig.publish_unheard`)."""
        assert self._tick_messages is not None
        images = self._capture(record)
        tick = self._tick_messages.prepare(record, images)
        if tick.first:
            self._unpublished = tick
        if self.config.publish_unheard or self._is_heard():
            self._publish(tick)
        shown = LocalTick(state=record, images=images, messages=tick.messages)
        local_ticks.show(self.context, self._notices, shown)

    def _publish(self, tick: PreparedTick) -> None:
        """Publish a tick; before it, the messages of its scene if they have not been published."""
        scene, self._unpublished = self._unpublished, None
        if scene is not None and scene is not tick:
            for topic in OF_SCENE:
                self._publisher(topic).publish(bytes(scene.messages()[topic]))
        for topic, cdr in tick.messages().items():
            self._publisher(topic).publish(bytes(cdr))

    def _is_heard(self) -> bool:
        """Return whether a topic has subscribers; the answer is at most `LISTENERS_S` old."""
        now = time.monotonic()
        if now >= self._look_by:
            self._has_subscribers = any(publisher.get_subscription_count() for publisher in self._outputs.values())
            self._look_by = now + LISTENERS_S
        return self._has_subscribers

    def _show_world(self) -> None:
        scene = self.world.scene
        self._tick_messages = TickMessages(scene, self.world.robot, self.world.scene_poses)
        for camera in scene.cameras:
            for topic in camera_topics(camera):
                self._publisher(topic)  # created before the first message, so that nodes can subscribe in time
        if scene.cameras:
            self._rig = CameraRig(self._renderer(self._renderer_name, "live"))
            self._rig.load(render_world(scene, self.library), scene)
        self._scene_out.publish(to_msg(scene, SceneSpecMsg))

    def _renderer(self, name: str, use: str) -> Renderer:
        """Return a renderer; the live world and re-rendered states have one each."""
        if (name, use) not in self._renderers:
            self._renderers[name, use] = make_renderer(name)
            self.get_logger().info(f"renderer for {use} images: {name} ({self._renderers[name, use].device})")
        return self._renderers[name, use]

    def _capture(self, record: StateRecord) -> dict[str, CameraImages]:
        """Return the images of the scene's cameras by camera name; read-only, since the whole process shares them."""
        cameras = self.world.scene.cameras
        if not cameras:
            return {}
        assert self._rig is not None
        poses = self.world.camera_poses()
        views = [(camera, poses[camera.name]) for camera in cameras]
        images = self._rig.capture(record.seq, record.stamp_ns, self.world.body_poses(), views)
        for one in images.values():
            one.freeze()
        return images

    def _publisher(self, topic: str) -> Publisher:
        if topic not in self._outputs:
            kind = KINDS.get(topic) or camera_kind(topic)
            self._outputs[topic] = self.create_publisher(kind, topic, PROFILES.get(topic, qos.SENSOR))
        return self._outputs[topic]

    # ---------------------------------------------------------------- services

    def _on_load_scene(self, request: LoadScene.Request, response: LoadScene.Response) -> None:
        limits.require_episode_id(request.episode_id)
        self._refuse_foreign(request.episode_id, request.holder)
        limits.require_count("semantics of an episode", len(request.semantics), 1)
        semantics = from_msg(request.semantics[0], ActionSemantics) if request.semantics else None
        scene = from_msg(request.scene, SceneSpec)
        record = self.load(scene, request.episode_id, request.renderer, semantics)
        response.state = to_msg(record, StateRecordMsg)
        self._holder = request.holder
        response.renderer = f"{self._renderer_name} ({self._device(self._renderer_name)})"

    def _on_tick(self, request: Tick.Request, response: Tick.Response) -> None:
        record = self.tick(request.episode_id, request.seq, request.action)
        response.state = to_msg(record, StateRecordMsg)

    def _on_release(self, request: ReleaseEpisode.Request, response: ReleaseEpisode.Response) -> None:
        self.world.release(request.episode_id)

    def _on_get_state(self, request: GetState.Request, response: GetState.Response) -> None:
        response.scene = to_msg(self.world.scene, SceneSpecMsg)
        response.state = to_msg(self.world.record, StateRecordMsg)

    def _on_take_snapshot(self, request: TakeSnapshot.Request, response: TakeSnapshot.Response) -> None:
        response.snapshot_json = to_json(self.world.snapshot())

    def _on_restore_snapshot(self, request: RestoreSnapshot.Request, response: RestoreSnapshot.Response) -> None:
        limits.require_episode_id(request.episode_id)
        self._refuse_foreign(request.episode_id)
        snapshot = from_json(request.snapshot_json, Snapshot, source="snapshot_json")
        record = self._replace_world(
            snapshot.scene, self._renderer_name, lambda: self.world.restore(snapshot, request.episode_id)
        )
        response.state = to_msg(record, StateRecordMsg)
        self._holder = ""

    def _on_render_state(self, request: RenderState.Request, response: RenderState.Response) -> None:
        scene, state = from_msg(request.scene, SceneSpec), from_msg(request.state, StateRecord)
        states = self._state_renderer(request.renderer)
        renderer = states.renderer
        images = states.draw(scene, state)
        answers = {"image": response.images, "depth": response.depth, "segmentation": response.segmentation}
        for camera in scene.cameras:
            for kind, msg in camera_msgs(state.stamp_ns, camera, images[camera.name]).items():
                if kind in answers:
                    answers[kind].append(CameraImage(camera=camera.name, image=msg))
        response.renderer = f"{renderer.name} ({renderer.device})"

    def _state_renderer(self, name: str) -> StateRenderer:
        name = name or self.config.renderer
        if name not in self._states:
            self._states[name] = StateRenderer(self._renderer(name, "states"), self.library)
        return self._states[name]

    def _segment(self, scene: SceneSpec, state: StateRecord, renderer: str) -> dict[str, npt.NDArray[np.uint16]]:
        """Return the segmentation images of a state by camera, as ``sim/render_state`` does."""
        images = self._state_renderer(renderer).draw(scene, state, colour=False)
        return {name: one.segmentation for name, one in images.items() if one.segmentation is not None}

    def _refuse_foreign(self, episode_id: str, holder: str = "") -> None:
        """Reject another episode while one holds the sim, unless both have the same holder.

        A holder runs one episode at a time: if it loads a second one, it died during the first and was restarted.
        """
        held = self.world.episode_id
        if held and held != episode_id and not (holder and holder == self._holder):
            raise SimError(
                f"episode '{held}' holds the sim; release it first (sim/release_episode, with an empty episode_id if "
                "its holder has died)",
                ErrorCode.LEASE_HELD,
            )
