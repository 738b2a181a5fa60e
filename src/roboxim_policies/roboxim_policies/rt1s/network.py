"""The network of rt1s.

The tokens of each observation pass a transformer in which an observation attends to itself and to earlier ones. Heads
like those of ``bc`` decode the output of a query token into a chunk of actions.

Differences from RT-1: the encoder is frozen and smaller, so that the features of a picture are computed once; FiLM
modulates a layer after it; the state of the robot is an input; actions are continuous and come in chunks.

Source: Brohan et al., "RT-1: Robotics Transformer for Real-World Control at Scale", 2022.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from roboxim_policies.learning.attention import Attention, normalised
from roboxim_policies.learning.data import TARGET_SIZE
from roboxim_policies.learning.encoded_network import Perception, relu_layers
from roboxim_policies.learning.layers import Dense, Inputs, Prediction, TargetHead, predicted
from roboxim_policies.rt1s.config import RT1SConfig


class Network(eqx.Module):
    """Network from windows of observations to a chunk of actions for each of them."""

    perception: Perception
    ages: Array
    asking: Array
    layers: list[Attention]
    trunk: Dense
    target_head: TargetHead
    action_trunk: list[Dense]
    action_head: Dense
    chunk: int = eqx.field(static=True)
    frames: int = eqx.field(static=True)

    def __init__(self, config: RT1SConfig, cameras: tuple[str, ...], *, rng: np.random.Generator) -> None:
        """Draw the weights.

        Args:
            config: Sizes.
            cameras: Names of the cameras.
            rng: Source of the weights.
        """
        self.perception = Perception(config, cameras, rng=rng)
        points, common = Perception.sizes(config, len(cameras))
        size, hidden, targets = config.token_size, config.hidden, TARGET_SIZE * len(cameras)
        self.ages = jnp.asarray(0.3 * rng.normal(size=(config.history, 1, size)), jnp.float32)
        self.asking = jnp.asarray(rng.normal(size=size), jnp.float32)
        self.layers = [Attention(size, config.heads, rng=rng) for _ in range(config.layers)]
        self.trunk = Dense(size + points + targets + common, hidden, rng=rng)
        self.target_head = TargetHead(hidden + targets + common, hidden, rng=rng)
        self.action_trunk = [Dense(hidden + TARGET_SIZE + common, hidden, rng=rng), Dense(hidden, hidden, rng=rng)]
        self.action_head = Dense(hidden, config.chunk * 10, rng=rng, scale=0.1)
        self.chunk, self.frames = config.chunk, config.history

    def __call__(self, inputs: Inputs) -> Prediction:
        """Predict a chunk of actions and the gripper's pose at its next event, for every observation."""
        seen = self.perception(inputs)
        asking = jnp.broadcast_to(self.asking, (len(seen.tokens), 1, len(self.asking)))
        read = self._through_time(jnp.concatenate([seen.tokens, asking], axis=1), inputs.present)
        aims, common = jnp.concatenate(seen.camera_targets, axis=-1), seen.common
        x = relu_layers([self.trunk], jnp.concatenate([read, seen.points, aims, common], axis=-1))
        target = self.target_head(jnp.concatenate([x, aims, common], axis=-1), inputs.heading)
        x = relu_layers(self.action_trunk, jnp.concatenate([x, target, common], axis=-1))
        action = self.action_head(x).reshape(-1, self.chunk, 10)
        return predicted(action, inputs, target, seen.camera_targets)

    def _through_time(self, tokens: Array, present: Array | None) -> Array:
        """Return each observation's query token after it has attended to its window's past."""
        each, size, frames = tokens.shape[1], tokens.shape[2], self.frames
        x = (tokens.reshape(-1, frames, each, size) + self.ages).reshape(-1, frames * each, size)
        frame = jnp.repeat(jnp.arange(frames), each)
        allowed = frame[:, None] >= frame[None, :]
        if present is not None:
            there = jnp.repeat(present.reshape(-1, frames), each, axis=1)[:, None, :]
            allowed = (allowed & there) | (frame[:, None] == frame[None, :])
        for layer in self.layers:
            x = layer(x, x, allowed)
        return normalised(x.reshape(-1, each, size)[:, -1])


def make_network(
    config: RT1SConfig, cameras: tuple[str, ...], vocabulary: int, seed: int
) -> tuple[Array, Callable[[Array], Network]]:
    """Draw a network's weights; see `roboxim_policies.learning.families.make_network`."""
    return ravel_pytree(Network(config, cameras, rng=np.random.default_rng(seed)))
