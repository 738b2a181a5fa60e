"""Path constraints: conditions on the tool that must hold during a whole motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Vec3


@dataclass(frozen=True, kw_only=True)
class Upright:
    """Path constraint: an axis of the tool stays within an angle of a direction during a whole motion."""

    tolerance_rad: float
    """Largest angle between the two [rad], in (0, pi]."""
    tool_axis: Vec3 = (0.0, 0.0, 1.0)
    """Axis in the TCP frame, of any length; z points out of the hand."""
    world_axis: Vec3 = (0.0, 0.0, -1.0)
    """Direction in the world, of any length; default: straight down."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidRequestError: On a tolerance out of range or an axis without a direction.
        """
        if not 0.0 < self.tolerance_rad <= np.pi:
            raise InvalidRequestError(f"the upright tolerance must be in (0, pi] rad, got {self.tolerance_rad}")
        for name, axis in (("tool_axis", self.tool_axis), ("world_axis", self.world_axis)):
            if not np.isfinite(axis).all() or float(np.linalg.norm(axis)) < 1e-6:
                raise InvalidRequestError(f"{name} must be a finite, non-zero vector, got {axis}")
