"""The lag of another simulator's controller: a motion begins slowly and continues after its command has ended.

Policies that were trained in a simulator with a soft controller have learned to act with its lag. `MotionLag`
reproduces it for the executed actions of an episode, one after another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roboxim_core.actions.chunks import ActionArray
from roboxim_core.errors import InvalidRequestError

COMPONENTS = 6
"""Components of a motion: translation x, y, z and rotation x, y, z."""


def require_lag(lag: Sequence[float]) -> None:
    """Refuse a lag that is neither empty nor six numbers of 0 <= number < 1.

    Raises:
        InvalidRequestError: Naming the given lag.
    """
    if len(lag) not in (0, COMPONENTS) or not all(0.0 <= number < 1.0 for number in lag):
        raise InvalidRequestError(f"lag must be empty or {COMPONENTS} numbers from 0 to below 1, got {list(lag)}")


class MotionLag:
    """A first-order lag of each component of a motion, in one episode: y_k = d y_(k-1) + (1 - d) u_k.

    The total motion equals the total command; it is only delayed.
    """

    def __init__(self, lag: Sequence[float]) -> None:
        """Start an episode, at rest.

        Args:
            lag: d of each component, shape (6,); empty: no lag.

        Raises:
            InvalidRequestError: As `require_lag`.
        """
        require_lag(lag)
        self._lag = np.array(lag, dtype=float)
        self._moving = np.zeros(len(lag))

    def step(self, action: ActionArray) -> ActionArray:
        """Return the next action as the lagging arm executes it.

        Args:
            action: Motion of the tool centre point as translation [m] and three angles or a rotation vector [rad], then
                the gripper, which does not lag; shape (7,).
        """
        if not len(self._lag):
            return action
        self._moving = self._lag * self._moving + (1.0 - self._lag) * action[:COMPONENTS]
        return np.append(self._moving, action[COMPONENTS:]).astype(action.dtype)

    def rest(self) -> None:
        """Bring the arm to rest, e.g. after a hold action."""
        self._moving[:] = 0.0
