"""The response of the controller that a policy was trained with: how far one tick moves the arm, and how it lags.

A soft controller does not reach its goal within a tick. Policies that were trained with it have learned its response.
RoboXim's controller reaches every goal, so a convention states the response, and the episode loop reproduces it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roboxim_core.actions.lag import COMPONENTS, require_lag
from roboxim_core.config import from_plain, load_yaml, named_config
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.rotation.representations import Floats


@dataclass(frozen=True, kw_only=True)
class ControllerResponse:
    """First-order response of a controller of end-effector deltas, for each of x, y, z and the rotations about them."""

    description: str = ""
    """The controller, and how its response was identified."""
    sources: tuple[str, ...] = ()
    """Where the numbers come from."""
    name: str = ""
    """Name in ``config/responses``, or the path of a YAML file; empty: ``gain`` and ``lag`` are given."""
    gain: tuple[float, ...] = ()
    """Share of the commanded delta by which the arm moves in a tick of steady motion, 6 numbers."""
    lag: tuple[float, ...] = ()
    """Share of a tick's motion that continues in the next tick, 6 numbers, see `roboxim_core.actions.lag`. The first
    tick of a motion moves the arm by gain (1 - lag) of the delta."""
    error_mm: float = 0.0
    """Root mean square error of a tick's translation against the genuine controller [mm]; 0: not stated."""
    error_mrad: float = 0.0
    """Root mean square error of a tick's rotation against the genuine controller [mrad]; 0: not stated."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidRequestError: Unless either a name or two times six numbers in range are given.
        """
        for name in ("gain", "lag", "sources"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.name and (self.gain or self.lag):
            raise InvalidRequestError(f"response: give the name '{self.name}', or gain and lag, not both")
        if self.name:
            return
        if len(self.gain) != COMPONENTS or len(self.lag) != COMPONENTS:
            raise InvalidRequestError(
                f"response needs a name, or gain and lag of {COMPONENTS} numbers each (x, y, z, and rotations about "
                f"them), got {len(self.gain)} and {len(self.lag)}"
            )
        if not all(0.0 < number <= 2.0 for number in self.gain):
            raise InvalidRequestError(f"response: gain must be above 0 and at most 2, got {list(self.gain)}")
        require_lag(self.lag)

    def resolved(self) -> ControllerResponse:
        """Return the response with its file's numbers.

        Raises:
            ConfigError: When the file is missing or invalid.
        """
        if self.gain:
            return self
        path = named_config("responses", self.name)
        found = from_plain(load_yaml(path) or {}, ControllerResponse, source=str(path))
        if not found.gain:
            raise ConfigError(f"{path} must hold gain and lag, not the name of another file")
        return found

    @property
    def gains(self) -> Floats:
        """The gain as an array of shape (6,)."""
        return np.array(self.gain)
