"""Errors of a network on held-out demonstrations, in physical units."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from roboxim_policies.learning.augment import without_augmentation
from roboxim_policies.learning.checkpoint import Checkpoint, Statistics
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import CLOSED_BELOW, Demonstrations
from roboxim_policies.learning.families import make_network
from roboxim_policies.learning.features import NONE, PROPRIO_SIZE, Flags, Floats
from roboxim_policies.learning.layers import Prediction
from roboxim_policies.learning.samples import Samples, Wanted, loss_of
from roboxim_policies.learning.supply import Supply

NEAR_TICKS = (2, 16)
"""Ticks before a grasp within which its predicted pose is judged."""
BATCH = 128
MAX_SAMPLES = 1024
"""Most samples of held-out demonstrations that are judged."""


@dataclass(frozen=True, kw_only=True)
class ValidationErrors:
    """Errors on held-out demonstrations."""

    grasp_mm: float
    """Median distance of the predicted grasp position, shortly before the grasp [mm]."""
    grasp_p90_mm: float
    """Its 90th percentile [mm]."""
    grasp_yaw_deg: float
    """90th percentile of the error of the predicted grasp's yaw, half turns apart are equal [degrees]."""
    release_mm: float
    """Median distance of the predicted next opening's position, while something is held that is opened later [mm]."""
    motion_mm: float
    """Mean error of the translation per executed tick [mm]."""
    turn_mrad: float
    """Mean error of the rotation about the vertical per executed tick [mrad]."""
    gripper: float
    """Fraction of executed ticks in which the gripper wrongly opens or closes."""


def validate(checkpoint: Checkpoint, data: Demonstrations) -> ValidationErrors:
    """Measure the errors of a checkpoint's averaged weights.

    Args:
        checkpoint: The checkpoint.
        data: Demonstrations with the vocabulary of the training data (``assemble(like=...)``).
    """
    cameras = tuple(sorted(data.images))
    config = without_augmentation(checkpoint.config)
    _, network_of = make_network(config, cameras, len(data.vocabulary), 0)
    network, stats = network_of(jnp.asarray(checkpoint.arrays[-1])), checkpoint.stats
    supply = Supply(data, config)
    samples = supply.samples(stats)

    @jax.jit
    def predict(batch: jax.Array, draws: dict[str, Any]) -> tuple[Prediction, Wanted]:
        inputs, wanted = samples.draw(batch, draws, config)
        newest = slice(config.frames - 1, None, config.frames)
        predictions: Prediction = jax.tree.map(lambda array: array[newest], network(inputs))
        return predictions, jax.tree.map(lambda array: array[newest], wanted)

    def judged(part: Any) -> tuple[Prediction, Wanted]:
        batch, draws = _undisturbed(supply, cameras, part)
        found: tuple[Prediction, Wanted] = predict(batch, draws)
        return found

    chunks = [judged(part) for part in np.split(np.arange(len(data)), range(BATCH, len(data), BATCH))]
    predictions = jax.tree.map(lambda *parts: np.concatenate(parts), *(chunk[0] for chunk in chunks))
    wanted = jax.tree.map(lambda *parts: np.concatenate(parts), *(chunk[1] for chunk in chunks))
    target = np.asarray(predictions.target) * stats.target_scale + stats.target_mean
    executed = slice(0, config.execute)
    move = np.abs((predictions.motion - wanted.motion)[:, executed] * stats.motion_scale)
    distance = 1e3 * np.linalg.norm(target[:, :3] - data.targets[:, :3], axis=1)
    ticks = np.expm1(data.targets[:, 6])
    free = data.grasps == NONE
    near = free & (ticks >= NEAR_TICKS[0]) & (ticks <= NEAR_TICKS[1])
    yaw = 0.5 * np.rad2deg(np.abs(_angle(target[:, 4:6], data.targets[:, 4:6])))
    closes, closed = np.asarray(predictions.closed) > 0, np.asarray(wanted.opening) < CLOSED_BELOW
    return ValidationErrors(
        grasp_mm=_quantile(distance[near], 0.5), grasp_p90_mm=_quantile(distance[near], 0.9),
        grasp_yaw_deg=_quantile(yaw[near], 0.9), release_mm=_quantile(distance[before_release(data)], 0.5),
        motion_mm=1e3 * float(np.linalg.norm(move[..., :3], axis=-1).mean()),
        turn_mrad=1e3 * float(move[..., 5].mean()),
        gripper=float((closes != closed)[:, executed].mean()),
    )  # fmt: skip


def before_release(data: Demonstrations) -> Flags:
    """Return for each step whether something is held whose release is the next event, shape (N,)."""
    closed = data.actions[:, 6] < CLOSED_BELOW
    following = np.arange(len(data)) + np.round(np.expm1(data.targets[:, 6])).astype(int)
    return np.asarray((data.grasps != NONE) & closed & ~closed[following])


class HeldOut:
    """Demonstrations that choose among the weights of a training."""

    def __init__(
        self, data: Demonstrations, config: LearningConfig, stats: Statistics, cameras: tuple[str, ...]
    ) -> None:
        """Prepare the samples: at most `MAX_SAMPLES`, evenly spaced.

        Args:
            data: The demonstrations, with the vocabulary of the training data (``assemble(like=...)``).
            config: Configuration of the training.
            stats: Normalisation of the training data.
            cameras: Names of the cameras.
        """
        config = replace(without_augmentation(config), held_out=0, patience=0)
        supply = Supply(data, config)
        _, network_of = make_network(config, cameras, len(data.vocabulary), 0)
        chosen = np.arange(0, len(data), -(-len(data) // MAX_SAMPLES))
        self.episodes = data.episodes
        self._batches = [
            _undisturbed(supply, cameras, part) for part in np.split(chosen, range(BATCH, len(chosen), BATCH))
        ]

        @jax.jit
        def judge(samples: Samples, weights: jax.Array, batch: jax.Array, draws: dict[str, Any]) -> jax.Array:
            return loss_of(network_of(weights), *samples.draw(batch, draws, config), config)[0]

        self._judge, self._samples = judge, supply.samples(stats)

    def loss(self, weights: jax.Array) -> float:
        """Return the loss of weights, without noise on the inputs."""
        losses = [float(self._judge(self._samples, weights, *batch)) for batch in self._batches]
        return float(np.average(losses, weights=[len(indices) for indices, _ in self._batches]))


def _undisturbed(supply: Supply, cameras: tuple[str, ...], part: Any) -> tuple[jax.Array, dict[str, Any]]:
    """Return samples without augmentation, each with the history that a policy would have seen."""
    batch, present = supply.windows_before(part)
    still: dict[str, Any] = {f"{camera}/gain": jnp.ones((len(batch), 1, 1, 1)) for camera in cameras}
    still |= {f"{camera}/kept": jnp.ones((len(batch), 1, 1, 1)) for camera in cameras}
    none = jnp.zeros(len(batch), jnp.int32)
    still |= {"proprio": jnp.zeros((len(batch), PROPRIO_SIZE)), "late": none, "wording": none}
    return jnp.asarray(batch), still | supply.given(batch, present)


def _quantile(values: Floats, fraction: float) -> float:
    return float(np.quantile(values, fraction)) if len(values) else float("nan")


def _angle(first: Floats, second: Floats) -> Floats:
    """Return the angles between pairs of (sine, cosine) [rad]."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(np.arctan2(cross, (first * second).sum(axis=1)), np.float32)
