"""Configuration of behaviour cloning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from roboxim_core.errors import ConfigError
from roboxim_policies.learning.config import LearningConfig


@dataclass(frozen=True, kw_only=True)
class BCConfig(LearningConfig):
    """Network and training of a behaviour-cloning policy. Time is counted in steps, never in seconds."""

    FAMILY: ClassVar[str] = "bc"
    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = (
        *LearningConfig.LEFT_OUT_AT_DEFAULT, "decay_to", "film", "held_out", "patience",
    )  # fmt: skip
    """Later fields, see `roboxim_core.config.LEFT_OUT`: trainings without them are continued."""

    channels: int = 48
    """Channels of the convolutions; the first convolution has two thirds of this number."""
    depth: int = 1
    """Number of convolutions on the final grid; from the second on they are residual."""
    film: int | None = None
    """Number of convolutions, of those after the patches', whose channels the instruction scales and shifts (FiLM), the
    first ones, 0..1+``depth``; None: all. The layers behind the points receive the instruction in any case."""
    keypoints: int = 32
    """Number of points that the features of each camera are reduced to."""
    hidden: int = 256
    """Width of the fully connected layers."""
    word_size: int = 16
    """Length of a word's learned embedding."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: On a value out of range.
        """
        super().__post_init__()
        if self.film is not None and not 0 <= self.film <= 1 + self.depth:
            raise ConfigError(f"film must be 0..{1 + self.depth} (1 + depth), got {self.film}")
