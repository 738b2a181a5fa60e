"""Control and physics rates: the defaults, and which control rates the physics allows."""

from __future__ import annotations

import math

from roboxim_core.errors import InvalidRequestError

DEFAULT_RATE_HZ = 10.0
"""Default control rate [Hz]. Defined only here."""
PHYSICS_RATE_HZ = 240.0
"""Default physics rate, in steps per simulated second [Hz]."""
ANY_RATE = 0.0
"""Rate that a policy declares if it can act at any rate."""


def ticks(duration_s: float, rate_hz: float) -> int:
    """Return the number of ticks that cover a duration [s] at a control rate [Hz]."""
    return math.ceil(duration_s * rate_hz - 1e-9)


def require_control_rate(rate_hz: float, physics_rate_hz: float = PHYSICS_RATE_HZ) -> None:
    """Refuse a control rate that does not divide the physics rate.

    Args:
        rate_hz: Ticks per simulated second.
        physics_rate_hz: Physics steps per simulated second.

    Raises:
        InvalidRequestError: The message names valid rates.
    """
    if not rate_hz > 0 or (physics_rate_hz / rate_hz) % 1:
        raise InvalidRequestError(
            f"control_rate_hz must divide the physics rate of {physics_rate_hz:g} Hz, "
            f"got {rate_hz:g}; for example 5, 8, 10, 12, 15, 20, 24, 30"
        )
