"""Learned points of a picture: image coordinates of what the instruction names, and the features there."""

from __future__ import annotations

import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.learning.layers import Dense, convolve, he

PATCH = 4
"""Side of the image patches that are the inputs of the first layer [px]."""
POINT_VALUES = 4
"""Number of learned values per point, in addition to its coordinates."""
POINT_SIZE = 2 + POINT_VALUES
"""Numbers that describe a point."""


def _patches(image: Array) -> Array:
    batch, height, width, channels = image.shape
    x = image.reshape(batch, height // PATCH, PATCH, width // PATCH, PATCH, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, height // PATCH, width // PATCH, PATCH * PATCH * channels)


class PointEncoder(eqx.Module):
    """Encoder of an image as points: shape (B, side, side, 3) to (B, keypoints, `POINT_SIZE`).

    Features of a frozen encoder may be added after the convolution that reaches the final grid.

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
    joining: dict[str, Dense]

    def __init__(
        self,
        *,
        channels: int,
        depth: int,
        keypoints: int,
        words: int,
        film: int | None = None,
        features: Mapping[int, int] | None = None,
        rng: np.random.Generator,
    ) -> None:
        """Draw the weights.

        Args:
            channels: Channels of the convolutions; the first convolution has two thirds of this number.
            depth: Convolutions on the final grid.
            keypoints: Number of points.
            words: Length of the instruction's vector.
            film: Convolutions, of those after the patches', that the instruction modulates; None: all.
            features: Stride to channels of a frozen encoder's features; None: there are none.
            rng: Source of the weights.
        """
        first, c, k = 2 * channels // 3, channels, keypoints
        shapes = [(2, 2, 3 * PATCH**2, first), (3, 3, first, c), *([(3, 3, c, c)] * depth)]
        self.kernels = [he(rng, shape) for shape in shapes]
        self.biases = [jnp.zeros(shape[-1]) for shape in shapes]
        modulated = 1 + depth if film is None else film
        self.film = Dense(words, 2 * c * modulated, rng=rng, scale=0.1) if modulated else None
        self.points = Dense(c, k, rng=rng)
        self.values = he(rng, (k, c, 2 + POINT_VALUES), 0.3 * math.sqrt(k))
        self.temperature = jnp.ones(k)
        self.joining = {str(s): Dense(size, c, rng=rng, scale=0.5) for s, size in (features or {}).items()}

    def __call__(self, image: Array, instruction: Array, seen: Mapping[str, Array] | None = None) -> Array:
        """Return each point's coordinates (-1..1) and further learned values.

        Args:
            image: Values -0.5..0.5, shape (B, side, side, 3).
            instruction: Embedding, shape (B, words).
            seen: Stride to the frozen encoder's features of the image, shape (B, rows, columns, channels).
        """
        x = jax.nn.relu(convolve(_patches(image), self.kernels[0], 1) + self.biases[0])
        films = self._films(instruction)
        for layer, (kernel, bias) in enumerate(zip(self.kernels[1:], self.biases[1:], strict=True)):
            y = convolve(x, kernel, 2 if layer == 0 else 1) + bias
            if layer == 0:
                y = y + sum(self._joined(stride, (seen or {})[stride], y.shape) for stride in self.joining)
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
        return jnp.concatenate([places, values[..., 2:]], axis=-1)

    def _joined(self, stride: str, features: Array, shape: tuple[int, ...]) -> Array:
        """Return features with the grid's channels, on the grid of the given shape."""
        joined = self.joining[stride](features.astype(jnp.float32))
        return joined if joined.shape == shape else jax.image.resize(joined, shape, "linear")

    def _films(self, instruction: Array) -> list[tuple[Array, Array]]:
        """Return scale and shift of the channels of each modulated convolution, shape (B, 1, 1, channels) each."""
        if self.film is None:
            return []
        channels = self.kernels[1].shape[-1]
        parts = jnp.split(self.film(instruction)[:, None, None, :], self.film.bias.shape[0] // channels, axis=-1)
        return list(zip(parts[::2], parts[1::2], strict=True))
