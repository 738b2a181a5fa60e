"""The network of behaviour cloning: small enough to train in minutes on two CPU cores.

Each camera's image passes convolutions whose channels the instruction scales and shifts (FiLM). It is then reduced to
a few learned points (spatial softmax): their image coordinates, and the features found there. A first head for each
camera predicts the gripper's pose at its next event. This auxiliary task makes the points follow the object that the
instruction names. A common head predicts it again from all cameras and the robot's state, and the last head, which
receives that prediction, outputs a chunk of actions.

A camera on the hand sees displacements in the tool's frame, a fixed camera in the base's. Horizontal displacements are
therefore predicted as the sum of a vector in the frame of the actions and a vector in the other one, which is turned by
the yaw (`turned`).
"""

from __future__ import annotations

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
from roboxim_policies.learning.layers import Dense, Inputs, Prediction, TargetHead, predicted
from roboxim_policies.learning.points import POINT_SIZE, PointEncoder

CAMERA_HIDDEN = 128
"""Width of the hidden layer of each camera's head."""


class Network(eqx.Module):
    """Network from images, proprioception and the instruction's words to a chunk of actions."""

    words: Array
    encoders: dict[str, PointEncoder]
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
        self.encoders = {
            name: PointEncoder(
                channels=config.channels, depth=config.depth, keypoints=config.keypoints, words=config.word_size,
                film=config.film, rng=rng,
            )
            for name in sorted(cameras)
        }  # fmt: skip
        points, common = POINT_SIZE * config.keypoints, STATE_SIZE + 2 + config.word_size
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
        points = [
            encoder(inputs.images[name], instruction).reshape(len(instruction), -1)
            for name, encoder in sorted(self.encoders.items())
        ]
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
        return predicted(action, inputs, target, camera_targets)


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
