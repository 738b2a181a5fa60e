"""The gripper component of a policy's action: polarity, range, threshold, and when the gripper changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roboxim_core import limits
from roboxim_core.actions.gripper import GripperRule
from roboxim_core.errors import InvalidRequestError
from roboxim_core.rotation.representations import Floats


@dataclass(frozen=True, kw_only=True)
class GripperOutput:
    """Meaning of the gripper component. A relative gripper (close, open, 0: stay) is ``binary`` with a dead zone."""

    open: float = 1.0
    """The number of a fully open gripper."""
    closed: float = 0.0
    """The number of a closed gripper. Numbers beyond ``open`` and ``closed`` count as these."""
    threshold: float | None = None
    """The number of a half open gripper; none: the middle of ``open`` and ``closed``. Linear between the three."""
    binary: bool = False
    """Whether numbers on the open side of the threshold open the gripper fully, and the others close it."""
    dead_zone: float = 0.0
    """Largest distance from the threshold, in the policy's numbers, at which the gripper keeps its command."""
    agree: int = 1
    """Number of consecutive actions that must demand the other command before the gripper changes."""
    hold: int = 0
    """Number of actions for which a changed command stays."""
    on_change: bool = False
    """Whether only a jump of more than half the range between two consecutive actions opens or closes the gripper."""

    def __post_init__(self) -> None:
        """Check that the fields fit together.

        Raises:
            InvalidRequestError: Naming the field.
        """
        limits.require_finite("gripper: open, closed", (self.open, self.closed), 1e6)
        if self.open == self.closed:
            raise InvalidRequestError(f"gripper: open and closed must differ, both are {self.open:g}")
        low, high = sorted((self.open, self.closed))
        if not low < self.middle < high:
            raise InvalidRequestError(f"gripper: threshold must lie between {low:g} and {high:g}, got {self.middle:g}")
        limits.require_range("gripper: dead_zone", self.dead_zone, 0.0, high - low)
        self.rule  # noqa: B018 - refuses values out of range

    @property
    def middle(self) -> float:
        """The number of a half open gripper."""
        return (self.open + self.closed) / 2 if self.threshold is None else self.threshold

    @property
    def rule(self) -> GripperRule:
        """When the gripper opens and closes, in openings."""
        upper, lower = (self._openings(np.array([self.middle + side * self.dead_zone]))[0] for side in (1.0, -1.0))
        return GripperRule(
            binary=self.binary, band=abs(float(upper - lower)), agree=self.agree, hold=self.hold,
            on_change=self.on_change,
        )  # fmt: skip

    def decode(self, numbers: Floats) -> Floats:
        """Return the openings that numbers demand, 1 = open, 0 = closed; `rule` is not applied."""
        return self._openings(numbers)

    def encode(self, openings: Floats) -> Floats:
        """Return the numbers of openings; the inverse of `decode`."""
        return np.interp(openings, [0.0, 0.5, 1.0], [self.closed, self.middle, self.open])

    def _openings(self, numbers: Floats) -> Floats:
        marks, openings = [self.closed, self.middle, self.open], [0.0, 0.5, 1.0]
        if self.open < self.closed:
            marks, openings = marks[::-1], openings[::-1]
        return np.interp(numbers, marks, openings)
