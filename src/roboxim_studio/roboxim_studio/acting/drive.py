"""Episodes that a person drives, tick by tick, recorded as bags like any other. Belongs to the bench's thread."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.actions import ANY_RATE, ActionArray, ActionSemantics
from roboxim_core.episode import Draw, EpisodeResult, RunConfig
from roboxim_core.episode.runner import Play, episode_id
from roboxim_core.errors import ErrorCode, PolicyError, TaskError
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord
from roboxim_recorder.bag_writer import PLACES
from roboxim_studio.acting.take import FilmRecorder, OnTick, begin
from roboxim_studio.episode.film import Film

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph

HUMAN = "human"
"""Name of the actor in bags."""
MOST_STEPS = 3000
"""Actions after which an episode ends."""


class Human:
    """Declares what a person does: end-effector deltas, at any rate. Never asked; the drive sends the actions."""

    def describe(self) -> PolicyDescription:
        """Return the description."""
        return PolicyDescription(name=HUMAN, semantics=ActionSemantics(rate_hz=ANY_RATE))

    def reset(self, start: EpisodeStart) -> None:
        """Start nothing."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Refuse.

        Raises:
            PolicyError: Always.
        """
        raise PolicyError("a person's actions come from the page")


def next_index(folder: Path, seed: SeedPath) -> int:
    """Return the first index of a seed that has no bag in a folder, kept or set apart."""
    there = {path.name for place in PLACES.values() for path in (folder / place).glob("*")}
    index = seed.index
    while episode_id(replace(seed, index=index)) in there:
        index += 1
    return index


class Drive:
    """One episode. `step` executes an action; after the end `film` is there, until then `close` sets it apart."""

    def __init__(
        self, graph: CoreGraph, draw: Draw, seed: SeedPath, folder: Path, *, on_tick: OnTick = lambda *_: None
    ) -> None:
        """Begin an episode.

        Args:
            graph: The cores.
            draw: Task and scene.
            seed: Names the episode.
            folder: Folder of the bags.
            on_tick: Called with every tick.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE`` when the episode cannot begin.
        """
        from roboxim_bringup.core_graph import CoreRecorder
        from roboxim_eval.node import versions

        self._folder = folder
        self._recorder = FilmRecorder(graph.sim, bags=CoreRecorder(graph.sim, folder), on_tick=on_tick)
        config = RunConfig(
            run_seed=seed.run_seed, purpose=seed.purpose, actor=HUMAN, max_steps=MOST_STEPS, keep="all",
            output_dir=str(folder.absolute()),
        )  # fmt: skip
        _, play = begin(graph, draw, Human(), self._recorder, seed, config=config, versions=versions())
        self._sim = graph.sim
        self.rate_hz = draw.scene.control_rate_hz
        """Control rate [Hz]."""
        self.result: EpisodeResult | None = None
        """The result; none while it runs."""
        self._play: Play | None = play
        try:
            next(play)
            play.send(None)
        except StopIteration as end:
            self._play = None
            result: EpisodeResult = end.value
            raise TaskError(result.message, ErrorCode.RESET_INFEASIBLE) from None

    @property
    def state(self) -> StateRecord:
        """The present state."""
        return self._sim.world.record

    @property
    def film(self) -> Film | None:
        """The episode, when it has ended."""
        film = self._recorder.film
        return replace(film, path=self.bag) if film is not None else None

    @property
    def bag(self) -> Path | None:
        """Its bag; none while it runs, and when there is none."""
        return self._folder / self.result.bag if self.result is not None and self.result.bag else None

    def step(self, action: ActionArray, *, last: bool = False) -> bool:
        """Execute an action.

        Args:
            action: Of the default meaning, float32, shape (7,).
            last: Whether the person ends the episode with it; the robot then holds still, and the judge decides.

        Returns:
            Whether the episode goes on.

        Raises:
            RoboximError: On a fault of the simulator or the recorder.
        """
        if self._play is None:
            return False
        try:
            self._play.send(ActionChunk(actions=np.asarray(action, np.float32)[None], done=last))
        except StopIteration as end:
            self._play = None
            self.result = end.value
        except BaseException:
            self._play = None
            raise
        return self._play is not None

    def throw_away(self) -> None:
        """Drop the episode, running or ended, with its bag."""
        if self._play is not None:
            self._play.close()
            self._play = None
        if (bag := self.bag) is not None and bag.parent.name in PLACES.values():
            shutil.rmtree(bag)
            assert self.result is not None
            self.result = replace(self.result, bag="")

    def close(self) -> str:
        """Set a running episode apart, so that nothing is lost.

        Returns:
            Path of its bag below the folder; empty when it has ended already.
        """
        if self._play is None:
            return ""
        path = self._recorder.set_apart()
        self._play.close()
        self._play = None
        return path
