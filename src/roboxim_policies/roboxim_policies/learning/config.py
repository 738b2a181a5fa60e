"""Configuration that all trained policies have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from roboxim_core.errors import ConfigError

RANGES: dict[str, tuple[float, float]] = {
    "batch": (1, math.inf), "brightness": (0, 1), "channels": (1, math.inf), "checkpoint_every": (1, math.inf),
    "chunk": (1, math.inf), "color_mix": (0, 1), "decay_to": (0, 1), "depth": (1, math.inf), "execute": (1, math.inf),
    "feature_dropout": (0, 1), "gripper_weight": (0, math.inf), "heads": (1, math.inf), "held_out": (0, math.inf),
    "hidden": (1, math.inf), "history": (1, math.inf), "keypoints": (1, math.inf), "layers": (1, math.inf),
    "opening_noise": (0, math.inf), "overlay": (0, 1), "patches": (0, 32), "patience": (0, math.inf),
    "position_noise_m": (0, 1), "retry": (0, 1), "seed": (0, 2**32 - 1), "sentence_noise": (0, math.inf),
    "shift_px": (0, 64), "steps": (1, math.inf), "target_weight": (0, math.inf), "token_size": (1, math.inf),
    "warmup_steps": (0, math.inf), "weight_decay": (0, 1), "word_dropout": (0, 1), "word_size": (1, math.inf),
}  # fmt: skip
"""Smallest and largest value of each field of any family."""


@dataclass(frozen=True, kw_only=True)
class LearningConfig:
    """Training of a policy from demonstrations. Time is counted in steps, never in seconds."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("color_mix", "overlay", "patches", "word_dropout")
    """Later fields, see `roboxim_core.config.LEFT_OUT`: trainings without them are continued."""
    FAMILY: ClassVar[str] = ""
    """Name of the family."""
    ENCODER: ClassVar[bool] = False
    """Whether the network also sees features of the pictures by a pre-trained encoder."""

    steps: int = 2000
    """Optimiser steps."""
    batch: int = 64
    """Samples per step."""
    learning_rate: float = 1e-3
    """Peak learning rate; the schedule is a linear warm-up, then a cosine decay."""
    decay_to: float = 0.02
    """Learning rate at the end, relative to the peak, 0..1; 1: no decay."""
    warmup_steps: int = 100
    """Steps of warm-up."""
    weight_decay: float = 1e-4
    """Decoupled weight decay of AdamW."""
    ema_decay: float = 0.995
    """Decay of the weights' moving average; the policy uses the averaged weights."""
    seed: int = 0
    """Seed of initial weights, data order and augmentation."""
    image_sizes: dict[str, int] | None = None
    """Camera name to the side [px] of the network's square input, a multiple of 8. Cameras left out are not used. None:
    all cameras of the dataset, with 64 for names that contain ``wrist`` and 96 for others."""
    chunk: int = 8
    """Actions predicted per observation."""
    execute: int = 4
    """Actions executed per observation, 1..``chunk``."""
    target_weight: float = 1.0
    """Loss weight of the auxiliary task: predict the gripper's pose at its next opening or closing, which is taken from
    the demonstrations' proprioception."""
    gripper_weight: float = 0.2
    """Loss weight of the gripper's cross entropy."""
    position_noise_m: float = 0.003
    """Standard deviation of noise on the position input [m], so that the network relies on images rather than on the
    arm's position."""
    opening_noise: float = 0.3
    """Noise on the gripper opening as an input, relative to how far the gripper is closed. An object that is grasped
    askew is wider than any in the demonstrations, and the network must still recognise it as grasped."""
    retry: float = 0.06
    """Fraction of samples that are made into "the gripper closed on nothing": the action opens it and rises until the
    tool has gained `features.RETRY_M`. Only if no demonstration closes the gripper on nothing."""
    brightness: float = 0.15
    """Largest relative change of an image's brightness in training."""
    shift_px: int = 0
    """Largest random shift of an image in training [px of the network's input]."""
    color_mix: float = 0.0
    """Strength of a random linear map of an image's colours in training, 0..1: a new look of everything seen."""
    overlay: float = 0.0
    """Largest weight of a smooth field of random colours that is laid over an image in training, 0..1."""
    patches: int = 0
    """Largest number of ellipses of random colours pasted into an image in training: things that do not matter."""
    word_dropout: float = 0.0
    """Probability that a word of the instruction is left out of a training sample, 0..1, as a word that was
    not trained on is left out. For families that read words."""
    checkpoint_every: int = 250
    """Steps between checkpoints."""

    @property
    def word_noise(self) -> float:
        """Standard deviation of noise on an instruction's embedding in training, see `encoded_config`."""
        return 0.0

    held_out: int = 0
    """Demonstrations that are not trained on, drawn by the seed. The policy then has the averaged weights of the step
    with the lowest loss on them, of every ``checkpoint_every``-th and the last. 0: the last step's."""
    patience: int = 0
    """Checks on the held-out demonstrations without a lower loss after which the training ends; 0: never."""

    def side_of(self, camera: str) -> int:
        """Return the default side of the network's input for a camera [px]."""
        return 64 if "wrist" in camera else 96

    def fine_side(self, camera: str, side: int) -> int:
        """Return the side of the picture that trained convolutions see, when the input has ``side`` pixels."""
        return side

    @property
    def frames(self) -> int:
        """Number of observations that a prediction uses, the present one included."""
        return 1

    @property
    def sentences(self) -> bool:
        """Whether a pre-trained encoder reads the instructions, so that words not trained on mean something."""
        return False

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: On a value out of range.
        """
        for name, (least, most) in RANGES.items():
            value = getattr(self, name, least)
            if not least <= value <= most:
                allowed = f">= {least}" if math.isinf(most) else f"{least}..{most}"
                raise ConfigError(f"{name} must be {allowed}, got {value}")
        if self.execute > self.chunk:
            raise ConfigError(f"execute must be 1..chunk ({self.chunk}), got {self.execute}")
        if not 0 < self.learning_rate <= 1:
            raise ConfigError(f"learning_rate must be above 0 and at most 1, got {self.learning_rate}")
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(f"ema_decay must be 0..1 (exclusive), got {self.ema_decay}")
        if self.patience and not self.held_out:
            raise ConfigError(f"patience needs held_out: got {self.patience} and {self.held_out}")
        if self.image_sizes is not None and not self.image_sizes:
            raise ConfigError("image_sizes must name at least one camera; leave it out to use all of the dataset")
        for camera, side in (self.image_sizes or {}).items():
            if side % 8 or not 16 <= side <= 512:
                raise ConfigError(f"image_sizes: '{camera}' must be a multiple of 8 in 16..512 px, got {side}")
