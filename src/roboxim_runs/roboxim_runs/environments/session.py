"""Episodes over the rooms' cores whose actions the caller supplies."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ANY_RATE, ActionSemantics, ControlMode, GripperRule
from roboxim_core.episode import EpisodeResult, EpisodeRunner, RunConfig
from roboxim_core.episode.runner import Play
from roboxim_core.errors import ConfigError, ErrorCode, PolicyError, SimError, TaskError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk, CameraRequirement, EpisodeStart, Observation, ObservationWindow
from roboxim_core.rates import ticks
from roboxim_core.seeds import SeedPath
from roboxim_core.vision.cameras import load_camera
from roboxim_policies import BasePolicy
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.rendering import RENDERERS
from roboxim_tasks.config import TaskMix, parse_task_config
from roboxim_tasks.task_config import TaskConfig

DRAWS = 20
"""Largest number of attempts to draw a scene that can begin."""


@dataclass(frozen=True, kw_only=True)
class SessionConfig:
    """What the episodes of a session have in common."""

    task: str = ""
    """Task of ``config/tasks``, or a YAML file; empty: the default task."""
    size: int | tuple[int, int] = 0
    """Image size [px]: the side of a square, or width and height; 0: as configured."""
    control: str = ControlMode.END_EFFECTOR_DELTA
    """Control mode of the actions, see `roboxim_core.actions.ActionSemantics`."""
    semantics: ActionSemantics | None = None
    """Meaning of the actions; none: that of ``control``, with the default for the rest."""
    gripper: GripperRule = GripperRule()
    """When the gripper opens and closes."""
    lag: tuple[float, ...] = ()
    """Lag of executed motions, see `PolicyDescription.lag`."""
    cameras: tuple[CameraRequirement, ...] = ()
    """Cameras to observe; empty: all of the scene's."""
    rate: float = 0.0
    """Control rate [Hz]; 0: the task's."""
    max_steps: int = 0
    """Actions per episode; 0: as the task says."""
    purpose: str = "eval"
    """``eval``, ``train``, ``demo`` or ``test``: scenes of different purposes are never the same."""
    renderer: str = "raster"
    """``raster`` (needs EGL) or ``tiny`` (PyBullet's own)."""
    out: str = ""
    """Folder for bags of the episodes; empty: nothing is recorded."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            ConfigError: When there is no such renderer or control mode.
        """
        RENDERERS[self.renderer]
        modes = list(ControlMode)
        if self.control not in modes:
            raise ConfigError(f"unknown control '{self.control}'; {one_of(modes, self.control)}")

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]; 0: as configured."""
        return (self.size, self.size) if isinstance(self.size, int) else (self.size[0], self.size[1])

    @property
    def actions(self) -> ActionSemantics:
        """Meaning of the actions; `ANY_RATE` unless a rate is given."""
        return self.semantics or ActionSemantics(control=ControlMode(self.control), rate_hz=self.rate or ANY_RATE)


class _Outside(BasePolicy):
    """Declares what the caller of a session needs; never called."""

    def __init__(self, config: SessionConfig, cameras: tuple[CameraRequirement, ...]) -> None:
        self.name, self.semantics, self.cameras = "outside", config.actions, cameras
        self.gripper, self.lag = config.gripper, config.lag

    def act(self, window: ObservationWindow) -> npt.ArrayLike:
        raise NotImplementedError("the actions of a session come from its caller")


class EpisodeSession:
    """Runs one episode after another; each call of `step` executes one action.

    Non-obvious:

    - Nothing is started and no image is drawn before the first `start`.
    - Physics and GL belong to the thread and the process of the first `start`; another process is refused by name.
    - The step that ends an episode includes the time for which the robot holds still before the final verdict.
    """

    def __init__(self, config: SessionConfig) -> None:
        """Read the task; refuse a process that was forked.

        Raises:
            ConfigError: When there is no such task, its cells have different cameras or robots, or the process was
                forked.
        """
        if type(multiprocessing.current_process()).__name__ == "ForkProcess":
            raise _forked("this process was started by fork")
        self.config = config
        self._text = task_text(config.task)
        parsed = parse_task_config(self._text)
        self._cells: tuple[TaskConfig, ...] = parsed.cells if isinstance(parsed, TaskMix) else (parsed,)
        self._scenes = [cell.base_scene() for cell in self._cells]
        self.cameras = self._camera_sizes()
        """Camera to (width, height) [px]."""
        robots = {scene.robot.model for scene in self._scenes}
        if len(robots) != 1:
            raise ConfigError(f"the task has scenes with several robots ({', '.join(sorted(robots))}); choose one")
        self.robot = ModelLibrary().robot(robots.pop())
        """The robot's model."""
        self._graph: CoreGraph | None = None
        self._play: Play | None = None
        self.begun = EpisodeStart(episode_id="", instruction="", seed=0)
        """What a policy receives when the running episode begins; of a session without episodes empty."""
        self._pid = os.getpid()

    @property
    def rate_hz(self) -> float:
        """Control rate [Hz]; a mix whose cells differ has that of each episode's cell."""
        return self.config.actions.rate_hz or self._cells[0].rate_hz or self._scenes[0].control_rate_hz

    @property
    def max_steps(self) -> int:
        """Largest number of actions of an episode."""
        if self.config.max_steps:
            return self.config.max_steps
        return max(
            ticks(c.max_steps / (c.rate_hz or self._scenes[0].control_rate_hz), self.rate_hz) for c in self._cells
        )

    @property
    def scene_hash(self) -> str:
        """Hash of the running episode's scene, as in its state records."""
        return self._running().sim.world.record.scene_hash

    def start(self, run_seed: int, index: int) -> ObservationWindow:
        """Begin the episode that ``evaluate`` gives for a seed and an index; drop the one that is running.

        A scene that cannot begin is drawn again with the next attempt.

        Returns:
            The first observation.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE`` when no attempt can begin.
            ConfigError: In a process other than the one that made the session.
        """
        self._require_here()
        self._drop()
        graph = self._graph = self._graph or CoreGraph(
            Path(self.config.out or "."), renderer=self.config.renderer, policy=self._actor()
        )
        width, height = self.config.image_size
        config = RunConfig(
            run_seed=run_seed, purpose=self.config.purpose, task_config=self._text, image_width=width,
            image_height=height, max_steps=self.config.max_steps, rate_hz=self.config.actions.rate_hz,
            output_dir=str(Path(self.config.out).resolve()) if self.config.out else "",
        )  # fmt: skip
        runner = EpisodeRunner(graph.ports, config)
        for attempt in range(DRAWS):
            seed = SeedPath(run_seed=run_seed, purpose=self.config.purpose, index=index, attempt=attempt)
            play = runner.play(seed)
            try:
                start = next(play)
                first = play.send(None)
            except StopIteration as end:
                result: EpisodeResult = end.value
                continue
            assert isinstance(start, EpisodeStart)
            assert isinstance(first, ObservationWindow)
            self._play, self.begun = play, start
            return first
        raise TaskError(
            f"no scene of seed {run_seed}, index {index} could begin in {DRAWS} attempts; the last: {result.message}",
            ErrorCode.RESET_INFEASIBLE,
        )

    def step(self, action: Any) -> ObservationWindow | EpisodeResult:
        """Execute one action.

        Args:
            action: Shape (D,), of the session's semantics.

        Returns:
            The next observation, or the result if the episode has ended.

        Raises:
            PolicyError: When no episode is running.
            RoboximError: On a fault of the simulator.
        """
        self._require_here()
        if self._play is None:
            raise PolicyError("no episode is running; start one first")
        try:
            request = self._play.send(ActionChunk(actions=np.asarray(action, np.float32)[None]))
        except StopIteration as end:
            self._play = None
            result: EpisodeResult = end.value
            return result
        except BaseException:
            self._play = None
            raise
        assert isinstance(request, ObservationWindow)
        return request

    def observe(self) -> Observation:
        """Return the observation of the present tick, also after the episode's end."""
        sim = self._running().sim
        return sim.observe(sim.world.record, tuple(self.cameras))

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        self._drop()
        if self._graph is not None and os.getpid() == self._pid:
            self._graph.close()
        self._graph = None

    def _drop(self) -> None:
        if self._play is not None:
            self._play.close()
        self._play = None

    def _running(self) -> CoreGraph:
        if self._graph is None:
            raise SimError("no episode has been started", ErrorCode.NO_SCENE)
        return self._graph

    def _actor(self) -> _Outside:
        cameras = self.config.cameras or tuple(CameraRequirement(name=name) for name in self.cameras)
        return _Outside(self.config, cameras)

    def _camera_sizes(self) -> Mapping[str, tuple[int, int]]:
        found: dict[str, set[tuple[int, int]]] = {}
        names = set()
        for cell in self._cells:
            reset: Any = cell.reset.get("cameras")
            scene = cell.base_scene()
            views = {camera.name: [camera] for camera in scene.cameras}
            if reset:
                files = {name: reset.views[name].values if name in reset.views else (name,) for name in reset.names}
                views = {name: [load_camera(str(file)) for file in paths] for name, paths in files.items()}
            for name, cameras in views.items():
                found.setdefault(name, set()).update((camera.width, camera.height) for camera in cameras)
            names.add(tuple(views))
        if len(names) != 1:
            raise ConfigError(f"the cells of the task have different cameras ({sorted(names)}); choose a single task")
        width, height = self.config.image_size
        for name, sizes in found.items():
            if not width and len(sizes) > 1:
                raise ConfigError(f"the views of camera '{name}' have different sizes {sorted(sizes)}; give a size")
        return {name: (width, height) if width else found[name].copy().pop() for name in names.pop()}

    def _require_here(self) -> None:
        if os.getpid() != self._pid:
            raise _forked("this session was made before the process was forked")


def _forked(what: str) -> ConfigError:
    return ConfigError(
        f"{what}, and physics, GL and threads do not survive a fork; start processes with spawn, e.g. "
        'gymnasium.vector.AsyncVectorEnv(..., context="spawn")'
    )
