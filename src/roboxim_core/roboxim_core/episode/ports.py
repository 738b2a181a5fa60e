"""Ports of the episode loop: small protocols that ROS clients implement in the graph, and the cores in tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode.records import Draw, EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict


class ScenePort(Protocol):
    """Source of tasks and scenes."""

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        """Draw the episode of a seed path.

        Raises:
            TaskError: When the reset is not feasible.
        """
        ...


class SimPort(Protocol):
    """The simulator."""

    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics) -> StateRecord:
        """Rebuild the world for actions of a meaning, let it settle, and return tick 0."""
        ...

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action and return tick ``seq``."""
        ...

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        """Return the complete observation of a tick; raise an error naming missing parts, never use older frames."""
        ...

    def release(self, episode_id: str) -> None:
        """Release the episode's lease of the sim."""
        ...

    @property
    def renderer(self) -> str:
        """Renderer and device in use."""
        ...


class ActorPort(Protocol):
    """The policy. Its faults are raised as `PolicyError`."""

    def describe(self) -> PolicyDescription:
        """Return the policy's description."""
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
        """Start a new verdict with tick 0."""
        ...

    def judge(self, state: StateRecord) -> Verdict:
        """Update the verdict with the next tick."""
        ...


class RecorderPort(Protocol):
    """The recorder."""

    def open(self, info: EpisodeInfo) -> None:
        """Open the episode's bag; called before the scene is loaded."""
        ...

    def step(self, step: EpisodeStep) -> None:
        """Add a tick; it may still be on its way into the bag on return."""
        ...

    def wait_written(self) -> None:
        """Wait until every tick is in the bag. The loop calls it before the simulator continues."""
        ...

    def close(self, result: EpisodeResult, keep: str, received: Sequence[str] = ()) -> str:
        """Close the bag (``keep``, ``set_apart`` or ``drop``) and return its path relative to the output folder.

        Args:
            result: How the episode ended.
            keep: What becomes of the bag.
            received: Instructions that the policy was given in the episode, each once; empty: unknown.
        """
        ...

    def abort(self) -> None:
        """Drop an open bag after a fault; never raises."""
        ...


@dataclass(frozen=True, kw_only=True)
class Ports:
    """The ports and the clock that the loop uses."""

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
