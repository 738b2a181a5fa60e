"""Executes recorded episodes again with another scene or other actions, and records the result as genuine bags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from roboxim_bringup.core_graph import CoreRecorder, CoreSim
from roboxim_core.closing import Closing
from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.models.library import ModelLibrary
from roboxim_core.recorded import recorded_parameters
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_recorder.bag import BagReader
from roboxim_tasks.judging import Judge

Action = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Act:
    """An action to execute."""

    executed: Action
    """What the controller integrates."""
    label: Action
    """What an imitator should output."""
    phase: str = "act"
    """``act`` or ``settle``."""
    disturbance: bool = False
    """Whether noise was injected."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """A recorded episode, ready to be executed again."""

    info: EpisodeInfo
    """Its scene and task."""
    result: EpisodeResult
    """How it ended."""
    states: tuple[StateRecord, ...]
    """State of every tick."""
    acts: tuple[Act, ...]
    """Action of every tick but the first."""

    @staticmethod
    def of(bag: Path) -> Recorded:
        """Read a bag.

        Raises:
            RecorderError: When it is damaged.
        """
        reader = BagReader(bag)
        ticks = list(reader.ticks(cameras=()))
        acts = tuple(
            Act(
                executed=tick.step.action_executed,
                label=tick.step.action_label,
                phase=tick.step.phase,
                disturbance=tick.step.disturbance,
            )
            for tick in ticks[1:]
        )
        return Recorded(info=reader.info, result=reader.result, states=tuple(tick.state for tick in ticks), acts=acts)


class Reenactor(Closing):
    """A simulator and a recorder. A context manager; belongs to the thread that made it."""

    def __init__(self, out: Path) -> None:
        """Record into a run's folder, by its absolute path."""
        self.library = ModelLibrary()
        self._sim = CoreSim(self.library)
        self._out = out

    def close(self) -> None:
        """Free simulator and renderer."""
        self._sim.close()

    def execute(
        self, recorded: Recorded, scene: SceneSpec, acts: Sequence[Act]
    ) -> tuple[list[bool], list[StateRecord]]:
        """Execute actions in a scene without cameras; return whether each tick is a success, and the states."""
        states = self._execute(recorded.info, replace(scene, cameras=()), acts, None)[0]
        judge = Judge(recorded.info.task)
        verdicts = [judge.start(states[0]), *(judge.step(state) for state in states[1:])]
        return [verdict.success for verdict in verdicts], states

    def record(self, recorded: Recorded, scene: SceneSpec, acts: Sequence[Act]) -> Path:
        """Execute actions in a scene and record a bag; it states the recorded outcome in any case.

        Returns:
            The bag.

        Raises:
            RoboximError: When the scene cannot be built or drawn, or the bag cannot be written.
        """
        found = {**recorded.info.recorded, **recorded_parameters(recorded.info.task, scene)}
        info = replace(recorded.info, scene=scene, recorded=found)
        recorder = CoreRecorder(self._sim, self._out)
        try:
            states, verdict = self._execute(info, scene, acts, recorder)
            result = replace(
                recorded.result,
                steps=sum(act.phase == "act" for act in acts),
                last_seq=len(acts),
                final_state_hash=states[-1].state_hash,
                verdict=verdict,
            )
            return self._out / recorder.close(result, "keep")
        except BaseException:
            recorder.abort()
            raise

    def _execute(
        self, info: EpisodeInfo, scene: SceneSpec, acts: Sequence[Act], recorder: CoreRecorder | None
    ) -> tuple[list[StateRecord], Verdict]:
        judge = Judge(info.task)
        if recorder is not None:
            recorder.open(info)
        try:
            state = self._sim.load(info.episode_id, scene, info.semantics)
            verdict, states = judge.start(state), [state]
            if recorder is not None:
                recorder.step(
                    EpisodeStep(
                        episode_id=info.episode_id, seq=0, stamp_ns=state.stamp_ns, phase="start", verdict=verdict
                    )
                )
            for seq, act in enumerate(acts, start=1):
                state = self._sim.tick(info.episode_id, seq, np.array(act.executed, np.float32))
                verdict = judge.step(state)
                states.append(state)
                if recorder is not None:
                    recorder.step(
                        EpisodeStep(
                            episode_id=info.episode_id, seq=seq, stamp_ns=state.stamp_ns, action_label=act.label,
                            action_executed=state.action_executed, phase=act.phase, disturbance=act.disturbance,
                            verdict=verdict,
                        )
                    )  # fmt: skip
        finally:
            self._sim.release(info.episode_id)
        return states, verdict
