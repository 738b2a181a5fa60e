"""Gripper rules: they keep a command for several actions.

A learned policy's gripper values flicker near the middle, and each flicker can drop the object. A `GripperRule` says
when the gripper opens or closes, a `GripperSwitch` applies it to the executed actions of an episode, one after another.
"""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError


@dataclass(frozen=True, kw_only=True)
class GripperRule:
    """When the gripper opens and closes. All openings: 1 = open, 0 = closed."""

    binary: bool = False
    """Whether the gripper only opens fully or closes; if not, every opening is commanded and the other fields are
    unused."""
    band: float = 0.0
    """Width of the band around half open within which it keeps its command."""
    agree: int = 1
    """Number of consecutive actions that must demand the other command before it changes; 0 and 1: at once."""
    hold: int = 0
    """Number of actions for which a changed command stays, regardless of their demands; 0 and 1: only the one that
    changed it."""
    on_change: bool = False
    """Whether an action's opening counts only if it differs from the previous action's by more than half: a rise
    opens, a fall closes. Source: the sticky gripper of SimplerEnv's Google robot."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: On a value out of range, or one that needs ``binary``.
        """
        limits.require_range("gripper: band", self.band, 0.0, 1.0)
        limits.require_range("gripper: agree", self.agree, 0, 1_000)
        limits.require_range("gripper: hold", self.hold, 0, 10_000)
        if not self.binary and (self.band or self.agree > 1 or self.hold or self.on_change):
            raise InvalidRequestError("gripper: band, agree, hold and on_change need binary: true")


class GripperSwitch:
    """State of a rule in one episode."""

    def __init__(self, rule: GripperRule, command: float = 1.0) -> None:
        """Start an episode.

        Args:
            rule: The rule.
            command: Commanded opening at the start.
        """
        self._rule = rule
        self._command = command
        self._previous: float | None = None
        self._agreeing = 0
        self._held = 0

    def step(self, opening: float) -> float:
        """Return the opening to command for the next action.

        Args:
            opening: Opening that the action demands.
        """
        if not self._rule.binary:
            self._command = opening
            return opening
        wanted = self._wanted(opening)
        self._previous = opening
        if self._held:
            self._held -= 1
        elif wanted is None or wanted == self._command:
            self._agreeing = 0
        else:
            self._agreeing += 1
            if self._agreeing >= self._rule.agree:
                self._command, self._agreeing, self._held = wanted, 0, max(self._rule.hold - 1, 0)
        return self._command

    def _wanted(self, opening: float) -> float | None:
        """Return the command that an opening demands; None: it demands no change."""
        if self._rule.on_change:
            step = 0.0 if self._previous is None else opening - self._previous
            return None if abs(step) <= 0.5 else float(step > 0.0)
        distance = opening - 0.5
        if self._rule.band and abs(distance) <= self._rule.band / 2:
            return None
        return float(distance > 0.0)
