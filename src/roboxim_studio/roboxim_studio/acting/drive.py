"""Episodes that a person drives, alone or in turns with a policy, tick by tick. Belongs to the bench's thread.

They are recorded as bags like any other. A shared episode records the actor of every action (`roboxim_recorder.acted`).
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.actions import ANY_RATE, ActionArray, ActionSemantics
from roboxim_core.episode import Draw, EpisodeResult, RunConfig
from roboxim_core.episode.runner import Play, Request, episode_id
from roboxim_core.errors import ConfigError, ErrorCode, PolicyError, SimError, TaskError
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord
from roboxim_recorder.acted import ActedBy
from roboxim_recorder.bag_writer import PLACES, disk_errors
from roboxim_runs.storage.folder import locked
from roboxim_studio.acting.partner import Partner
from roboxim_studio.acting.take import FilmRecorder, OnTick, begin
from roboxim_studio.episode.film import Film

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph

HUMAN = "human"
"""Name of the actor in bags."""
MAX_STEPS = 3000
"""Actions after which an episode ends."""


class Human:
    """Declares what a person does: end-effector deltas, at any rate. Never asked; the drive sends the actions."""

    def __init__(self, described: PolicyDescription | None = None) -> None:
        """Describe the person as an actor, or the partner if there is one."""
        self._described = described or PolicyDescription(name=HUMAN, semantics=ActionSemantics(rate_hz=ANY_RATE))

    def describe(self) -> PolicyDescription:
        """Return the description."""
        return self._described

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


def continued(film: Film, tick: int) -> tuple[Draw, list[tuple[StateRecord, ActedBy]]]:
    """Return an episode's task and scene, and its states up to a tick with who acted, for `Drive`.

    Raises:
        ConfigError: When it was not recorded by end-effector motions, as a person acts.
    """
    info = film.info
    if info.semantics.control.is_joint_space:
        raise ConfigError(
            f"the episode was recorded by {info.semantics.control}, a person acts by end-effector motions; take over "
            "in an episode of end-effector motions"
        )
    last = min(tick, film.result.steps)
    states = film.states[1 : last + 1]
    draw = Draw(task=info.task, scene=info.scene, max_steps=MAX_STEPS)
    return draw, list(zip(states, film.actors[:last], strict=True))


class Drive:
    """One episode. `step` executes an action; after the end `film` is there, until then `close` sets it apart."""

    def __init__(
        self, graph: CoreGraph, draw: Draw, seed: SeedPath, folder: Path, *, on_tick: OnTick = lambda *_: None,
        partner: Partner | None = None, after: Sequence[tuple[StateRecord, ActedBy]] = (),
    ) -> None:  # fmt: skip
        """Begin an episode.

        Args:
            graph: The cores.
            draw: Task and scene.
            seed: Names the episode.
            folder: Folder of the bags.
            on_tick: Called with every tick.
            partner: Who acts while the person does not; none: only the person acts.
            after: States of another episode of the scene, from tick 1 on, with who acted; its actions are executed
                first, then the person has control. Empty: a partner has control first.

        Raises:
            ConfigError: When another studio or command writes into the folder.
            RecorderError: With code ``DISK`` when the folder cannot be made.
            TaskError: With code ``RESET_INFEASIBLE`` when the episode cannot begin.
            SimError: With code ``DIVERGED`` when the other episode's actions do not lead to its states.
        """
        from roboxim_bringup.core_graph import CoreRecorder
        from roboxim_eval.node import versions

        self._folder = folder
        self.partner = partner
        """Who acts while the person does not; none: nobody."""
        self.instruction = draw.task.instruction
        """The instruction."""
        self.aim = next((o.entity for role, o in draw.task.objects.items() if not role.startswith("distractor")), "")
        """The first object that the task is about; empty: there is none."""
        self._acts = ActedBy.HUMAN
        self.partner_acts = partner is not None and not after
        """Whether the partner has control."""
        self._shared = shared = partner is not None or bool(after)
        self._acted: list[ActedBy] = []
        bags = CoreRecorder(graph.sim, folder, acted_by=(lambda _: str(self._acts)) if shared else None)
        self._recorder = FilmRecorder(graph.sim, bags=bags, on_tick=on_tick)
        config = RunConfig(
            run_seed=seed.run_seed, purpose=seed.purpose, actor=partner.name if partner else HUMAN,
            max_steps=MAX_STEPS, keep="all", output_dir=str(folder.absolute()),
        )  # fmt: skip
        described = Human(partner.description) if partner else Human()
        _, play = begin(graph, draw, described, self._recorder, seed, config=config, versions=versions())
        self._sim = graph.sim
        self.rate_hz = draw.scene.control_rate_hz
        """Control rate of the episode [Hz]."""
        self.result: EpisodeResult | None = None
        """The result; none while it runs."""
        self._play: Play | None = play
        self._window: Request | None = None
        self._folder_lock = ExitStack()
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._folder_lock.enter_context(locked(folder))  # a recorder removes what another has begun of its episode
        try:
            self._begin(play, after)
        except BaseException:
            self._finish()
            raise

    def _begin(self, play: Play, after: Sequence[tuple[StateRecord, ActedBy]]) -> None:
        try:
            start = next(play)
            self._window = play.send(None)
        except StopIteration as end:
            result: EpisodeResult = end.value
            raise TaskError(result.message, ErrorCode.RESET_INFEASIBLE) from None
        info = self._recorder.info
        assert info is not None
        assert isinstance(start, EpisodeStart)
        self.rate_hz = info.scene.control_rate_hz
        if self.partner is not None:
            self.partner.begin(start, info)
        self._repeat(after)

    def _finish(self) -> None:
        """Execute nothing further; a bag that is still open is dropped, and others may write into the folder."""
        if self._play is not None:
            self._play.close()
            self._play = None
        self._folder_lock.close()

    def _repeat(self, after: Sequence[tuple[StateRecord, ActedBy]]) -> None:
        """Execute another episode's actions; every state must be the recorded one."""
        for recorded, actor in after:
            self._send(ActionChunk(actions=np.array(recorded.action_executed, np.float32)[None]), actor)
            if self.state.state_hash != recorded.state_hash:
                raise SimError(
                    f"the simulator does not repeat the recording: tick {recorded.seq} differs; models or versions "
                    "have changed since",
                    ErrorCode.DIVERGED,
                )

    @property
    def state(self) -> StateRecord:
        """The present state."""
        return self._sim.world.record

    @property
    def runs(self) -> bool:
        """Whether it takes further actions."""
        return self._play is not None

    @property
    def film(self) -> Film | None:
        """The episode, when it has ended."""
        film = self._recorder.film
        return replace(film, path=self.bag, acted=tuple(self._acted)) if film is not None else None

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
            Whether the episode continues.

        Raises:
            RoboximError: On a fault of the simulator or the recorder.
        """
        return self._send(ActionChunk(actions=np.asarray(action, np.float32)[None], done=last), ActedBy.HUMAN)

    def partner_step(self, *, last: bool = False) -> bool:
        """Execute an action of the partner.

        Args:
            last: Whether the person ends the episode with it.

        Returns:
            Whether the episode continues.

        Raises:
            PolicyError: When the partner cannot act; nothing was executed, and the person may take over.
            RoboximError: On a fault of the simulator or the recorder.
        """
        if self._play is None or self.partner is None or not isinstance(self._window, ObservationWindow):
            return False
        chunk = self.partner.act(self._window, self.state)
        return self._send(replace(chunk, done=chunk.done or last), self.partner.acts_as)

    def hand(self, *, to_partner: bool) -> None:
        """Give control to the partner, if there is one, or to the person."""
        if self.partner is not None and to_partner != self.partner_acts:
            self.partner_acts = to_partner
            self.partner.let_go()

    def _send(self, chunk: ActionChunk, actor: ActedBy) -> bool:
        if self._play is None:
            return False
        self._acts = actor
        if self._shared:
            self._acted.append(actor)
        try:
            self._window = self._play.send(chunk)
        except StopIteration as end:
            self._finish()
            self.result = end.value
        except BaseException:
            self._finish()
            raise
        return self._play is not None

    def throw_away(self) -> None:
        """Drop the episode, running or ended, with its bag."""
        self._finish()
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
        self._finish()
        return path
