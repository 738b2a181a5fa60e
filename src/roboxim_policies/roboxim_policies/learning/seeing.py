"""Layers on the features of a frozen encoder: what the instruction makes of them, and the points that it looks at.

Features of two strides are joined on the finer grid. The instruction scales and shifts channels (FiLM) before and after
a convolution. A token learner then reduces the grid to a few tokens: each has a place, found by a spatial softmax, and
values from there. Two places can be as near as a fraction of a cell, because the values also shift them.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.encoders.efficientnet import CHANNELS
from roboxim_policies.encoders.feature_cache import STRIDES
from roboxim_policies.learning.layers import Dense, convolve, he

POINT_VALUES = 8
"""Learned values of a token, in addition to its coordinates."""
TOKEN_VALUES = 2 + POINT_VALUES
"""Numbers that describe a token."""


class TokenLearner(eqx.Module):
    """From the features of a camera's picture to a few tokens."""

    joining: dict[str, Dense]
    kernel: Array
    bias: Array
    film: Dense
    attention: Dense
    values: Array

    def __init__(self, *, channels: int, tokens: int, words: int, rng: np.random.Generator) -> None:
        """Draw the weights.

        Args:
            channels: Channels of the grid.
            tokens: Number of tokens.
            words: Length of the instruction's vector.
            rng: Source of the weights.
        """
        self.joining = {str(s): Dense(CHANNELS[s], channels, rng=rng, scale=0.5) for s in STRIDES}
        self.kernel, self.bias = he(rng, (3, 3, channels, channels)), jnp.zeros(channels)
        self.film = Dense(words, 4 * channels, rng=rng, scale=0.1)
        self.attention = Dense(channels, tokens, rng=rng)
        self.values = he(rng, (tokens, channels, TOKEN_VALUES), 0.3 * math.sqrt(tokens))

    def __call__(self, seen: dict[int, Array], words: Array) -> Array:
        """Return tokens: coordinates -1..1 and values, shape (B, tokens, `TOKEN_VALUES`).

        Args:
            seen: Stride to features, shape (B, rows, columns, channels).
            words: The instruction's vector, shape (B, words).
        """
        fine, coarse = (self.joining[str(s)](seen[s].astype(jnp.float32)) for s in STRIDES)
        coarse = jnp.repeat(jnp.repeat(coarse, 2, axis=1), 2, axis=2)[:, : fine.shape[1], : fine.shape[2]]
        films = jnp.split(self.film(words)[:, None, None, :], 4, axis=-1)
        x = jax.nn.relu((fine + coarse) * (1 + films[0]) + films[1])
        x = x + jax.nn.relu((convolve(x, self.kernel, 1) + self.bias) * (1 + films[2]) + films[3])
        batch, height, width, _ = x.shape
        x = x.reshape(batch, height * width, -1)
        weight = jax.nn.softmax(self.attention(x), axis=1)
        rows, columns = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
        grid = jnp.stack([columns.ravel(), rows.ravel()], axis=-1)
        values = jnp.einsum("bkc,kcv->bkv", jnp.einsum("bnk,bnc->bkc", weight, x), self.values)
        places = jnp.einsum("bnk,nv->bkv", weight, grid) + 2.0 / jnp.array([width, height]) * values[..., :2]
        return jnp.concatenate([places, values[..., 2:]], axis=-1)


class Attention(eqx.Module):
    """Attention of some tokens to others, in several heads, with a layer of its own after it; both are residual."""

    asked: Dense
    offered: Dense
    joined: Dense
    wide: Dense
    narrow: Dense
    heads: int = eqx.field(static=True)

    def __init__(self, size: int, heads: int, *, rng: np.random.Generator) -> None:
        """Draw the weights.

        Args:
            size: Length of a token.
            heads: Number of heads, which divides it.
            rng: Source of the weights.
        """
        self.asked, self.offered = Dense(size, size, rng=rng, scale=0.7), Dense(size, 2 * size, rng=rng, scale=0.7)
        self.joined = Dense(size, size, rng=rng, scale=0.3)
        self.wide, self.narrow = Dense(size, 2 * size, rng=rng), Dense(2 * size, size, rng=rng, scale=0.3)
        self.heads = heads

    def __call__(self, tokens: Array, others: Array, allowed: Array | None = None) -> Array:
        """Return the tokens after they have attended.

        Args:
            tokens: Shape (B, n, size).
            others: What they attend to, shape (B, m, size).
            allowed: Whether a token may attend to another, shape (B, n, m) or (n, m); None: always.
        """
        size = tokens.shape[-1] // self.heads

        def split(x: Array) -> Array:
            return x.reshape(*x.shape[:-1], self.heads, size)

        asked = split(self.asked(normalised(tokens)))
        keys, values = (split(x) for x in jnp.split(self.offered(normalised(others)), 2, axis=-1))
        scores = jnp.einsum("bnhs,bmhs->bhnm", asked, keys) / math.sqrt(size)
        if allowed is not None:
            scores = jnp.where(allowed if allowed.ndim == 2 else allowed[:, None], scores, -1e9)
        found = jnp.einsum("bhnm,bmhs->bnhs", jax.nn.softmax(scores, axis=-1), values)
        tokens = tokens + self.joined(found.reshape(tokens.shape))
        return tokens + self.narrow(jax.nn.gelu(self.wide(normalised(tokens))))


def normalised(x: Array) -> Array:
    """Return vectors with mean 0 and variance 1 over the last axis."""
    centred = x - x.mean(axis=-1, keepdims=True)
    return jnp.asarray(centred * jax.lax.rsqrt(jnp.mean(centred**2, axis=-1, keepdims=True) + 1e-6))
