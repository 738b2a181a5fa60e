"""The half of a network that rt1s and act share: from features, state and words to tokens.

As in ``bc``, each camera's tokens alone predict where the gripper next opens or closes, an auxiliary task that makes
them look at the named object.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.encoders.efficientnet import CHANNELS
from roboxim_policies.encoders.feature_cache import STRIDES
from roboxim_policies.encoders.sentences import SIZE
from roboxim_policies.learning.data import TARGET_SIZE
from roboxim_policies.learning.encoded_config import EncodedConfig
from roboxim_policies.learning.features import STATE_SIZE
from roboxim_policies.learning.layers import Dense, Inputs, TargetHead
from roboxim_policies.learning.points import POINT_SIZE, PointEncoder

CAMERA_HIDDEN = 128
"""Width of the hidden layer of each camera's head."""


class Perceived(eqx.Module):
    """What a network has made of its inputs, for B observations."""

    tokens: Array
    """Tokens of all cameras, of the state and of the words, shape (B, n, token_size)."""
    points: Array
    """Pooled features of the cameras' tokens, shape (B, m)."""
    common: Array
    """State, heading and words as one vector, shape (B, k)."""
    camera_targets: list[Array]
    """The gripper's next pose, from each camera alone."""


class Perception(eqx.Module):
    """From the inputs to tokens."""

    words: Dense
    encoders: dict[str, PointEncoder]
    camera_heads: dict[str, TargetHead]
    tokens: Dense
    kinds: Array
    state: Dense

    def __init__(self, config: EncodedConfig, cameras: tuple[str, ...], *, rng: np.random.Generator) -> None:
        """Draw the weights.

        Args:
            config: Sizes.
            cameras: Names of the cameras.
            rng: Source of the weights.
        """
        size, words = config.token_size, config.word_size
        self.words = Dense(SIZE, words, rng=rng, scale=0.7)
        self.encoders = {
            name: PointEncoder(
                channels=config.channels, depth=config.depth, keypoints=config.keypoints, words=words,
                features={} if config.feature_dropout == 1 else {stride: CHANNELS[stride] for stride in STRIDES},
                rng=rng,
            )
            for name in sorted(cameras)
        }  # fmt: skip
        points, common = config.keypoints * POINT_SIZE, STATE_SIZE + 2 + words
        self.camera_heads = {name: TargetHead(points + common, CAMERA_HIDDEN, rng=rng) for name in sorted(cameras)}
        self.tokens = Dense(POINT_SIZE, size, rng=rng)
        self.kinds = jnp.asarray(rng.normal(size=(len(cameras) * config.keypoints + 1, size)), jnp.float32)
        self.state = Dense(common + TARGET_SIZE * len(cameras), size, rng=rng)

    @staticmethod
    def sizes(config: EncodedConfig, cameras: int) -> tuple[int, int]:
        """Return the lengths of `Perceived.points` and `Perceived.common`."""
        return cameras * config.keypoints * POINT_SIZE, STATE_SIZE + 2 + config.word_size

    def __call__(self, inputs: Inputs) -> Perceived:
        """Reduce the inputs to tokens."""
        words = jnp.tanh(self.words(inputs.words))
        common = jnp.concatenate([inputs.state, inputs.heading, words], axis=-1)
        perceived, targets = [], []
        for name, encoder in sorted(self.encoders.items()):
            seen = {str(stride): inputs.images[f"{name}/{stride}"] for stride in STRIDES}
            perceived.append(encoder(inputs.images[name], words, seen))
            points = perceived[-1].reshape(len(words), -1)
            targets.append(self.camera_heads[name](jnp.concatenate([points, common], axis=-1), inputs.heading))
        together = jnp.concatenate(perceived, axis=1)
        state = self.state(jnp.concatenate([common, *targets], axis=-1))
        tokens = jnp.concatenate([self.tokens(together), state[:, None]], axis=1) + self.kinds
        return Perceived(
            tokens=tokens, points=together.reshape(len(words), -1), common=common, camera_targets=targets
        )  # fmt: skip


def relu_layers(layers: list[Dense], x: Array) -> Array:
    """Apply layers with a rectifier after each."""
    for layer in layers:
        x = jax.nn.relu(layer(x))
    return x
