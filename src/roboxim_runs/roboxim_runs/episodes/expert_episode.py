"""An expert's episode in this process, with the observations that a policy would receive and the actions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ActionContext
from roboxim_core.episode import EpisodeResult, EpisodeRunner, RunConfig
from roboxim_core.errors import EvaluationError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import CameraRequirement, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.rotation.representations import Floats
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpertEpisode:
    """What the expert saw and did."""

    result: EpisodeResult
    """The episode's result."""
    instruction: str
    """The instruction."""
    observations: Sequence[Observation]
    """Observation before each action; pictures of the requested cameras."""
    states: Sequence[StateRecord]
    """State before each action."""
    actions: Floats
    """Executed actions of RoboXim's default meaning, shape (n, 7)."""
    track: Sequence[ActionContext]
    """State of the arm before each action, with the robot's kinematics."""
    rate_hz: float
    """Control rate [Hz]."""
    scene: SceneSpec
    """The scene."""

    @property
    def speed(self) -> float:
        """Mean speed of the tool centre point [m/s]."""
        return float(np.linalg.norm(self.actions[:, :3], axis=1).mean()) * self.rate_hz

    @property
    def joints(self) -> Floats:
        """Measured arm joint positions before each action, shape (n, joints) [rad]."""
        return np.array([state.robot.joint_positions for state in self.states], dtype=float)

    @property
    def joint_speed(self) -> float:
        """Mean speed of the arm joints, as the norm over all joints [rad/s]."""
        return float(np.linalg.norm(np.diff(self.joints, axis=0), axis=1).mean()) * self.rate_hz

    def window(self, seq: int, size: int) -> ObservationWindow:
        """Return the observation window of a tick."""
        first = max(seq - size + 1, 0)
        seen = list(self.observations[first : seq + 1])
        missing = size - len(seen)
        return ObservationWindow(
            instruction=self.instruction, observations=[seen[0]] * missing + seen,
            pad_mask=(False,) * missing + (True,) * len(seen), episode_id=self.result.episode_id, seq=seq,
        )  # fmt: skip


def expert_episode(
    task_config: str = "", *, cameras: tuple[CameraRequirement, ...] = (), rate_hz: float = 0.0, seed: int = 0,
    index: int = 0, renderer: str = "raster", attempts: int = 5,
) -> ExpertEpisode:  # fmt: skip
    """Run the expert until it succeeds, and return that episode.

    Args:
        task_config: Task configuration as YAML text; empty: the default task.
        cameras: Cameras whose pictures are kept, with their sizes.
        rate_hz: Control rate [Hz]; 0: the task's.
        seed: Seed of the run.
        index: Index of the first episode to try.
        renderer: Renderer.
        attempts: Number of indices to try.

    Raises:
        EvaluationError: When the expert does not succeed.
        RoboximError: When a scene cannot be drawn or rendered.
    """
    config = RunConfig(
        run_seed=seed, purpose="eval", task_config=task_config, rate_hz=rate_hz, output_dir="",
        cameras=tuple(camera.name for camera in cameras),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder), renderer=renderer) as graph:
        ports = graph.ports
        watched = _Watched(ports.sim)
        actor: Any = _Seeing(ports.actor, cameras)
        runner = EpisodeRunner(replace(ports, sim=watched, actor=actor), config)
        for number in range(index, index + attempts):
            result = runner.run_index(number)
            if result.outcome == "success" and result.steps:
                return watched.episode(result, actor.instruction)
    raise EvaluationError(
        f"the expert did not succeed in {attempts} episodes of the task (last: {result.reason} {result.message}), so "
        "there is nothing to compare a policy with; choose another task"
    )


class _Watched:
    """The simulator's port, which remembers what passes."""

    def __init__(self, sim: Any) -> None:
        self._sim = sim

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sim, name)

    def load(self, episode_id: str, scene: SceneSpec, *more: Any, **named: Any) -> StateRecord:
        record: StateRecord = self._sim.load(episode_id, scene, *more, **named)
        self._scene = scene
        self._states: list[StateRecord] = [record]
        self._actions: list[Floats] = []
        self._observations: dict[int, Observation] = {}
        return record

    def tick(self, episode_id: str, seq: int, action: Any) -> StateRecord:
        record: StateRecord = self._sim.tick(episode_id, seq, action)
        self._actions.append(np.array(action, dtype=float))
        self._states.append(record)
        return record

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        observation: Observation = self._sim.observe(state, cameras)
        images = {name: image.copy() for name, image in observation.images.items()}
        self._observations[state.seq] = replace(observation, images=images)
        return observation

    def episode(self, result: EpisodeResult, instruction: str) -> ExpertEpisode:
        count = result.steps
        robot = self._scene.robot
        kinematics = ArmKinematics(ModelLibrary().robot(robot.model))
        states = self._states[:count]
        return ExpertEpisode(
            result=result, instruction=instruction, states=states,
            observations=[self._observations[state.seq] for state in states],
            actions=np.stack(self._actions[:count]),
            track=[ActionContext.of(state, robot.pose, kinematics) for state in states],
            rate_hz=self._scene.control_rate_hz, scene=self._scene,
        )  # fmt: skip


class _Seeing:
    """The expert, to whom cameras are shown."""

    def __init__(self, actor: Any, cameras: tuple[CameraRequirement, ...]) -> None:
        self._actor = actor
        self._cameras = cameras
        self.instruction = ""

    def describe(self) -> PolicyDescription:
        description: PolicyDescription = self._actor.describe()
        return replace(description, cameras=self._cameras)

    def reset(self, start: EpisodeStart) -> None:
        self.instruction = start.instruction
        self._actor.reset(start)

    def act(self, window: ObservationWindow) -> Any:
        return self._actor.act(window)
