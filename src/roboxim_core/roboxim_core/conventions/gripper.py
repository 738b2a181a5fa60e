"""The gripper component of actions: polarity, range, threshold, and decisions that last for several steps.

A policy's number flickers near its threshold, and some policies name a change rather than a position. `GripperDecoder`
keeps the state that such decisions need; it sees every executed action once, in order.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.rotations import Floats


class GripperKind(StrEnum):
    """What the number of the gripper says."""

    ABSOLUTE = "absolute"
    """The position: linear from ``closed`` to ``open``."""
    CHANGE = "change"
    """The position, of which only changes count: a step of more than ``threshold`` between two consecutive actions
    opens or closes the gripper. Source: SimplerEnv's Google robot (``sticky_gripper``)."""
    RELATIVE = "relative"
    """The motion: towards ``open`` or towards ``closed``; within ``threshold`` of their middle: neither."""

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"unknown kind of gripper {value!r}; {one_of(list(cls), str(value))}")


@dataclass(frozen=True, kw_only=True)
class GripperOutput:
    """Meaning of the gripper component of an action."""

    kind: GripperKind = GripperKind.ABSOLUTE
    """What the number says."""
    open: float = 1.0
    """The number of a fully open gripper; for ``relative``: of opening."""
    closed: float = 0.0
    """The number of a closed gripper; for ``relative``: of closing."""
    threshold: float | None = None
    """``absolute``: numbers on the open side of it open the gripper fully, the others close it; none: every opening
    between is commanded as it is. ``change``: the smallest step that counts. ``relative``: half the dead zone."""
    agree: int = 1
    """Consecutive actions that must demand the other state before the gripper changes; needs a threshold."""
    hold: int = 0
    """Number of actions for which a change lasts: further demands are ignored meanwhile; needs a threshold."""

    def __post_init__(self) -> None:
        """Check that the fields fit together.

        Raises:
            InvalidRequestError: Naming the field.
        """
        limits.require_finite("gripper: open, closed, threshold", (self.open, self.closed, self.threshold or 0.0), 1e6)
        if self.open == self.closed:
            raise InvalidRequestError(f"gripper: open and closed must differ, both are {self.open:g}")
        limits.require_range("gripper: agree", self.agree, 1, 1_000)
        limits.require_range("gripper: hold", self.hold, 0, 10_000)
        if self.threshold is None:
            if self.kind != GripperKind.ABSOLUTE or self.agree > 1 or self.hold:
                raise InvalidRequestError(
                    f"gripper: threshold is needed by kind '{self.kind}' with agree {self.agree} and hold {self.hold}"
                )
        elif self.kind == GripperKind.ABSOLUTE:
            low, high = sorted((self.open, self.closed))
            limits.require_range("gripper: threshold, between open and closed,", self.threshold, low, high)
        else:
            limits.require_range("gripper: threshold", self.threshold, 0.0, abs(self.open - self.closed))

    def encode(self, openings: Floats, before: float = 1.0) -> Floats:
        """Return the numbers that command openings one after another.

        Args:
            openings: Shape (n,), 1 = open, 0 = closed.
            before: Commanded opening before the first one.
        """
        span = self.open - self.closed
        if self.kind != GripperKind.RELATIVE:
            return np.asarray(self.closed + openings * span)
        steps = np.sign(np.diff(openings, prepend=before))
        return np.asarray((self.open + self.closed) / 2 + steps * span / 2)


class GripperDecoder:
    """Converter of gripper numbers to openings, one per executed action, in order."""

    def __init__(self, output: GripperOutput, opening: float = 1.0) -> None:
        """Start an episode.

        Args:
            output: Meaning of the numbers.
            opening: Commanded opening before the first action, 1 = open.
        """
        self._output = output
        self._opening = opening
        self._previous: float | None = None
        self._votes = 0
        self._held = 0

    def openings(self, numbers: Floats) -> Floats:
        """Return the openings, shape (n,), 1 = open, 0 = closed, that numbers of shape (n,) command."""
        output = self._output
        if output.kind == GripperKind.ABSOLUTE and output.threshold is None:
            return np.asarray(np.clip((numbers - output.closed) / (output.open - output.closed), 0.0, 1.0))
        return np.array([self._decide(self._wanted(float(number))) for number in numbers], dtype=float)

    def _wanted(self, number: float) -> float | None:
        """Return the opening that a number demands; None: it demands nothing."""
        output, threshold = self._output, self._output.threshold or 0.0
        towards_open = 1.0 if output.open > output.closed else -1.0
        if output.kind == GripperKind.ABSOLUTE:
            return 1.0 if (number - threshold) * towards_open > 0.0 else 0.0
        if output.kind == GripperKind.RELATIVE:
            step = number - (output.open + output.closed) / 2
        else:
            step = 0.0 if self._previous is None else number - self._previous
            if self._previous is None or (abs(step) > threshold and not self._held):
                self._previous = number
        if abs(step) <= threshold:
            return None
        return 1.0 if step * towards_open > 0.0 else 0.0

    def _decide(self, wanted: float | None) -> float:
        """Return the opening to command: the demanded one if enough actions agree and no change is being held."""
        if self._held:
            self._held -= 1
            return self._opening
        if wanted is None or wanted == self._opening:
            self._votes = 0
            return self._opening
        self._votes += 1
        if self._votes >= self._output.agree:
            self._opening, self._votes, self._held = wanted, 0, max(self._output.hold - 1, 0)
        return self._opening
