"""Attention of tokens to each other."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.learning.layers import Dense


class Attention(eqx.Module):
    """Attention of some tokens to others, in several heads, with a layer after it; both are residual."""

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

        queries = split(self.asked(normalised(tokens)))
        keys, values = (split(x) for x in jnp.split(self.offered(normalised(others)), 2, axis=-1))
        scores = jnp.einsum("bnhs,bmhs->bhnm", queries, keys) / math.sqrt(size)
        if allowed is not None:
            scores = jnp.where(allowed if allowed.ndim == 2 else allowed[:, None], scores, -1e9)
        found = jnp.einsum("bhnm,bmhs->bnhs", jax.nn.softmax(scores, axis=-1), values)
        tokens = tokens + self.joined(found.reshape(tokens.shape))
        return tokens + self.narrow(jax.nn.gelu(self.wide(normalised(tokens))))


def normalised(x: Array) -> Array:
    """Return vectors with mean 0 and variance 1 over the last axis."""
    centred = x - x.mean(axis=-1, keepdims=True)
    return jnp.asarray(centred * jax.lax.rsqrt(jnp.mean(centred**2, axis=-1, keepdims=True) + 1e-6))
