"""The network of act.

The tokens of the present observation pass a transformer. Then one query for each action of the chunk attends to the
tokens, and its output is that action. There is no latent variable (no CVAE), because the expert's demonstrations have
one style.

Source: Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", 2023.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from roboxim_policies.act.config import ACTConfig
from roboxim_policies.learning.attention import Attention, normalised
from roboxim_policies.learning.data import TARGET_SIZE
from roboxim_policies.learning.encoded_network import Perception, relu_layers
from roboxim_policies.learning.layers import Dense, Inputs, Prediction, TargetHead, predicted


class Network(eqx.Module):
    """Network from an observation to a chunk of actions."""

    perception: Perception
    layers: list[Attention]
    trunk: Dense
    target_head: TargetHead
    aim: Dense
    queries: Array
    decoder: Attention
    action_trunk: Dense
    action_head: Dense

    def __init__(self, config: ACTConfig, cameras: tuple[str, ...], *, rng: np.random.Generator) -> None:
        """Draw the weights.

        Args:
            config: Sizes.
            cameras: Names of the cameras.
            rng: Source of the weights.
        """
        self.perception = Perception(config, cameras, rng=rng)
        points, common = Perception.sizes(config, len(cameras))
        size, hidden, targets = config.token_size, config.hidden, TARGET_SIZE * len(cameras)
        self.layers = [Attention(size, config.heads, rng=rng) for _ in range(config.layers)]
        self.trunk = Dense(points + targets + common, hidden, rng=rng)
        self.target_head = TargetHead(hidden + targets + common, hidden, rng=rng)
        self.aim = Dense(hidden + TARGET_SIZE + common, size, rng=rng)
        self.queries = jnp.asarray(rng.normal(size=(config.chunk, size)), jnp.float32)
        self.decoder = Attention(size, config.heads, rng=rng)
        self.action_trunk = Dense(size + hidden + TARGET_SIZE + common, hidden, rng=rng)
        self.action_head = Dense(hidden, 10, rng=rng, scale=0.1)

    def __call__(self, inputs: Inputs) -> Prediction:
        """Predict a chunk of actions and the gripper's pose at its next event."""
        seen = self.perception(inputs)
        aims, common = jnp.concatenate(seen.camera_targets, axis=-1), seen.common
        x = relu_layers([self.trunk], jnp.concatenate([seen.points, aims, common], axis=-1))
        target = self.target_head(jnp.concatenate([x, aims, common], axis=-1), inputs.heading)
        known = jnp.concatenate([x, target, common], axis=-1)
        tokens = jnp.concatenate([seen.tokens, self.aim(known)[:, None]], axis=1)
        for layer in self.layers:
            tokens = layer(tokens, tokens)
        queries = jnp.broadcast_to(self.queries, (len(tokens), *self.queries.shape))
        answers = normalised(self.decoder(queries, tokens))
        repeated = jnp.broadcast_to(known[:, None], (*answers.shape[:2], known.shape[-1]))
        action = self.action_head(relu_layers([self.action_trunk], jnp.concatenate([answers, repeated], axis=-1)))
        return predicted(action, inputs, target, seen.camera_targets)


def make_network(
    config: ACTConfig, cameras: tuple[str, ...], vocabulary: int, seed: int
) -> tuple[Array, Callable[[Array], Network]]:
    """Draw a network's weights; see `roboxim_policies.learning.families.make_network`."""
    return ravel_pytree(Network(config, cameras, rng=np.random.default_rng(seed)))
