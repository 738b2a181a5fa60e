"""The network of behaviour cloning: small enough to train in minutes on two CPU cores.

Each camera's image passes convolutions whose channels the instruction scales and shifts (FiLM). It is then reduced to
a few learned points (spatial softmax): their image coordinates, and the features found there. A first head for each
camera predicts the gripper's pose at its next event. This auxiliary task makes the points follow the object that the
instruction names. A common head predicts it again from all cameras and the robot's state, and the last head, which
receives that prediction, outputs a chunk of actions.

A camera on the hand sees displacements in the tool's frame, a fixed camera in the base's. Horizontal displacements are
therefore predicted as the sum of a vector in the base's frame and a vector in the tool's, which is turned by the yaw.
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
from roboxim_policies.learning.data import TARGET_SIZE
from roboxim_policies.learning.features import STATE_SIZE
from roboxim_policies.learning.layers import Dense, Inputs, Prediction, TargetHead, convolve, he, turned

PATCH = 4
"""Side of the image patches that are the inputs of the first layer [px]."""
POINT_VALUES = 4
"""Number of learned values per point, in addition to its coordinates."""
CAMERA_HIDDEN = 128
"""Width of the hidden layer of each camera's head."""


def _patches(image: Array) -> Array:
    batch, height, width, channels = image.shape
    x = image.reshape(batch, height // PATCH, PATCH, width // PATCH, PATCH, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, height // PATCH, width // PATCH, PATCH * PATCH * channels)


class Encoder(eqx.Module):
    """Encoder of an image as points: shape (B, side, side, 3) to (B, (2 + `POINT_VALUES`) * keypoints).

    Notes: the first layer works on patches of 4x4 pixels laid out as channels, which takes half the CPU time of a
    strided convolution. The grid of the last layer is coarse, so the features of a point also shift it inside its cell.
    They are averaged before they are projected, which gives the same numbers as the opposite order in a tenth of the
    time.
    """

    kernels: list[Array]
    biases: list[Array]
    film: Dense | None
    points: Dense
    values: Array
    temperature: Array

    def __init__(self, config: BCConfig, *, rng: np.random.Generator) -> None:
        """Draw the weights."""
        first, c, k = 2 * config.channels // 3, config.channels, config.keypoints
        shapes = [(2, 2, 3 * PATCH**2, first), (3, 3, first, c), *([(3, 3, c, c)] * config.depth)]
        self.kernels = [he(rng, shape) for shape in shapes]
        self.biases = [jnp.zeros(shape[-1]) for shape in shapes]
        modulated = 1 + config.depth if config.film is None else config.film
        self.film = Dense(config.word_size, 2 * c * modulated, rng=rng, scale=0.1) if modulated else None
        self.points = Dense(c, k, rng=rng)
        self.values = he(rng, (k, c, 2 + POINT_VALUES), 0.3 * math.sqrt(k))
        self.temperature = jnp.ones(k)

    def __call__(self, image: Array, instruction: Array) -> Array:
        """Return each point's coordinates (-1..1) and further learned values.

        Args:
            image: Values -0.5..0.5, shape (B, side, side, 3).
            instruction: Embedding, shape (B, word_size).
        """
        x = jax.nn.relu(convolve(_patches(image), self.kernels[0], 1) + self.biases[0])
        films = self._films(instruction)
        for layer, (kernel, bias) in enumerate(zip(self.kernels[1:], self.biases[1:], strict=True)):
            y = convolve(x, kernel, 2 if layer == 0 else 1) + bias
            if layer < len(films):
                scale, shift = films[layer]
                y = y * (1 + scale) + shift
            y = jax.nn.relu(y)
            x = x + y if layer > 1 else y
        batch, height, width, _ = x.shape
        x = x.reshape(batch, height * width, -1)
        weight = jax.nn.softmax(self.points(x) * self.temperature, axis=1)
        rows, columns = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
        grid = jnp.stack([columns.ravel(), rows.ravel()], axis=-1)
        values = jnp.einsum("bkc,kcv->bkv", jnp.einsum("bnk,bnc->bkc", weight, x), self.values)
        inside = 2.0 / jnp.array([width, height]) * values[..., :2]
        places = jnp.einsum("bnk,nv->bkv", weight, grid) + inside
        return jnp.concatenate([places, values[..., 2:]], axis=-1).reshape(batch, -1)

    def _films(self, instruction: Array) -> list[tuple[Array, Array]]:
        """Return scale and shift of the channels of each modulated convolution, shape (B, 1, 1, channels) each."""
        if self.film is None:
            return []
        channels = self.kernels[1].shape[-1]
        parts = jnp.split(self.film(instruction)[:, None, None, :], self.film.bias.shape[0] // channels, axis=-1)
        return list(zip(parts[::2], parts[1::2], strict=True))


class Network(eqx.Module):
    """Network from images, proprioception and the instruction's words to a chunk of actions."""

    words: Array
    encoders: dict[str, Encoder]
    camera_heads: dict[str, TargetHead]
    trunk: Dense
    target_head: TargetHead
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
        points, common = (2 + POINT_VALUES) * config.keypoints, STATE_SIZE + 2 + config.word_size
        self.camera_heads = {name: TargetHead(points + common, CAMERA_HIDDEN, rng=rng) for name in sorted(cameras)}
        hidden = config.hidden
        self.trunk = Dense((points + TARGET_SIZE) * len(cameras) + common, hidden, rng=rng)
        self.target_head = TargetHead(hidden + TARGET_SIZE * len(cameras) + common, hidden, rng=rng)
        inputs = hidden + TARGET_SIZE + common
        self.action_trunk = [Dense(inputs, hidden, rng=rng), Dense(hidden, hidden, rng=rng)]
        self.action_head = Dense(hidden, config.chunk * 10, rng=rng, scale=0.1)
        self.chunk = config.chunk

    def __call__(self, inputs: Inputs) -> Prediction:
        """Predict a chunk of actions and the gripper's pose at its next event."""
        present = (inputs.words > 0)[..., None]
        instruction = jnp.sum(self.words[inputs.words] * present, axis=1) / jnp.sqrt(jnp.maximum(present.sum(1), 1))
        common = [inputs.state, inputs.heading, instruction]
        points = [encoder(inputs.images[name], instruction) for name, encoder in sorted(self.encoders.items())]
        camera_targets = [
            self.camera_heads[name](jnp.concatenate([seen, *common], axis=-1), inputs.heading)
            for name, seen in zip(sorted(self.camera_heads), points, strict=True)
        ]
        x = jax.nn.relu(self.trunk(jnp.concatenate([*points, *camera_targets, *common], axis=-1)))
        target = self.target_head(jnp.concatenate([x, *camera_targets, *common], axis=-1), inputs.heading)
        x = jnp.concatenate([x, target, *common], axis=-1)
        for layer in self.action_trunk:
            x = jax.nn.relu(layer(x))
        action = self.action_head(x).reshape(-1, self.chunk, 10)
        horizontal = action[..., :2] + turned(action[..., 8:], inputs.heading[:, None])
        return Prediction(
            motion=jnp.concatenate([horizontal, action[..., 2:6]], axis=-1), closed=action[..., 6],
            opening=action[..., 7], target=target, camera_targets=camera_targets,
        )  # fmt: skip


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
