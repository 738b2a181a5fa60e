"""The sides of the episode loop: small protocols that ROS clients serve in the graph and the cores in tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from roboxim_core.actions import ActionArray
from roboxim_core.episode.records import Draw, EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict


class ScenePort(Protocol):
    """Draws tasks and scenes."""

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        """Draw the episode of a seed path; `TaskError` when a reset is not feasible."""
        ...


class SimPort(Protocol):
    """The simulator."""

    def load(self, episode_id: str, scene: SceneSpec) -> StateRecord:
        """Rebuild the world and settle: tick 0."""
        ...

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action; returns tick ``seq``."""
        ...

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        """Return the whole observation of a tick; a missing part is an error by name, never an older frame."""
        ...

    def release(self, episode_id: str) -> None:
        """Give the lease back."""
        ...

    @property
    def renderer(self) -> str:
        """Renderer and device in use."""
        ...


class ActorPort(Protocol):
    """The policy. Its faults are raised as `PolicyError`."""

    def describe(self) -> PolicyDescription:
        """Say what it is."""
        ...

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode."""
        ...

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the next actions."""
        ...


class JudgePort(Protocol):
    """The judge."""

    def start(self, episode_id: str, task: TaskSpec, state: StateRecord) -> Verdict:
        """Start a fold with tick 0."""
        ...

    def judge(self, state: StateRecord) -> Verdict:
        """Fold the next tick."""
        ...


class RecorderPort(Protocol):
    """The recorder."""

    def open(self, info: EpisodeInfo) -> None:
        """Open the episode's bag; called before tick 0 is made."""
        ...

    def step(self, step: EpisodeStep) -> None:
        """Add a tick; returns when the bag has it as a whole."""
        ...

    def close(self, result: EpisodeResult, keep: str) -> str:
        """Close the bag (``keep``, ``set_apart`` or ``drop``) and return its path relative to the output folder."""
        ...

    def abort(self) -> None:
        """Drop an open bag after a fault; never raises."""
        ...


@dataclass(frozen=True, kw_only=True)
class Ports:
    """The five sides of the loop."""

    scenes: ScenePort
    """Draws tasks and scenes."""
    sim: SimPort
    """The simulator."""
    actor: ActorPort
    """The policy."""
    judge: JudgePort
    """The judge."""
    recorder: RecorderPort
    """The recorder."""
    clock: Callable[[], float]
    """Monotonic wall clock [s], for the report only."""
