"""Layers that the networks of all families use, and the inputs and outputs that all networks share."""

from __future__ import annotations

import math
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.learning.data import TARGET_SIZE


def he(rng: np.random.Generator, shape: tuple[int, ...], scale: float = 1.0) -> Array:
    """Draw initial weights. Uses NumPy, because compiling JAX's generator for every shape takes seconds."""
    deviation = scale * math.sqrt(2.0 / math.prod(shape[:-1]))
    return jnp.asarray(rng.normal(scale=deviation, size=shape), jnp.float32)


def convolve(x: Array, kernel: Array, stride: int) -> Array:
    """Convolve, with zeros around: (B, h, w, inputs) and (side, side, inputs, outputs) to (B, h / stride, ..)."""
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


class Dense(eqx.Module):
    """Affine layer over the last axis."""

    weight: Array
    bias: Array

    def __init__(self, inputs: int, outputs: int, *, rng: np.random.Generator, scale: float = 1.0) -> None:
        """Draw the weights."""
        self.weight = he(rng, (inputs, outputs), scale)
        self.bias = jnp.zeros(outputs)

    def __call__(self, x: Array) -> Array:
        """Apply to shape (..., inputs)."""
        return x @ self.weight + self.bias


class TargetHead(eqx.Module):
    """Head for the gripper's pose at its next event, and the time until it."""

    hidden: Dense
    output: Dense

    def __init__(self, inputs: int, hidden: int, *, rng: np.random.Generator) -> None:
        """Draw the weights."""
        self.hidden = Dense(inputs, hidden, rng=rng)
        self.output = Dense(hidden + inputs, TARGET_SIZE + 2, rng=rng, scale=0.1)

    def __call__(self, x: Array, heading: Array) -> Array:
        """Return the prediction, shape (B, `TARGET_SIZE`), from features and the cosine and sine of the tool's yaw."""
        output = self.output(jnp.concatenate([jax.nn.relu(self.hidden(x)), x], axis=-1))
        return jnp.concatenate([output[:, :2] + turned(output[:, -2:], heading), output[:, 2:-2]], axis=-1)


def turned(vector: Array, heading: Array) -> Array:
    """Turn vectors of the tool's frame to the base's, shape (..., 2), by cosine and sine of the yaw, shape (..., 2).

    Of a tool that points down, y is mirrored, and what is mirrored and turned twice is as it was: vectors of the base's
    frame thus turn to the tool's in the same way, for actions in that frame.
    """
    cos, sin = heading[..., 0], heading[..., 1]
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


class Inputs(eqx.Module):
    """Input of the network, for B samples: with a history, B / frames windows of consecutive observations."""

    images: dict[str, Array]
    """Camera name to values -0.5..0.5, shape (B, side, side, 3); or ``CAMERA/STRIDE`` to features of an encoder."""
    state: Array
    """Proprioception and memory of the grasp, normalised, shape (B, `STATE_SIZE`)."""
    heading: Array
    """Cosine and sine of the tool's yaw, shape (B, 2)."""
    words: Array
    """Word indices padded with 0, shape (B, L), or the sentence's embedding, shape (B, 512), see `LearningConfig`."""
    present: Array | None = None
    """Whether each observation belongs to its history, shape (B,); None: there is no history."""


class Prediction(eqx.Module):
    """Output of the network, normalised by `checkpoint.Statistics`."""

    motion: Array
    """Translations and rotations, shape (B, chunk, 6)."""
    closed: Array
    """Logit of "closed", shape (B, chunk)."""
    opening: Array
    """Opening of a gripper that is not closed, shape (B, chunk)."""
    target: Array
    """Relative pose of the gripper at its next event, shape (B, `TARGET_SIZE`)."""
    camera_targets: list[Array]
    """The same from each camera alone."""


def predicted(action: Array, inputs: Inputs, target: Array, camera_targets: list[Array]) -> Prediction:
    """Return the output of a network.

    Args:
        action: Shape (B, chunk, 10): motion, closed, opening, and a horizontal motion in the tool's frame.
        inputs: Its input.
        target: See `Prediction`.
        camera_targets: See `Prediction`.
    """
    horizontal = action[..., :2] + turned(action[..., 8:], inputs.heading[:, None])
    return Prediction(
        motion=jnp.concatenate([horizontal, action[..., 2:6]], axis=-1), closed=action[..., 6],
        opening=action[..., 7], target=target, camera_targets=camera_targets,
    )  # fmt: skip


class Network(Protocol):
    """A network of any family."""

    def __call__(self, inputs: Inputs) -> Prediction:
        """Predict a chunk of actions, and the gripper's pose at its next event."""
        ...
