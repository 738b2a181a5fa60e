"""The network of behaviour cloning: small enough to train in minutes on two CPU cores.

Each camera's image passes three convolutions whose channels the instruction scales and shifts (FiLM). It is then
reduced to the image coordinates of a few learned points (spatial softmax), which keep the positions of things and
little of their appearance. A first head predicts the gripper's pose at its next event. This auxiliary task makes the
points follow the object that the instruction names. A second head also receives that prediction and outputs a chunk of
actions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from roboxim_policies.bc.config import BCConfig
from roboxim_policies.bc.data import PROPRIO_SIZE, TARGET_SIZE

PATCH = 4
"""Side of the image patches that are the inputs of the first layer [px]."""
POINT_VALUES = 2
"""Number of learned values per point, in addition to its coordinates."""


def _he(rng: np.random.Generator, shape: tuple[int, ...], scale: float = 1.0) -> Array:
    """Draw initial weights. Uses NumPy, because compiling JAX's generator for every shape takes seconds."""
    deviation = scale * math.sqrt(2.0 / math.prod(shape[:-1]))
    return jnp.asarray(rng.normal(scale=deviation, size=shape), jnp.float32)


def _convolve(x: Array, kernel: Array, stride: int) -> Array:
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _patches(image: Array) -> Array:
    batch, height, width, channels = image.shape
    x = image.reshape(batch, height // PATCH, PATCH, width // PATCH, PATCH, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, height // PATCH, width // PATCH, PATCH * PATCH * channels)


class Dense(eqx.Module):
    """Affine layer over the last axis."""

    weight: Array
    bias: Array

    def __init__(self, inputs: int, outputs: int, *, rng: np.random.Generator, scale: float = 1.0) -> None:
        """Draw the weights."""
        self.weight = _he(rng, (inputs, outputs), scale)
        self.bias = jnp.zeros(outputs)

    def __call__(self, x: Array) -> Array:
        """Apply to shape (..., inputs)."""
        return x @ self.weight + self.bias


class Encoder(eqx.Module):
    """Encoder of an image as points: shape (B, side, side, 3) to (B, (2 + `POINT_VALUES`) * keypoints).

    Note: the first layer works on patches of 4x4 pixels laid out as channels, which takes half the CPU time of a
    strided convolution. The grid of the last layer is coarse, so each cell also predicts the position of the point
    inside it.
    """

    kernels: list[Array]
    biases: list[Array]
    film: Dense
    points: Dense
    values: Dense
    temperature: Array

    def __init__(self, config: BCConfig, *, rng: np.random.Generator) -> None:
        """Draw the weights."""
        first, c, k = 2 * config.channels // 3, config.channels, config.keypoints
        shapes = [(2, 2, 3 * PATCH**2, first), (3, 3, first, c), (3, 3, c, c)]
        self.kernels = [_he(rng, shape) for shape in shapes]
        self.biases = [jnp.zeros(shape[-1]) for shape in shapes]
        self.film = Dense(config.word_size, 4 * c, rng=rng, scale=0.1)
        self.points = Dense(c, k, rng=rng)
        self.values = Dense(c, k * (2 + POINT_VALUES), rng=rng, scale=0.3)
        self.temperature = jnp.ones(k)

    def __call__(self, image: Array, instruction: Array) -> Array:
        """Return each point's coordinates (-1..1) and further learned values.

        Args:
            image: Values -0.5..0.5, shape (B, side, side, 3).
            instruction: Embedding, shape (B, word_size).
        """
        scales, shifts = jnp.split(self.film(instruction)[:, None, None, :], 2, axis=-1)
        x = jax.nn.relu(_convolve(_patches(image), self.kernels[0], 1) + self.biases[0])
        for kernel, bias, scale, shift, stride in zip(
            self.kernels[1:], self.biases[1:], jnp.split(scales, 2, -1), jnp.split(shifts, 2, -1), (2, 1), strict=True
        ):
            x = jax.nn.relu((_convolve(x, kernel, stride) + bias) * (1 + scale) + shift)
        batch, height, width, _ = x.shape
        x = x.reshape(batch, height * width, -1)
        weight = jax.nn.softmax(self.points(x) * self.temperature, axis=1)
        values = self.values(x).reshape(*weight.shape, 2 + POINT_VALUES)
        rows, columns = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
        grid = jnp.stack([columns.ravel(), rows.ravel()], axis=-1)[:, None, :]
        inside = 2.0 / jnp.array([width, height]) * jnp.tanh(values[..., :2])
        values = jnp.concatenate([jnp.broadcast_to(grid, inside.shape) + inside, values[..., 2:]], axis=-1)
        return jnp.einsum("bnk,bnkv->bkv", weight, values).reshape(batch, -1)


class Prediction(eqx.Module):
    """Output of the network, normalised by `checkpoint.Statistics`."""

    motion: Array
    """Translations and rotations, shape (B, chunk, 6)."""
    gripper: Array
    """Logit of "open", shape (B, chunk)."""
    target: Array
    """Relative pose of the gripper at its next event, shape (B, `TARGET_SIZE`)."""


class Network(eqx.Module):
    """Network from images, proprioception and the instruction's words to a chunk of actions."""

    words: Array
    encoders: dict[str, Encoder]
    trunk: list[Dense]
    target_head: Dense
    action_trunk: list[Dense]
    action_head: Dense
    chunk: int = eqx.field(static=True)

    def __init__(
        self, config: BCConfig, cameras: tuple[str, ...], vocabulary: int, *, rng: np.random.Generator
    ) -> None:
        """Draw the weights.

        Args:
            config: Sizes.
            cameras: Names of the cameras.
            vocabulary: Number of words.
            rng: Source of the initial weights.
        """
        self.words = jnp.asarray(rng.normal(size=(vocabulary + 1, config.word_size)), jnp.float32)
        self.encoders = {name: Encoder(config, rng=rng) for name in sorted(cameras)}
        features = (2 + POINT_VALUES) * config.keypoints * len(cameras) + PROPRIO_SIZE + config.word_size
        hidden = config.hidden
        self.trunk = [Dense(features, hidden, rng=rng), Dense(hidden, hidden, rng=rng)]
        self.target_head = Dense(hidden, TARGET_SIZE, rng=rng, scale=0.1)
        inputs = hidden + TARGET_SIZE + PROPRIO_SIZE
        self.action_trunk = [Dense(inputs, hidden, rng=rng)]
        self.action_head = Dense(hidden, config.chunk * 7, rng=rng, scale=0.1)
        self.chunk = config.chunk

    def __call__(self, images: dict[str, Array], proprio: Array, words: Array) -> Prediction:
        """Predict a chunk of actions and the gripper's pose at its next event.

        Args:
            images: Camera name to values -0.5..0.5, shape (B, side, side, 3).
            proprio: Normalised, shape (B, `PROPRIO_SIZE`).
            words: Word indices padded with 0, shape (B, L).
        """
        present = (words > 0)[..., None]
        instruction = jnp.sum(self.words[words] * present, axis=1) / jnp.sqrt(jnp.maximum(present.sum(1), 1))
        points = [encoder(images[name], instruction) for name, encoder in sorted(self.encoders.items())]
        x = jnp.concatenate([*points, proprio, instruction], axis=-1)
        for layer in self.trunk:
            x = jax.nn.relu(layer(x))
        target = self.target_head(x)
        x = jnp.concatenate([x, target, proprio], axis=-1)
        for layer in self.action_trunk:
            x = jax.nn.relu(layer(x))
        actions = self.action_head(x).reshape(-1, self.chunk, 7)
        return Prediction(motion=actions[..., :6], gripper=actions[..., 6], target=target)


def make_network(
    config: BCConfig, cameras: tuple[str, ...], vocabulary: int, seed: int
) -> tuple[Array, Callable[[Array], Network]]:
    """Draw a network's weights.

    Args:
        config: Sizes.
        cameras: Names of the cameras.
        vocabulary: Number of words.
        seed: Seed of the weights.

    Returns:
        The weights as one vector, so that an optimiser step is a single operation, and a function that makes a network
        from such a vector.
    """
    network = Network(config, cameras, vocabulary, rng=np.random.default_rng(seed))
    return ravel_pytree(network)
