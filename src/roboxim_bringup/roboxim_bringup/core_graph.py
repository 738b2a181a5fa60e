"""The episode loop's ports, served by the rooms' cores: the same episodes, images and bags without a node graph.

For tests (an episode through the nodes must equal this one, bit for bit) and for the benchmark of the graph's overhead.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from rclpy.serialization import serialize_message
from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg
from std_msgs.msg import String

from roboxim_bringup.cores import CorePlanner, CoreSegmentation
from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.closing import Closing
from roboxim_core.episode import ActorPort, Draw, EpisodeInfo, EpisodeResult, EpisodeStep, Ports
from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.policies import Observation, Policy
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.proprioception import Proprioception
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_core.vision.renderer import CameraImages
from roboxim_recorder import topics
from roboxim_recorder.bag_writer import bag_path
from roboxim_recorder.recording import EpisodeRecording
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.messages.serialising import to_cdr
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import CameraRig
from roboxim_sim.tick_messages import TickMessages
from roboxim_sim.world import World
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.demonstration.expert import Expert
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.judging import Judge
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.visible import Visibility


class CoreTasks:
    """Draws and judges."""

    def __init__(
        self,
        library: ModelLibrary,
        solvability: Solvability | None = None,
        segmentation: CoreSegmentation | None = None,
    ) -> None:
        """Draw scenes; with the checks, only those that have a solution and whose cameras see the named objects."""
        self.generator = EpisodeGenerator(library, solvability, Visibility(segmentation) if segmentation else None)
        self._parse = lru_cache(maxsize=16)(parse_task_config)
        self._judge: Judge | None = None

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        """Draw the episode of a seed path."""
        return self.generator.draw(seed, self._parse(task_config) if task_config else load_task_config())

    def start(self, episode_id: str, task: TaskSpec, state: StateRecord) -> Verdict:
        """Start a fold."""
        self._judge = Judge(task)
        return self._judge.start(state)

    def judge(self, state: StateRecord) -> Verdict:
        """Judge the next tick."""
        assert self._judge is not None
        return self._judge.step(state)


class CoreActor(GuardedPolicy):
    """A policy, called directly, behind the same guard as in a node."""

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy."""
        super().__init__(policy, named_errors=(RoboximError,))


class CoreSim:
    """World and renderer; makes the sim node's messages on request."""

    def __init__(self, library: ModelLibrary, renderer: str = "raster") -> None:
        """Make the world and the renderer in the calling thread."""
        self.library = library
        self.world = World(library)
        self._renderer = make_renderer(renderer)
        self._rig = CameraRig(self._renderer)
        self._messages: Mapping[str, memoryview] = {}
        self._tick_messages: TickMessages | None = None
        self.images: dict[str, CameraImages] = {}

    @property
    def renderer(self) -> str:
        """Renderer and device."""
        return f"{self._renderer.name} ({self._renderer.device})"

    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics | None = None) -> StateRecord:
        """Rebuild the world for actions of a meaning (default: end-effector deltas) and return tick 0."""
        record = self.world.load(scene, episode_id, semantics)
        if scene.cameras:
            self._rig.load(render_world(scene, self.library), scene)
        self._tick_messages = TickMessages(scene, self.world.robot, self.world.scene_poses)
        self._capture(record)
        return record

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action."""
        record = self.world.tick(seq, action, episode_id=episode_id)
        self._capture(record)
        return record

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        """Return the tick's observation."""
        images = {name: self.images[name].rgb for name in cameras}
        return Observation(
            seq=state.seq,
            stamp_ns=state.stamp_ns,
            images=images,
            proprio=Proprioception.of(state, self.world.scene.robot.pose),
        )

    def release(self, episode_id: str) -> None:
        """Release the lease."""
        self.world.release(episode_id)

    def close(self) -> None:
        """Free everything."""
        self._renderer.close()
        self.world.close()

    def _capture(self, record: StateRecord) -> None:
        """Draw a tick's images; its messages are made on request."""
        cameras, self._messages = self.world.scene.cameras, {}
        if cameras:
            poses = self.world.camera_poses()
            views = [(camera, poses[camera.name]) for camera in cameras]
            self.images = self._rig.capture(record.seq, record.stamp_ns, self.world.body_poses(), views)

    @property
    def messages(self) -> Mapping[str, memoryview]:
        """The newest tick's serialised messages, by topic."""
        if not self._messages:
            assert self._tick_messages is not None
            self._messages = self._tick_messages.make(self.world.record, self.images)
        return self._messages


class CoreRecorder:
    """Writes bags."""

    def __init__(self, sim: CoreSim, output_dir: Path, *, acted_by: Callable[[EpisodeStep], str] | None = None) -> None:
        """Record a sim's episodes into a folder.

        Args:
            sim: The simulator.
            output_dir: The folder.
            acted_by: Returns who acted in a step, if that may change within an episode; none: bags do not say it.
        """
        self._sim = sim
        self._output_dir = output_dir
        self._acted_by = acted_by
        self._recording: EpisodeRecording | None = None

    def open(self, info: EpisodeInfo) -> None:
        """Open the episode's bag."""
        self._recording = EpisodeRecording(
            self._output_dir, info, serialize_message(to_msg(info, EpisodeInfoMsg)),
            topics.ACTORS if self._acted_by else {},
        )  # fmt: skip

    def step(self, step: EpisodeStep) -> None:
        """Write a tick."""
        assert self._recording is not None
        for topic, message in self._sim.messages.items():
            self._recording.message(f"/{topic}", message)
        if self._acted_by and step.phase == "act":
            self._recording.message(topics.ACTED_BY, serialize_message(String(data=self._acted_by(step))))
        self._recording.message(topics.STEP, to_cdr(step, topics.ALWAYS[topics.STEP]))
        self._recording.flush()

    def wait_written(self) -> None:
        """Return at once: `step` writes."""

    def close(self, result: EpisodeResult, keep: str, received: Sequence[str] = ()) -> str:
        """Close the bag."""
        assert self._recording is not None
        result = replace(result, bag=bag_path(result.episode_id, keep))
        path = self._recording.close(result, serialize_message(to_msg(result, EpisodeResultMsg)), keep, received)
        self._recording = None
        return path

    def abort(self) -> None:
        """Discard an open bag."""
        if self._recording is not None:
            self._recording.drop()
            self._recording = None


class CoreGraph(Closing):
    """All rooms without nodes. A context manager; belongs to the thread that made it."""

    def __init__(self, output_dir: Path, *, renderer: str = "raster", policy: Policy | None = None) -> None:
        """Make every core.

        Args:
            output_dir: Folder of the bags.
            renderer: Renderer by name.
            policy: The actor; none: the expert.
        """
        library = ModelLibrary()
        self.sim = CoreSim(library, renderer)
        planner = CorePlanner(library)
        self.segmentation = CoreSegmentation(library)
        solvability = Solvability(library, planner)
        self.tasks = CoreTasks(library, solvability, self.segmentation)
        self._actor: ActorPort = CoreActor(policy or Expert(library, planner, solvability=solvability))
        self._recorder = CoreRecorder(self.sim, output_dir)

    @property
    def ports(self) -> Ports:
        """The ports."""
        return Ports(
            scenes=self.tasks, sim=self.sim, actor=self._actor, judge=self.tasks, recorder=self._recorder,
            clock=time.monotonic,
        )  # fmt: skip

    def close(self) -> None:
        """Free everything."""
        self.segmentation.close()
        self.sim.close()
