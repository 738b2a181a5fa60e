"""Configuration of the family rt1s."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from roboxim_policies.learning.encoded_config import EncodedConfig


@dataclass(frozen=True, kw_only=True)
class RT1SConfig(EncodedConfig):
    """Network and training of ``rt1s``. Time is counted in steps, never in seconds."""

    FAMILY: ClassVar[str] = "rt1s"

    history: int = 2
    """Observations that the policy acts on, ``execute`` ticks apart, the present one included. A training step has
    ``batch`` / ``history`` windows of so many observations, each of which is trained on."""

    @property
    def frames(self) -> int:
        """Observations that a prediction is made from."""
        return self.history
