"""Renders recorded episodes again with other cameras, lights, materials, resolution or renderer.

No graph is started: the scene and the states in a bag are all that a renderer needs. Images come from the same code as
in the sim node (`roboxim_sim.rendering.camera_effects`). Unchanged settings therefore give the recorded images, bit for
bit on one type of machine. All topics other than the cameras' are copied byte for byte.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rclpy.serialization import serialize_message
from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg

from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.plain_data.pictures import file_of
from roboxim_core.recorded import recorded_parameters
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import RGB, CameraSpec, LightSpec, LookSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.user_folders import expanded
from roboxim_core.vision.cameras import load_camera, with_noise_seed
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, find_episode
from roboxim_recorder.recording import EpisodeRecording
from roboxim_recorder.run_bags import list_bags
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_runs.events import OnEvent, Reporter, ReportProgress, ignore
from roboxim_runs.executors import Cancellation, Executor, Job, Note, Work, run_required
from roboxim_runs.scenes.definitions import SURFACES, picture_of, pictures_of
from roboxim_runs.storage.folder import RunFolder, checked_path
from roboxim_runs.storage.store import file_sha256
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import CameraRig
from roboxim_sim.rendering.photo import THREADS_VARIABLE
from roboxim_sim.rendering.textures import pixels
from roboxim_sim.tick_messages import TickMessages


@dataclass(frozen=True, kw_only=True)
class RerenderConfig:
    """Changes to the recorded episodes; a field left out changes nothing."""

    renderer: str = "raster"
    """Renderer by name."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Camera name to its file in ``config/cameras``, empty: as recorded. An empty dict: the recorded cameras."""
    width: int = 0
    """Image width [px]; 0: the camera's."""
    height: int = 0
    """Image height [px]; 0: the camera's."""
    depth: bool | None = None
    """Whether the cameras give depth; none: as each camera is configured."""
    segmentation: bool | None = None
    """Whether the cameras give segmentation; none: as each camera is configured."""
    look: LookSpec | None = None
    """Scene in ``config/scenes`` whose look is applied first; empty: none."""
    lights: tuple[LightSpec, ...] | None = None
    """Lights that replace the scene's."""
    ambient: RGB | None = None
    """Radiance of the surroundings."""
    textures: dict[str, str] = field(default_factory=dict)
    """Surface (table, floor, wall) to the name of its texture; an empty name: no texture."""
    background: str = ""
    """``room`` or ``plain``; empty: as recorded."""

    def __post_init__(self) -> None:
        """Check surfaces and textures.

        Raises:
            ConfigError: On an unknown surface or texture.
        """
        for surface, texture in self.textures.items():
            if surface not in SURFACES:
                raise ConfigError(f"no surface '{surface}'; {one_of(SURFACES, surface)}")
            pixels(texture)

    @property
    def files(self) -> dict[str, dict[str, str]]:
        """Images of textures with their hashes, for the run's configuration; empty: all textures are built-in."""
        named = {*map(picture_of, self.textures.values()), *(pictures_of(self.look) if self.look else ())} - {""}
        return {"files": {name: file_sha256(file_of(name)[0]) for name in sorted(named)}} if named else {}

    def scene(self, info: EpisodeInfo) -> SceneSpec:
        """Return an episode's scene with the changes applied.

        Raises:
            ConfigError: On an unknown camera.
            InvalidRequestError: When a change makes no valid scene.
        """
        look = self.look or info.scene.look
        if self.lights is not None:
            look = replace(look, lights=self.lights)
        if self.ambient is not None:
            look = replace(look, ambient=self.ambient)
        for surface, texture in self.textures.items():
            look = replace(look, **{surface: replace(getattr(look, surface), texture=texture)})
        if self.background:
            look = replace(look, background=self.background)
        return replace(info.scene, look=look, cameras=tuple(self._cameras(info)))

    def info(self, info: EpisodeInfo, renderer: str) -> EpisodeInfo:
        """Return what defines an episode that is rendered again, with the changes applied.

        Args:
            info: The recorded episode's.
            renderer: Renderer and device.

        Raises:
            ConfigError: On an unknown camera.
            InvalidRequestError: When a change makes no valid scene.
        """
        scene = self.scene(info)
        return replace(
            info,
            scene=scene,
            renderer=renderer,
            rerendered_from=info.episode_id,
            config_json=json.dumps(json.loads(info.config_json) | {"rerender": to_plain(self)}),
            recorded={**info.recorded, **recorded_parameters(info.task, scene)},
        )

    def _cameras(self, info: EpisodeInfo) -> Iterator[CameraSpec]:
        recorded = {camera.name: camera for camera in info.scene.cameras}
        seed = SeedPath(run_seed=info.run_seed, purpose=info.purpose, index=info.index, attempt=info.attempt)
        seed = seed.of_task(info.task.drawn)
        for name, file in (self.cameras or dict.fromkeys(recorded, "")).items():
            if not file and name in recorded:
                camera = recorded[name]
            else:
                camera = with_noise_seed(replace(load_camera(file or name), name=name), seed)
            camera = camera.resized(self.width or camera.width, self.height or camera.height)
            yield replace(
                camera,
                depth=camera.depth if self.depth is None else self.depth,
                segmentation=camera.segmentation if self.segmentation is None else self.segmentation,
            )


class Rerenderer:
    """Renders bags again with one renderer; belongs to the thread that made it."""

    def __init__(self, config: RerenderConfig) -> None:
        """Make the renderer.

        Raises:
            ConfigError: When no renderer has the name.
            SimError: RENDERER_UNAVAILABLE when it does not work here.
        """
        self.config = config
        self._renderer = make_renderer(config.renderer)
        self._library = ModelLibrary()

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def bag(self, source: Path, out: Path, on_tick: Callable[[], None] = lambda: None) -> EpisodeResult:
        """Render a bag again into a run's folder. An existing bag of the same episode is an error.

        Args:
            source: The recorded bag.
            out: Folder of the new run, absolute.
            on_tick: Called after every tick.

        Returns:
            The episode's result, with the new bag's path.

        Raises:
            RoboximError: When the bag is damaged, the scene cannot be drawn, or the new bag cannot be written.
        """
        reader = BagReader(source)
        info = reader.info
        new = self.config.info(info, f"{self._renderer.name} ({self._renderer.device})")
        scene = new.scene
        known = {*topics.OWN, *topics.scene_topics(info.scene), *topics.scene_topics(scene)}
        extra = {topic: kind for topic, kind in reader.types.items() if topic not in known}
        recording = EpisodeRecording(out, new, _cdr(to_msg(new, EpisodeInfoMsg)), extra)
        try:
            self._copy(reader, scene, recording, on_tick)
            result = reader.result
            cdr = _cdr(to_msg(result, EpisodeResultMsg))
            return replace(result, bag=recording.close(result, cdr, "keep", reader.received))
        except BaseException:
            recording.drop()
            raise

    def _copy(
        self, reader: BagReader, scene: SceneSpec, recording: EpisodeRecording, on_tick: Callable[[], None]
    ) -> None:
        """Copy every tick of a bag to a recording, with new camera messages."""
        rig, poses = CameraRig(self._renderer), ScenePoses(scene, self._library)
        rig.load(render_world(scene, self._library), scene)
        tick_messages = TickMessages(scene, self._library.robot(scene.robot.model), poses)
        of_cameras = {topic for topic in topics.scene_topics(reader.info.scene) if topic not in topics.ALWAYS}
        made_anew = {*of_cameras, *topics.OF_SCENE, "/tf", topics.NOTICE}
        state: StateRecord | None = None
        for topic, cdr in reader.raw():
            if topic in (topics.NOTICE, topics.RESULT) and state is not None:  # extra topics follow a tick's step
                cameras = poses.camera_poses(state.robot)
                views = [(c, cameras[c.name]) for c in scene.cameras]
                images = rig.capture(state.seq, state.stamp_ns, poses.body_poses(state), views)
                for name, message in tick_messages.make_seen(state, images).items():
                    recording.message(topics.absolute(name), message)
                state = None
                on_tick()
            if topic == topics.STATE:
                state = from_msg(reader.decode(topic, cdr), StateRecord)
            if topic not in made_anew and topic not in topics.OWN:
                recording.message(topic, cdr)


def _cdr(message: Any) -> bytes:
    return bytes(serialize_message(message))


# ------------------------------------------------------------------ many bags, on several processes


class RerenderWorker:
    """Renders one bag per job, whose data is the bag's path; see `roboxim_runs.executors`."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Make the renderer.

        Args:
            settings: ``config``, a `RerenderConfig` as plain data, and ``out``, the run's folder.
            number: The worker's number.
        """
        self._out = Path(settings["out"])
        self._renderer = Rerenderer(from_plain(settings["config"], RerenderConfig))

    def run(self, job: str, note: Callable[[Any], None]) -> dict[str, Any]:
        """Render a bag, and report every tick."""
        result: dict[str, Any] = to_plain(self._renderer.bag(Path(job), self._out, lambda: note("tick")))
        return result

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


@dataclass(frozen=True, kw_only=True)
class Rerendered:
    """Result of rendering bags again."""

    made: int
    """Bags rendered now."""
    there: int
    """Number of bags that existed before."""
    changed: tuple[str, ...]
    """Models that have changed since the recording; they are drawn as they are now."""


def find_bags(sources: Iterable[Path | str]) -> list[Path]:
    """Return all bags among bags, folders of bags and runs.

    Raises:
        ConfigError: When there is no such folder.
        RecorderError: When one holds no bag.
    """
    return [bag for source in map(expanded, sources) for bag in ([source] if source.is_file() else list_bags(source))]


def rerender(
    sources: Path | str | Sequence[Path | str],
    out: Path | str,
    config: RerenderConfig,
    *,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
) -> Rerendered:
    """Render recorded episodes again into a new run's folder. Bags that it has already are kept.

    Args:
        sources: Bags, folders of bags or runs.
        out: Folder of the new run.
        config: Changes to the recorded episodes.
        workers: Processes, each with a renderer; 1: this process.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Renders the bags; none: the local one.

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: When the folder holds another run, or a rendering of another recording, a camera is unknown, or
            two bags are of one episode.
        RoboximError: When a bag is damaged or cannot be drawn, or workers die; the same call continues afterwards.
    """
    checked_path(out)
    episodes = _episodes(find_bags([sources] if isinstance(sources, Path | str) else sources))
    for reader in episodes.values():
        config.scene(reader.info)  # raise on a wrong change before rendering starts
    folder, reporter = RunFolder(out), Reporter(on_event)
    with (
        reporter.resumable("the same call or command renders the missing bags"),
        folder.opened({"rerender": to_plain(config), **config.files}),
    ):
        recorded = {result.episode_id for result in folder.results()}
        done = {name for name, reader in episodes.items() if _is_rendered(reader, config, folder.path)}
        for name in sorted(done - recorded):  # killed between the bag and its line
            bag = folder.path / "episodes" / name
            folder.append(replace(BagReader(bag).result, bag=str(bag.relative_to(folder.path))))
        missing = {name: reader for name, reader in episodes.items() if name not in done}
        total = sum(map(len, episodes.values()))
        before = total - sum(map(len, missing.values()))
        with reporter.stage("rendering", total, "ticks", before) as progress:
            progress(before)
            ticks = _Ticks(before, progress, reporter)
            if missing:
                _render(
                    missing,
                    folder,
                    config,
                    workers,
                    executor=executor,
                    cancellation=cancellation,
                    on_note=ticks.receive,
                )
    library = ModelLibrary()
    changed = {model for reader in episodes.values() for model in library.changed(reader.info.models)}
    return Rerendered(made=len(missing), there=len(done), changed=tuple(sorted(changed)))


def _is_rendered(reader: BagReader, config: RerenderConfig, out: Path) -> bool:
    """Return whether a run has the rendering of a bag.

    Raises:
        ConfigError: When it has the rendering of another recording of that name.
    """
    bag = find_episode(out, reader.info.episode_id)
    if bag is None:
        return False
    there = BagReader(bag)
    if there.info != config.info(reader.info, there.info.renderer) or there.result != reader.result:
        raise ConfigError(
            f"{bag} is not the rendering of {reader.path}, but of another recording with that name, or with another "
            "state of its cameras' files; choose another output folder (--out or out=)"
        )
    return True


class _Ticks:
    """Count of rendered ticks. When a worker dies, its bag's ticks are counted again from 0."""

    def __init__(self, before: int, progress: ReportProgress, reporter: Reporter) -> None:
        self._before, self._progress, self._reporter = before, progress, reporter
        self._of_bag: Counter[str] = Counter()

    def receive(self, note: Note) -> None:
        if note.text:
            self._of_bag[note.key] = 0
            self._reporter.notice(note.text)
        elif note.data is not None:
            self._of_bag[note.key] += 1
            self._progress(self._before + self._of_bag.total())


def _render(
    missing: Mapping[str, BagReader], folder: RunFolder, config: RerenderConfig, workers: int, **options: Any
) -> None:  # fmt: skip
    """Render bags, and store each result as soon as it arrives; the options are those of `run_required`."""
    workers = min(workers, len(missing))
    threads = os.environ.get(THREADS_VARIABLE) or str(max(1, len(os.sched_getaffinity(0)) // workers))
    work = Work(
        worker="roboxim_runs.episodes.rerendering:RerenderWorker",
        settings={"config": to_plain(config), "out": str(folder.path)},
        environment={THREADS_VARIABLE: threads},
    )
    jobs = [Job(key=name, data=str(reader.path.resolve())) for name, reader in missing.items()]
    for outcome in run_required(
        work, jobs, lost="bag {} was not rendered", workers=workers, log_dir=folder.path / "logs",
        before_retry=folder.discard_episode, **options,
    ):  # fmt: skip
        folder.append(from_plain(outcome.value, EpisodeResult))


def _episodes(bags: Sequence[Path]) -> dict[str, BagReader]:
    episodes: dict[str, BagReader] = {}
    for path in bags:
        reader = BagReader(path)
        name = reader.info.episode_id
        if name in episodes:
            raise ConfigError(
                f"{path} and {episodes[name].path} are both recordings of episode '{name}'; "
                "render their runs into separate folders"
            )
        episodes[name] = reader
    return episodes
