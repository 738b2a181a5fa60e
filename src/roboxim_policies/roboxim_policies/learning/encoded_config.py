"""Configuration of policies on pre-trained encoders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.wordings import require_set
from roboxim_policies.learning.config import LearningConfig


@dataclass(frozen=True, kw_only=True)
class EncodedConfig(LearningConfig):
    """Training of a policy on EfficientNet-Lite0 (ImageNet) and the Universal Sentence Encoder."""

    ENCODER: ClassVar[bool] = True
    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = (*LearningConfig.LEFT_OUT_AT_DEFAULT, "wordings")
    """Later fields, see `roboxim_core.config.LEFT_OUT`: trainings without them are continued."""

    image_sizes: dict[str, int] | None = None
    """Camera name to the side [px] of the encoder's square input, a multiple of 16. Cameras left out are not used.
    None: all cameras of the dataset, with 128."""
    channels: int = 48
    """Channels of the trained convolutions; the first convolution has two thirds of this number."""
    depth: int = 1
    """Number of trained convolutions on the final grid; from the second on they are residual."""
    keypoints: int = 32
    """Number of points, each a token, that each camera's picture is reduced to."""
    token_size: int = 64
    """Length of a token in the transformer, a multiple of ``heads``."""
    heads: int = 4
    """Heads of each attention."""
    layers: int = 1
    """Layers of the transformer."""
    hidden: int = 256
    """Width of the fully connected layers."""
    word_size: int = 32
    """Length of the vector that the instruction's embedding is reduced to."""
    sentence_noise: float = 0.1
    """Standard deviation of noise on the instruction's embedding in training, relative to its numbers, so that a
    wording that is near to a known one is understood as that one."""

    feature_dropout: float = 0.5
    """Probability that a training sample lacks a camera's features, 0..1, so that the trained convolutions learn to see
    without them. At 0 a network remembers the features of its few hundred scenes; 1: features are never used."""
    wordings: str = ""
    """Set of ``config/wordings`` in whose words each instruction is given in training, too, e.g. ``trained``: one is
    drawn for each sample. Empty: only the instruction itself."""

    def side_of(self, camera: str) -> int:
        """Return the default side of the encoder's input for a camera [px]."""
        return 128

    def fine_side(self, camera: str, side: int) -> int:
        """Return the side of the picture that trained convolutions see, when the encoder's has ``side`` pixels."""
        return min(side, super().side_of(camera))

    @property
    def word_noise(self) -> float:
        """Standard deviation of noise on an instruction's embedding in training."""
        return self.sentence_noise

    @property
    def sentences(self) -> bool:
        """Whether a pre-trained encoder reads the instructions: always."""
        return True

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: On a value out of range.
        """
        super().__post_init__()
        if self.token_size % self.heads:
            raise ConfigError(f"token_size must be a multiple of heads ({self.heads}), got {self.token_size}")
        if any(side % 16 for side in (self.image_sizes or {}).values()):
            raise ConfigError(f"image_sizes must be multiples of 16, got {self.image_sizes}")
        if self.wordings:
            require_set(self.wordings)
        if self.word_dropout:
            raise ConfigError("word_dropout must be 0: this family reads whole sentences; see sentence_noise, wordings")
        if self.shift_px:
            raise ConfigError("shift_px must be 0: features of the pictures are computed once, before the training")
