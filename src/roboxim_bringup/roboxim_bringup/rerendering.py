"""Renders recorded episodes again: other cameras, lights, materials, resolution, renderer; everything else as recorded.

No graph is started: a bag holds the scene and the state of every tick, and a renderer needs no more. Images come from
the very code that the sim node runs (`roboxim_sim.rendering.rig`), so unchanged settings give the recorded images, bit
for bit on one type of machine. What is not of a camera is copied as it was recorded, byte for byte.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import queue
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rclpy.serialization import serialize_message
from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg

from roboxim_bringup.process import describe_exit, die_with_parent
from roboxim_bringup.run_folder import RunFolder
from roboxim_core.cameras import load_camera, with_noise_seed
from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError, UnavailableError, one_of, raise_for_code
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.recorded import recorded_parameters
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import RGB, CameraSpec, LightSpec, LookSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, find_episode
from roboxim_recorder.recording import EpisodeRecording
from roboxim_ros.conversions import from_msg, to_msg
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.photo import THREADS_VARIABLE
from roboxim_sim.rendering.rig import CameraRig
from roboxim_sim.rendering.textures import pixels
from roboxim_sim.tick_messages import OF_STATE, TickMessages, tick_notice

SURFACES = ("table", "floor", "wall")


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """A YAML file of ``config/lights``."""

    lights: tuple[LightSpec, ...] = ()
    """The lights; the first one that casts a shadow is the main light."""
    ambient: RGB | None = None
    """Radiance of the surroundings; none: as the scene has it."""


@dataclass(frozen=True, kw_only=True)
class RerenderConfig:
    """What changes; what is left out stays as recorded."""

    renderer: str = "raster"
    """Renderer by name."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Camera to its file in ``config/cameras``, empty: as recorded; no entry at all: the recorded cameras."""
    width: int = 0
    """Image width [px]; 0: as the camera has it."""
    height: int = 0
    """Image height [px]; 0: as the camera has it."""
    depth: bool | None = None
    """Whether the cameras give depth; none: as each camera has it."""
    segmentation: bool | None = None
    """Whether the cameras give segmentation; none: as each camera has it."""
    look: LookSpec | None = None
    """Look of another scene, applied first."""
    lights: tuple[LightSpec, ...] | None = None
    """Lights instead of the scene's."""
    ambient: RGB | None = None
    """Radiance of the surroundings."""
    textures: dict[str, str] = field(default_factory=dict)
    """Surface (table, floor, wall) to the name of its texture; an empty name: none."""
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

    def _cameras(self, info: EpisodeInfo) -> Iterator[CameraSpec]:
        recorded = {camera.name: camera for camera in info.scene.cameras}
        seed = SeedPath(run_seed=info.run_seed, purpose=info.purpose, index=info.index, attempt=info.attempt)
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
        """Render a bag again into a run's folder; a bag there of the same episode is an error.

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
        scene = self.config.scene(info)
        changed = json.loads(info.config_json) | {"rerender": to_plain(self.config)}
        new = replace(
            info,
            scene=scene,
            renderer=f"{self._renderer.name} ({self._renderer.device})",
            rerendered_from=info.episode_id,
            config_json=json.dumps(changed),
            recorded={**info.recorded, **recorded_parameters(info.task, scene)},
        )
        known = {*topics.OWN, *topics.scene_topics(info.scene), *topics.scene_topics(scene)}
        extra = {topic: kind for topic, kind in reader.types.items() if topic not in known}
        recording = EpisodeRecording(out, new, _cdr(to_msg(new, EpisodeInfoMsg)), extra)
        try:
            self._copy(reader, scene, recording, on_tick)
            result = reader.result
            return replace(result, bag=recording.close(result, _cdr(to_msg(result, EpisodeResultMsg)), "keep"))
        except BaseException:
            recording.drop()
            raise

    def _copy(
        self, reader: BagReader, scene: SceneSpec, recording: EpisodeRecording, on_tick: Callable[[], None]
    ) -> None:
        """Give every tick of a bag to a recording, its cameras' part made anew."""
        rig, poses = CameraRig(self._renderer), ScenePoses(scene, self._library)
        rig.load(render_world(scene, self._library), scene)
        tick_messages = TickMessages(scene, self._library.robot(scene.robot.model), poses)
        of_cameras = {topic for topic in topics.scene_topics(reader.info.scene) if topic not in topics.ALWAYS}
        made_anew = {*of_cameras, *topics.OF_SCENE, "/tf", topics.NOTICE}
        state: StateRecord | None = None
        for topic, cdr in reader.raw():
            if topic in (topics.NOTICE, topics.RESULT) and state is not None:  # extra topics follow a tick's step
                cameras = poses.camera_poses(state.robot)
                images = rig.capture(state.seq, poses.body_poses(state), [(c, cameras[c.name]) for c in scene.cameras])
                made = tick_messages.make_seen(state, images)
                notice = tick_notice(state, {**dict.fromkeys(OF_STATE), **made})
                for name, message in {**made, topics.NOTICE: notice}.items():
                    recording.message(topics.absolute(name), _cdr(message))
                state = None
                on_tick()
            if topic == topics.STATE:
                state = from_msg(reader.decode(topic, cdr), StateRecord)
            if topic not in made_anew and topic not in topics.OWN:
                recording.message(topic, cdr)


def _cdr(message: Any) -> bytes:
    return bytes(serialize_message(message))


# ------------------------------------------------------------------ many bags, on several processes


@dataclass(frozen=True, kw_only=True)
class Rerendered:
    """What came of a run."""

    made: int
    """Bags rendered now."""
    there: int
    """Bags that were there from before."""
    changed: tuple[str, ...]
    """Models that have changed since an episode was recorded; they are drawn as they are now."""


def rerender(
    bags: Sequence[Path],
    out: Path,
    config: RerenderConfig,
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Rerendered:
    """Render bags again into a new run's folder; bags that it has already are left alone.

    Args:
        bags: The recorded bags.
        out: Folder of the new run.
        config: What changes.
        workers: Processes, each with a renderer.
        progress: Called with ticks done and ticks in all.

    Raises:
        ConfigError: When the folder holds another run, a camera is unknown, or two bags are of one episode.
        RoboximError: When a bag is damaged or cannot be drawn, or a worker dies; the same call goes on after it.
    """
    episodes = _episodes(bags)
    for reader in episodes.values():
        config.scene(reader.info)  # whatever is wrong with it is said before anything is rendered
    with RunFolder(out).opened({"rerender": to_plain(config)}) as folder:
        recorded = {result.episode_id for result in folder.results()}
        done = {name for name in episodes if find_episode(folder.path, name)}
        for name in done - recorded:  # killed between the bag and its line
            bag = folder.path / "episodes" / name
            folder.append(replace(BagReader(bag).result, bag=str(bag.relative_to(folder.path))))
        missing = {name: reader for name, reader in episodes.items() if name not in done}
        total = sum(map(len, episodes.values()))
        ticks = total - sum(map(len, missing.values()))
        progress(ticks, total)

        def tell(result: EpisodeResult | None = None) -> None:
            """Take in that a tick is done, or a bag."""
            nonlocal ticks
            if result is not None:
                folder.append(result)
            else:
                ticks += 1
                progress(ticks, total)

        paths = [reader.path for reader in missing.values()]
        if min(workers, len(paths)) > 1:
            _render_on_processes(paths, folder.path, config, min(workers, len(paths)), tell)
        elif paths:
            _render(paths, folder.path, config, tell)
    library = ModelLibrary()
    changed = {model for reader in episodes.values() for model in library.changed(reader.info.models)}
    return Rerendered(made=len(missing), there=len(done), changed=tuple(sorted(changed)))


def _episodes(bags: Sequence[Path]) -> dict[str, BagReader]:
    episodes: dict[str, BagReader] = {}
    for path in bags:
        reader = BagReader(path)
        name = reader.info.episode_id
        if name in episodes:
            raise ConfigError(
                f"{path} and {episodes[name].path} are both of episode '{name}'; render the runs that they are of "
                "into folders of their own"
            )
        episodes[name] = reader
    return episodes


def _render(
    paths: Iterable[Path], out: Path, config: RerenderConfig, tell: Callable[[EpisodeResult | None], None]
) -> None:
    """Render bags in this process."""
    renderer = Rerenderer(config)
    try:
        for path in paths:
            tell(renderer.bag(path, out, lambda: tell(None)))
    finally:
        renderer.close()


def _render_on_processes(
    paths: Sequence[Path],
    out: Path,
    config: RerenderConfig,
    workers: int,
    tell: Callable[[EpisodeResult | None], None],
) -> None:
    """Start workers, give each the next bag when it has finished one, and pass on what they tell."""
    context = multiprocessing.get_context("spawn")  # a forked renderer hangs
    bags, events = context.Queue(), context.Queue()
    for path in [*map(str, paths), *[""] * workers]:
        bags.put(path)
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    arguments = (bags, events, str(out), to_plain(config), threads, os.getpid())
    processes = [context.Process(target=_work, args=arguments, daemon=True) for _ in range(workers)]
    try:
        for process in processes:
            process.start()
        while any(process.is_alive() for process in processes) or not events.empty():
            with contextlib.suppress(queue.Empty):
                event = events.get(timeout=0.2)
                if isinstance(event, tuple):
                    raise_for_code(*event)
                tell(event)
        for process in processes:
            if process.exitcode:
                raise UnavailableError(
                    f"a rendering process ended unexpectedly ({describe_exit(process.exitcode)}); "
                    "the same command goes on with what is missing"
                )
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _work(bags: Any, events: Any, out: str, config: dict[str, Any], threads: int, parent: int) -> None:
    """Render bags until an empty path comes; an error is told as its code and text.

    The parent handles Ctrl-C and ends this process.
    """
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault(THREADS_VARIABLE, str(threads))
    try:
        paths = (Path(path) for path in iter(bags.get, ""))
        _render(paths, Path(out), from_plain(config, RerenderConfig), events.put)
    except RoboximError as error:
        events.put((int(error.code), str(error)))
