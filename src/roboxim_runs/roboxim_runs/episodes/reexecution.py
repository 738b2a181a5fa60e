"""Executes actions again from an episode's restored scene, as the episode loop would, and judges them.

It starts no node graph and renders no cameras: no verdict needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode import EpisodeInfo
from roboxim_core.episode.acting import holding_action
from roboxim_core.episode.runner import LEFT_WORKSPACE, SETTLE_S
from roboxim_core.rates import ticks
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_sim.world import World
from roboxim_tasks.judging import Judge


@dataclass(frozen=True, kw_only=True)
class Execution:
    """What executed actions have led to."""

    success: bool
    """Whether the task was solved at the end, after the robot held still."""
    reason: str
    """Why it was not; empty on success."""
    steps: int
    """Actions executed, settling excluded."""
    verdict: Verdict
    """The last verdict."""


NextAction = Callable[[StateRecord], ActionArray | None]
"""Returns the action that follows a state; None: there is none left."""


def execute(
    world: World,
    episode_id: str,
    task: TaskSpec,
    scene: SceneSpec,
    next_action: NextAction,
    *,
    semantics: ActionSemantics | None = None,
    on_state: Callable[[StateRecord], None] = lambda _: None,
    to_the_end: bool = False,
) -> Execution:
    """Execute actions from a scene until success, failure or the last action, then hold still and judge.

    Args:
        world: The simulator's world, held by no episode.
        episode_id: Id to run under.
        task: The task to judge.
        scene: The scene; its control rate is that of the actions.
        next_action: Returns the actions, float32, shape (D,).
        semantics: Their meaning, one that the simulator executes; none: the default.
        on_state: Called with every state, tick 0 included, settling excluded.
        to_the_end: Whether to execute every action, also after a success.

    Raises:
        RoboximError: When the sim rejects a request, or an action is not valid.
    """
    semantics = semantics or ActionSemantics(rate_hz=scene.control_rate_hz)
    judge = Judge(task)
    try:
        state = world.load(scene, episode_id, semantics)
        verdict = judge.start(state)
        on_state(state)
        steps = 0
        while to_the_end or not (verdict.success or verdict.failed):
            if state.left_workspace and scene.workspace.on_leave == "fail":
                return Execution(success=False, reason=LEFT_WORKSPACE, steps=steps, verdict=verdict)
            action = next_action(state)
            if action is None:
                break
            state = world.tick(state.seq + 1, action, episode_id=episode_id)
            verdict = judge.step(state)
            on_state(state)
            steps += 1
        for _ in range(ticks(SETTLE_S, scene.control_rate_hz)):
            state = world.tick(state.seq + 1, holding_action(state, semantics), episode_id=episode_id)
            verdict = judge.step(state)
    finally:
        world.release(episode_id)
    reason = "" if verdict.success else verdict.reason or "not_solved"
    return Execution(success=verdict.success, reason=reason, steps=steps, verdict=verdict)


def rejudge(info: EpisodeInfo, states: Sequence[StateRecord]) -> Verdict | None:
    """Execute recorded ticks again and judge them; see `roboxim_recorder.integrity.repair.Rejudge`.

    Args:
        info: The episode.
        states: Its states from tick 0, which hold the executed actions.

    Returns:
        The verdict after the robot has held still; None: a state differs from the recorded one, so that the verdict
        would be of another episode.
    """
    same = True

    def compare(state: StateRecord) -> None:
        nonlocal same
        same = same and state.state_hash == states[state.seq].state_hash

    def recorded(state: StateRecord) -> ActionArray | None:
        after = state.seq + 1
        if not same or after == len(states):
            return None
        return np.array(states[after].action_executed, np.float32)

    with closing(World()) as world:
        execution = execute(
            world, info.episode_id, info.task, info.scene, recorded, semantics=info.semantics, on_state=compare,
            to_the_end=True,
        )  # fmt: skip
    return execution.verdict if same else None
