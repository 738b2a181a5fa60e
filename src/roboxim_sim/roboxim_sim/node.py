"""The sim node: serves the world and publishes its state and camera images.

Everything runs in the thread that spins the node: PyBullet and GL contexts belong to one thread. A long motion is a
coroutine that yields to the executor after every control period, so that it can be cancelled.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.context import Context
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
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
from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_json, load_config, named_config, to_json
from roboxim_core.errors import ErrorCode, RequestTimeoutError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.rendering import CameraImages, Renderer
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_ros import local_ticks, qos
from roboxim_ros.conversions import from_msg, to_msg
from roboxim_ros.local_ticks import PublishedTick
from roboxim_sim.conversions import camera_msgs
from roboxim_sim.ports import SimConfig, SimServer
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import CameraRig
from roboxim_sim.rendering.states import StateRenderer
from roboxim_sim.ros import MotionActions, StandardServices
from roboxim_sim.snapshots import Snapshot
from roboxim_sim.tick_messages import KINDS, NOTICE, OF_SCENE, TickMessages
from roboxim_sim.world import World

PROFILES = {topic: qos.LATCHED if topic in OF_SCENE else qos.STATE for topic in KINDS}
"""QoS by topic; camera topics use `qos.SENSOR`."""


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
        self._scene_out = self.create_publisher(SceneSpecMsg, "sim/scene", qos.LATCHED)
        self._outputs: dict[str, Publisher] = {}
        self._notices = self.resolve_topic_name(NOTICE)
        for topic, kind in KINDS.items():
            self._publisher(topic, kind)

        self.serve(LoadScene, "sim/load_scene", self._on_load_scene)
        self.serve(Tick, "sim/tick", self._on_tick, lockstep=True)
        self.serve(ReleaseEpisode, "sim/release_episode", self._on_release)
        self.serve(GetState, "sim/get_state", self._on_get_state)
        self.serve(TakeSnapshot, "sim/take_snapshot", self._on_take_snapshot)
        self.serve(RestoreSnapshot, "sim/restore_snapshot", self._on_restore_snapshot)
        self.serve(RenderState, "sim/render_state", self._on_render_state)
        self._standard = StandardServices(self)
        self._motions = MotionActions(self)
        if self.config.scene:
            self.load(load_config(named_config("scenes", self.config.scene), SceneSpec))

    def destroy_node(self) -> None:
        """Free the world and the renderers."""
        self._motions.destroy()
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self.world.close()
        super().destroy_node()

    # ---------------------------------------------------------------- what the handlers share

    @property
    def renderer_info(self) -> dict[str, str]:
        """Name and device of the renderer in use; the device says when the renderer does not work on this machine."""
        try:
            device = self._renderer(self._renderer_name, "live").device
        except SimError as error:
            device = f"unavailable: {error}"
        return {"simulator": "RoboXim (PyBullet)", "renderer": self._renderer_name, "device": device}

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
    ) -> StateRecordMsg:
        """Load a scene and publish tick 0; after a failure no episode holds the sim."""
        for camera in scene.cameras:
            limits.require_name("camera", camera.name, topic=True)
        if scene.cameras:
            self._renderer(renderer or self.config.renderer, "live")
        self._renderer_name = renderer or self.config.renderer
        record = self.world.load(scene, episode_id, semantics)
        return self._publish_or_release(record)

    def scene_changed(self) -> StateRecordMsg:
        """Publish the scene and its state after entities were added or removed."""
        self._show_world()
        return self.publish(self.world.record)

    def publish(self, record: StateRecord) -> StateRecordMsg:
        """Publish all topics of a state and return its message."""
        assert self._tick_messages is not None
        messages = self._tick_messages.make(record, self._capture(record))
        serialised = {topic: serialize_message(message) for topic, message in messages.items()}
        for topic, cdr in serialised.items():
            self._publisher(topic, type(messages[topic])).publish(cdr)
        tick = PublishedTick(
            episode_id=record.episode_id, seq=record.seq, stamp_ns=record.stamp_ns, messages=serialised
        )
        local_ticks.show(self.context, self._notices, tick)
        state: StateRecordMsg = messages["sim/state"]
        return state

    def _publish_or_release(self, record: StateRecord) -> StateRecordMsg:
        try:
            self._show_world()
            return self.publish(record)
        except Exception:
            self.world.release()
            raise

    def _show_world(self) -> None:
        scene = self.world.scene
        self._scene_out.publish(to_msg(scene, SceneSpecMsg))
        self._tick_messages = TickMessages(scene, self.world.robot, self.world.scene_poses)
        if scene.cameras:
            self._rig = CameraRig(self._renderer(self._renderer_name, "live"))
            self._rig.load(render_world(scene, self.library), scene)

    def _renderer(self, name: str, use: str) -> Renderer:
        """Return a renderer; the live world and re-rendered states have one each."""
        if (name, use) not in self._renderers:
            self._renderers[name, use] = make_renderer(name)
            self.get_logger().info(f"renderer for {use} images: {name} ({self._renderers[name, use].device})")
        return self._renderers[name, use]

    def _capture(self, record: StateRecord) -> dict[str, CameraImages]:
        """Return the images of the scene's cameras by camera name."""
        cameras = self.world.scene.cameras
        if not cameras:
            return {}
        assert self._rig is not None
        poses = self.world.camera_poses()
        return self._rig.capture(
            record.seq, self.world.body_poses(), [(camera, poses[camera.name]) for camera in cameras]
        )

    def _publisher(self, topic: str, kind: Any) -> Publisher:
        if topic not in self._outputs:
            self._outputs[topic] = self.create_publisher(kind, topic, PROFILES.get(topic, qos.SENSOR))
        return self._outputs[topic]

    # ---------------------------------------------------------------- services

    def _on_load_scene(self, request: LoadScene.Request, response: LoadScene.Response) -> None:
        limits.require_episode_id(request.episode_id)
        self._refuse_foreign(request.episode_id, request.holder)
        limits.require_count("semantics of an episode", len(request.semantics), 1)
        semantics = from_msg(request.semantics[0], ActionSemantics) if request.semantics else None
        scene = from_msg(request.scene, SceneSpec)
        response.state = self.load(scene, request.episode_id, request.renderer, semantics)
        self._holder = request.holder
        response.renderer = self._renderer_text()

    def _on_tick(self, request: Tick.Request, response: Tick.Response) -> None:
        record = self.world.tick(request.seq, np.asarray(request.action), episode_id=request.episode_id)
        response.state = self.publish(record)

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
        for camera in snapshot.scene.cameras:
            limits.require_name("camera", camera.name, topic=True)
        if snapshot.scene.cameras:
            self._renderer(self._renderer_name, "live")
        record = self.world.restore(snapshot, request.episode_id)
        response.state = self._publish_or_release(record)
        self._holder = ""

    def _on_render_state(self, request: RenderState.Request, response: RenderState.Response) -> None:
        scene, state = from_msg(request.scene, SceneSpec), from_msg(request.state, StateRecord)
        name = request.renderer or self.config.renderer
        if name not in self._states:
            self._states[name] = StateRenderer(self._renderer(name, "states"), self.library)
        renderer = self._states[name].renderer
        images = self._states[name].draw(scene, state)
        answers = {"image": response.images, "depth": response.depth, "segmentation": response.segmentation}
        for camera in scene.cameras:
            for kind, msg in camera_msgs(state.stamp_ns, camera, images[camera.name]).items():
                if kind in answers:
                    answers[kind].append(CameraImage(camera=camera.name, image=msg))
        response.renderer = f"{renderer.name} ({renderer.device})"

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

    def _renderer_text(self) -> str:
        info = self.renderer_info
        return f"{info['renderer']} ({info['device']})"
