"""Tolerances of a `FollowJointTrajectory` goal: how far the arm may deviate from the trajectory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.errors import InvalidRequestError

GOAL_TOLERANCE_RAD = 0.01
"""Default goal tolerance of a joint's position, if the action's goal sets none."""
NO_LIMIT = math.inf


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Of one joint."""

    position: float = NO_LIMIT
    """Maximum position error [rad]."""
    velocity: float = NO_LIMIT
    """Maximum velocity error [rad/s]."""


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
        name: The joint's name, for error messages.
        position: Position tolerance [rad].
        velocity: Velocity tolerance [rad/s].
        acceleration: Acceleration tolerance, 0 or -1, because accelerations are not measured.
        default: Tolerance that 0 stands for.

    Raises:
        InvalidRequestError: On another negative number, a number that is not finite, or an acceleration tolerance.
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
    """Return a sentence about the first joint that violates its tolerance; empty: none does.

    Args:
        tolerances: Tolerances by joint name, in the model's order.
        desired: State of the arm according to the trajectory.
        actual: Measured state of the arm.
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
