"""An actor that repeats an episode up to a tick and then hands over to another actor.

The other actor starts in exactly the same state: the simulator is deterministic, so repeating the executed actions from
the same scene restores everything, contacts and the solver's memory included. `roboxim_studio.acting.what_if` and
`roboxim_runs.answers.comparing` use it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roboxim_core.actions import ActionArray
from roboxim_core.episode import ActorPort
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.state import StateRecord


class HandOver:
    """An actor that repeats recorded actions up to a tick; then another actor acts, or the repetition continues."""

    def __init__(
        self, states: Sequence[StateRecord], tick: int, then: ActorPort | None, *,
        recorded: PolicyDescription | None = None, last: int = 0,
    ) -> None:  # fmt: skip
        """Repeat the actions of an episode up to a tick.

        Args:
            states: Its states from tick 0, which hold the executed actions.
            tick: The last tick that they lead to.
            then: Who acts from there; none: the recorded actions continue.
            recorded: Description of the recorded actions, needed if they continue.
            last: Number of recorded actions, if they continue.
        """
        self._states, self._tick, self._then, self._recorded, self._last = states, tick, then, recorded, last

    def describe(self) -> PolicyDescription:
        """Return the description of who acts from the tick on."""
        if self._then is not None:
            return self._then.describe()
        assert self._recorded is not None
        return self._recorded

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode."""
        if self._then is not None:
            self._then.reset(start)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the next action."""
        after = window.seq + 1
        if self._then is not None and window.seq >= self._tick:
            return self._then.act(window)
        return ActionChunk(actions=_action(self._states[after])[None], done=after == self._last and self._then is None)


def _action(state: StateRecord) -> ActionArray:
    return np.array(state.action_executed, np.float32)


__all__ = ["HandOver"]
