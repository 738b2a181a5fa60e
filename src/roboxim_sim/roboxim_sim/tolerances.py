"""How far an arm may stray from a trajectory: the tolerances of a `FollowJointTrajectory` goal as plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.errors import InvalidRequestError

GOAL_TOLERANCE_RAD = 0.01
"""Largest distance of a joint from its goal, if the goal of the action does not say."""
NO_LIMIT = math.inf


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Of one joint."""

    position: float = NO_LIMIT
    """Largest difference of the position [rad]."""
    velocity: float = NO_LIMIT
    """Largest difference of the velocity [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class JointStates:
    """Positions and velocities of the arm's joints in the model's order."""

    positions: Sequence[float]
    """[rad]."""
    velocities: Sequence[float]
    """[rad/s]."""


def tolerance(name: str, position: float, velocity: float, acceleration: float, default: Tolerance) -> Tolerance:
    """Return a joint's tolerance as `control_msgs/JointTolerance` gives it: 0 is the default, -1 is no limit.

    Args:
        name: The joint, for messages.
        position: Of the position [rad].
        velocity: Of the velocity [rad/s].
        acceleration: Of the acceleration, which is not measured: 0 or -1.
        default: What 0 means.

    Raises:
        InvalidRequestError: On another negative number, one that is not finite, or a limit of the acceleration.
    """
    for what, value in (("position", position), ("velocity", velocity), ("acceleration", acceleration)):
        if not math.isfinite(value) or (value < 0.0 and value != -1.0):
            raise InvalidRequestError(f"the {what} tolerance of '{name}' must be >= 0, or -1 for none, got {value}")
    if acceleration > 0.0:
        raise InvalidRequestError(f"the acceleration of '{name}' is not measured; its tolerance must be 0 or -1")
    values = {-1.0: NO_LIMIT}
    return Tolerance(
        position=default.position if position == 0.0 else values.get(position, position),
        velocity=default.velocity if velocity == 0.0 else values.get(velocity, velocity),
    )


def violation(tolerances: Mapping[str, Tolerance], desired: JointStates, actual: JointStates) -> str:
    """Return which joint strays by more than its tolerance, as a sentence; empty: none does.

    Args:
        tolerances: Joint to tolerance, in the model's order.
        desired: Where the trajectory has the arm.
        actual: Where it is.
    """
    for k, (name, allowed) in enumerate(tolerances.items()):
        for what, unit, limit, wanted, is_now in (
            ("position", "rad", allowed.position, desired.positions[k], actual.positions[k]),
            ("velocity", "rad/s", allowed.velocity, desired.velocities[k], actual.velocities[k]),
        ):
            if abs(wanted - is_now) > limit:
                return (
                    f"the {what} of '{name}' is {is_now:.4f} {unit} instead of {wanted:.4f}, {limit:g} {unit} allowed"
                )
    return ""
