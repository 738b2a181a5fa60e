"""EfficientNet-Lite0 trained on ImageNet, in JAX: features of pictures from several of its blocks.

Batch normalisation is folded into the convolutions, since the network is not trained further here.

Non-obvious:
- A convolution of each channel alone is computed as a sum of shifted pictures: XLA's own is many times slower on
  processors.

Source: google's EfficientNet-Lite (tpu/models/official/efficientnet/lite); weights and the order of their names are
those of the package efficientnet-lite-pytorch.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from roboxim_policies.encoders.arrays_of_torch import Arrays, read_arrays
from roboxim_policies.encoders.weights import EFFICIENTNET_LITE0, weights_path

STAGES = (
    (1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)  # fmt: skip
"""Repetitions, side of the kernel, stride of the first one, expansion, channels."""
CHANNELS = {4: 24, 8: 40, 16: 112, 32: 320}
"""Channels of the features by their stride: one feature stands for a square of so many pixels."""
EPSILON = 1e-3
MEAN, SCALE = 127.0, 128.0
"""Normalisation of a picture's colours (``MEAN_RGB``, ``STDDEV_RGB`` of efficientnet_lite_builder.py)."""

Weights = dict[str, Any]


def _folded(arrays: Arrays, convolution: str, norm: str) -> dict[str, npt.NDArray[np.float32]]:
    """Return kernel (height, width, inputs, outputs) and bias of a convolution with its normalisation."""
    kernel = arrays[f"{convolution}.weight"]
    scale = arrays[f"{norm}.weight"] / np.sqrt(arrays[f"{norm}.running_var"] + EPSILON)
    bias = arrays[f"{norm}.bias"] - arrays[f"{norm}.running_mean"] * scale
    folded = (kernel * scale[:, None, None, None]).transpose(2, 3, 1, 0)
    return {"kernel": np.ascontiguousarray(folded, np.float32), "bias": bias.astype(np.float32)}


@lru_cache(maxsize=1)
def load_weights() -> Weights:
    """Read the installed weights.

    Raises:
        UnavailableError: When the package is not installed.
        ConfigError: When its file has another hash or is no file of arrays.
    """
    arrays = read_arrays(weights_path(EFFICIENTNET_LITE0))
    blocks, number = [], 0
    for repeats, _, _, expansion, _ in STAGES:
        for _ in range(repeats):
            name = f"_blocks.{number}"
            block = {
                "depthwise": _folded(arrays, f"{name}._depthwise_conv", f"{name}._bn1"),
                "project": _folded(arrays, f"{name}._project_conv", f"{name}._bn2"),
            }
            if expansion > 1:
                block["expand"] = _folded(arrays, f"{name}._expand_conv", f"{name}._bn0")
            blocks.append(block)
            number += 1
    return {
        "stem": _folded(arrays, "_conv_stem", "_bn0"), "blocks": blocks,
        "head": _folded(arrays, "_conv_head", "_bn1"),
        "classes": {"kernel": np.ascontiguousarray(arrays["_fc.weight"].T), "bias": arrays["_fc.bias"]},
    }  # fmt: skip


def _relu6(x: Array) -> Array:
    return jnp.clip(x, 0.0, 6.0)


def _pointwise(x: Array, layer: Any) -> Array:
    return jnp.asarray(x @ layer["kernel"][0, 0] + layer["bias"])


def _depthwise(x: Array, layer: Any, stride: int) -> Array:
    """Convolve each channel with its own kernel, as a sum of shifted pictures."""
    kernel = layer["kernel"]  # (side, side, 1, channels)
    side, (height, width) = kernel.shape[0], x.shape[1:3]
    rows, columns = -(-height // stride), -(-width // stride)
    down = max((rows - 1) * stride + side - height, 0)
    across = max((columns - 1) * stride + side - width, 0)
    edges = ((0, 0), (down // 2, down - down // 2), (across // 2, across - across // 2), (0, 0))
    padded = jnp.pad(x, edges)
    total = layer["bias"]
    for i in range(side):
        for j in range(side):
            shifted = padded[:, i : i + (rows - 1) * stride + 1 : stride, j : j + (columns - 1) * stride + 1 : stride]
            total = total + shifted * kernel[i, j, 0]
    return jnp.asarray(total)


def features(weights: Weights, pixels: Array, strides: tuple[int, ...]) -> dict[int, Array]:
    """Return the features of pictures.

    Args:
        weights: See `load_weights`.
        pixels: Colours 0..255, shape (B, height, width, 3); sides are multiples of the largest stride.
        strides: Which features, of `CHANNELS`; blocks beyond the largest stride are not computed.

    Returns:
        Stride to the last block's output of that stride, shape (B, height / stride, width / stride, channels).
    """
    x = (pixels - MEAN) / SCALE
    stem = weights["stem"]
    x = jax.lax.conv_general_dilated(x, stem["kernel"], (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    x = _relu6(x + stem["bias"])
    found: dict[int, Array] = {}
    number, reached = 0, 2
    for repeats, _, first, expansion, _ in STAGES:
        if reached * first > max(strides):
            break
        reached *= first
        for repeat in range(repeats):
            block, stride = weights["blocks"][number], first if repeat == 0 else 1
            y = _relu6(_pointwise(x, block["expand"])) if expansion > 1 else x
            y = _pointwise(_relu6(_depthwise(y, block["depthwise"], stride)), block["project"])
            x = x + y if stride == 1 and y.shape == x.shape else y
            number += 1
        if reached in strides:
            found[reached] = x
    return found
