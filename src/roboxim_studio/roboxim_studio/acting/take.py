"""One episode in this process, from a given task and scene, kept in memory as a film and, if wanted, as a bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from roboxim_core.episode import (
    ActorPort,
    Draw,
    EpisodeInfo,
    EpisodeResult,
    EpisodeRunner,
    EpisodeStep,
    RunConfig,
    SimPort,
)
from roboxim_core.episode.runner import Play
from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord
from roboxim_runs.answers.trying import episode_loop
from roboxim_studio.episode.film import Film, Pictures

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph, CoreRecorder, CoreSim  # a second to import: when it is needed

OnTick = Callable[[StateRecord, EpisodeStep], None]


class FilmRecorder:
    """A recorder that keeps an episode in memory, and hands it on to one that writes a bag."""

    def __init__(self, sim: CoreSim, *, bags: CoreRecorder | None = None, on_tick: OnTick = lambda *_: None) -> None:
        """Record a sim's episodes.

        Args:
            sim: The simulator, whose newest images are kept.
            bags: Recorder of bags; none: nothing is written.
            on_tick: Called with every tick.
        """
        self._sim, self._bags, self._on_tick = sim, bags, on_tick
        self.film: Film | None = None
        """The episode, when it is closed."""
        self.info: EpisodeInfo | None = None
        """The running episode; none: there is none."""

    def open(self, info: EpisodeInfo) -> None:
        """Begin an episode."""
        self.info, self.film, self._pictures = info, None, Pictures()
        self._states: list[StateRecord] = []
        self._steps: list[EpisodeStep] = []
        if self._bags:
            self._bags.open(info)

    def step(self, step: EpisodeStep) -> None:
        """Keep a tick."""
        state = self._sim.world.record
        self._states.append(state)
        self._steps.append(step)
        self._pictures.add(state.seq, {name: seen.rgb for name, seen in self._sim.images.items()})
        if self._bags:
            self._bags.step(step)
        self._on_tick(state, step)

    def wait_written(self) -> None:
        """Return at once: `step` writes."""

    def close(self, result: EpisodeResult, keep: str, received: Sequence[str] = ()) -> str:
        """End an episode."""
        path = self._bags.close(result, keep, received) if self._bags else ""
        self._finish(result)
        return path

    def abort(self) -> None:
        """Drop an open bag; what was seen stays a film that ends where it was aborted."""
        if self._bags:
            self._bags.abort()
        if self.info is not None and self._states:
            self._finish(interrupted(self.info, self._states[-1], self._steps))

    def set_apart(self) -> str:
        """Close an episode that was not played to its end, and set its bag apart.

        Returns:
            Path of the bag below the output folder; empty: there is none.
        """
        if self.info is None or not self._states:
            return ""
        return self.close(interrupted(self.info, self._states[-1], self._steps), "set_apart")

    def _finish(self, result: EpisodeResult) -> None:
        assert self.info is not None
        self._pictures.complete.set()
        self.film = Film(
            title=self.info.episode_id, info=self.info, result=result, states=tuple(self._states),
            steps=tuple(self._steps), pictures=self._pictures,
        )  # fmt: skip
        self.info = None


INTERRUPTED = "interrupted"
"""Reason of an episode that was not played to its end."""


def interrupted(info: EpisodeInfo, state: StateRecord, steps: Sequence[EpisodeStep]) -> EpisodeResult:
    """Return the result of an episode that ended before it was judged, in a state, after all of its steps."""
    verdict = steps[-1].verdict
    return EpisodeResult(
        episode_id=info.episode_id, index=info.index, attempt=info.attempt, outcome="failure", reason=INTERRUPTED,
        message="the studio was closed, or the episode was stopped", last_seq=state.seq,
        steps=sum(step.phase == "act" for step in steps), success_ever=verdict.success_ever,
        verdict=verdict, instruction=info.task.instruction, skill=info.task.skill,
        final_state_hash=state.state_hash,
    )  # fmt: skip


def begin(
    graph: CoreGraph, draw: Draw, actor: ActorPort, recorder: FilmRecorder, seed: SeedPath, *, config: RunConfig,
    sim: SimPort | None = None, versions: dict[str, str] | None = None, cancelled: Callable[[], bool] = lambda: False,
    repeat: Sequence[Sequence[float]] = (),
) -> tuple[EpisodeRunner, Play]:  # fmt: skip
    """Return the loop of an episode, ready to be played.

    Args:
        graph: The cores; of this thread.
        draw: Task and scene.
        actor: The actor; the loop asks it only for its description if the caller answers its requests.
        recorder: Keeps the episode.
        seed: Names the episode, and seeds the actor.
        config: Configuration of the run.
        sim: The simulator's port; none: the graph's.
        versions: Package to version, for a bag.
        cancelled: Called before every tick; True ends the episode.
        repeat: Executed actions to begin with; see `EpisodeRunner`.
    """
    runner = episode_loop(
        graph, draw, actor, recorder, config=config, sim=sim, versions=versions, library=graph.sim.library,
        repeat=repeat,
    )  # fmt: skip
    return runner, runner.play(seed, cancelled)


def take(
    graph: CoreGraph, draw: Draw, actor: ActorPort, seed: SeedPath, *, config: RunConfig | None = None,
    sim: SimPort | None = None, bags: Path | None = None, on_tick: OnTick = lambda *_: None,
    cancelled: Callable[[], bool] = lambda: False, repeat: Sequence[Sequence[float]] = (),
) -> Film:  # fmt: skip
    """Run an episode to its end with an actor.

    Args:
        graph: The cores; of this thread.
        draw: Task and scene.
        actor: Who acts.
        seed: Names the episode, and seeds the actor.
        config: Configuration of the run; none: the default.
        sim: The simulator's port; none: the graph's.
        bags: Folder for its bag; none: it stays in memory.
        on_tick: Called with every tick.
        cancelled: Called before every tick; True ends the episode.
        repeat: Executed actions to begin with; see `EpisodeRunner`.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when the episode cannot begin.
        RoboximError: On a fault of the simulator, or on cancellation.
    """
    from roboxim_bringup.core_graph import CoreRecorder

    recorder = FilmRecorder(graph.sim, bags=CoreRecorder(graph.sim, bags) if bags else None, on_tick=on_tick)
    runner, _ = begin(graph, draw, actor, recorder, seed, config=config or RunConfig(), sim=sim, repeat=repeat)
    result = runner.run_attempt(seed, cancelled)
    if recorder.film is None:
        raise TaskError(result.message or f"the episode did not begin: {result.reason}", ErrorCode.RESET_INFEASIBLE)
    return recorder.film
