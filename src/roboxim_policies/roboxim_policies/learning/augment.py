"""What a training changes at random in pictures, words and the robot's state, so that a policy does not rely on it.

All draws are a function of seed and step, made on the host; what they do to a picture is compiled into the training
step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.encoded_config import EncodedConfig
from roboxim_policies.learning.features import PROPRIO_SIZE

OVERLAY_CELLS = 6
"""Cells along each side of an overlay; colours between their centres are interpolated."""
PATCH_RADII = (0.025, 0.2)
"""Smallest and largest half axis of a patch, relative to the picture's side; their logarithm is drawn evenly."""
SHADOW = 0.6
"""Brightness of a patch's shadow, relative to what it falls on."""

Draws = dict[str, np.ndarray[Any, Any]]


def augmentation(config: LearningConfig, cameras: tuple[str, ...], step: int, batch: int) -> dict[str, Array]:
    """Draw a step's augmentation.

    Args:
        config: Configuration of the training.
        cameras: Names of the cameras.
        step: The step.
        batch: Number of observations, a multiple of the configuration's ``frames``.
    """
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(1, step)))
    draws: Draws = {
        "proprio": rng.normal(size=(batch, PROPRIO_SIZE)).astype(np.float32),
        "late": rng.integers(0, config.execute, batch, dtype=np.int32),
        "retry": rng.uniform(size=batch).astype(np.float32),
    }
    for camera in cameras:
        light = 1 + config.brightness * rng.uniform(-1, 1, (batch, 1, 1, 1))
        color = 1 + 0.2 * config.brightness * rng.uniform(-1, 1, (batch, 1, 1, 3))
        draws[f"{camera}/gain"] = (light * color).astype(np.float32)
        draws[f"{camera}/shift"] = rng.integers(0, 2 * config.shift_px + 1, (batch, 2), dtype=np.int32)
    if isinstance(config, EncodedConfig):
        for camera in cameras:
            draws[f"{camera}/kept"] = rng.uniform(size=(batch, 1, 1, 1)) >= config.feature_dropout
    # A generator of its own: trainings without these keep their bits. A window's frames share what is drawn.
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(3, step)))
    for camera in cameras:
        looks = _looks(config, rng, batch // config.frames)
        draws |= {f"{camera}/{name}": np.repeat(value, config.frames, axis=0) for name, value in looks.items()}
    return {name: jnp.asarray(value) for name, value in draws.items()}


def kept_words(config: LearningConfig, step: int, shape: tuple[int, int]) -> dict[str, Array]:
    """Draw which words of each sample are read; nothing if all are.

    Args:
        config: Configuration of the training.
        step: The step.
        shape: Observations and words.
    """
    if not config.word_dropout:
        return {}
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(4, step)))
    return {"words": jnp.asarray(rng.uniform(size=shape) >= config.word_dropout)}


def without_augmentation(config: LearningConfig) -> LearningConfig:
    """Return the configuration of a training that shows its samples as they are."""
    return replace(config, retry=0.0, shift_px=0, color_mix=0.0, overlay=0.0, patches=0, word_dropout=0.0)


def _looks(config: LearningConfig, rng: np.random.Generator, batch: int) -> Draws:
    """Draw changes of one camera's pictures."""
    found: Draws = {}
    if config.color_mix:
        found["mix"] = np.eye(3) + config.color_mix * rng.uniform(-0.5, 0.5, (batch, 3, 3))
        found["cast"] = config.color_mix * rng.uniform(-0.5, 0.5, (batch, 1, 1, 3))
    if config.overlay:
        found["overlay"] = rng.uniform(size=(batch, OVERLAY_CELLS, OVERLAY_CELLS, 3))
        found["weight"] = rng.uniform(0, config.overlay, (batch, 1, 1, 1))
    if config.patches:
        shape = (batch, config.patches)
        there = np.arange(config.patches) < rng.integers(0, config.patches + 1, (batch, 1))
        found["patch/there"] = there.astype(np.float32)
        found["patch/center"] = rng.uniform(size=(*shape, 2))
        least, most = np.log(PATCH_RADII)
        longer = np.exp(rng.uniform(least, most, (*shape, 1)))
        found["patch/radii"] = longer * np.concatenate(
            [np.ones((*shape, 1)), rng.uniform(0.5, 1, (*shape, 1))], axis=-1
        )
        found["patch/angle"] = rng.uniform(0, np.pi, shape)
        found["patch/shadow"] = rng.uniform(-1, 1, (*shape, 2)) * longer  # its displacement; all of it may be hidden
        found["patch/color"] = _hues(rng, shape)
    return {name: value.astype(np.float32) for name, value in found.items()}


def _hues(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """Draw colours of any hue, most of them strong: each resembles some object. Shape (..., 3), in 0..1."""
    hue, saturation, value = (rng.uniform(least, 1, (*shape, 1)) for least in (0, 0.3, 0.3))
    pure = np.clip(np.abs((6 * hue + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    return np.asarray(value * (1 - saturation * (1 - pure)))


def seen(pixels: Array, camera: str, draws: dict[str, Array], config: LearningConfig) -> Array:
    """Return pictures as a training step shows them to the network, in -0.5..0.5.

    Args:
        pixels: Shape (B, side, side, 3), in 0..1.
        camera: Name of the camera.
        draws: See `augmentation`.
        config: Configuration of the training.
    """
    pixels = jnp.clip(pixels * draws[f"{camera}/gain"], 0, 1)
    if config.patches:
        pixels = _with_patches(pixels, camera, draws, config.patches)
    if config.overlay:
        weight, smooth = draws[f"{camera}/weight"], draws[f"{camera}/overlay"]
        pixels += weight * (jax.image.resize(smooth, pixels.shape, "linear") - pixels)
    if config.color_mix:
        mixed = jnp.einsum("bhwc,bcd->bhwd", pixels - 0.5, draws[f"{camera}/mix"])
        pixels = jnp.clip(mixed + 0.5 + draws[f"{camera}/cast"], 0, 1)
    pixels = pixels - 0.5
    return _shifted(pixels, draws[f"{camera}/shift"], config.shift_px) if config.shift_px else pixels


def _with_patches(pixels: Array, camera: str, draws: dict[str, Array], count: int) -> Array:
    """Return pictures with ellipses pasted into them, each of one colour, darker towards its rim, with a shadow."""
    side = pixels.shape[1]
    along = (jnp.arange(side) + 0.5) / side
    names = ("there", "center", "radii", "angle", "shadow", "color")
    for i in range(count):
        part = {name: draws[f"{camera}/patch/{name}"][:, i] for name in names}
        cosine, sine = (turn(part["angle"])[:, None, None] for turn in (jnp.cos, jnp.sin))
        radii = part["radii"][:, :, None, None]

        def squared(center: Array, cosine: Array = cosine, sine: Array = sine, radii: Array = radii) -> Array:
            """Return the squared distance of each pixel from an ellipse's centre, 1 on its rim."""
            down, right = along - center[:, :1], along - center[:, 1:]
            first = cosine * down[:, :, None] + sine * right[:, None, :]
            second = cosine * right[:, None, :] - sine * down[:, :, None]
            return (first / radii[:, 0]) ** 2 + (second / radii[:, 1]) ** 2

        there = part["there"][:, None, None] > 0
        shade = there & (squared(part["center"] + part["shadow"]) < 1)
        pixels = jnp.where(shade[..., None], SHADOW * pixels, pixels)
        distance = squared(part["center"])
        color = part["color"][:, None, None, :] * jnp.sqrt(jnp.maximum(1 - 0.75 * distance, 0.25))[..., None]
        pixels = jnp.where((there & (distance < 1))[..., None], color, pixels)
    return pixels


def _shifted(pixels: Array, offsets: Array, max_shift: int) -> Array:
    side = pixels.shape[1]
    padded = jnp.pad(pixels, ((0, 0), (max_shift, max_shift), (max_shift, max_shift), (0, 0)), mode="edge")
    cut: Callable[..., Array] = jax.vmap(
        lambda image, offset: jax.lax.dynamic_slice(image, (offset[0], offset[1], 0), (side, side, 3))
    )
    return cut(padded, offsets)
