"""The training data as arguments of the compiled step, and the loss."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax
from jax import Array

from roboxim_core.vision.images import resized
from roboxim_policies.learning.augment import seen
from roboxim_policies.learning.checkpoint import Statistics
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import CLOSED_BELOW, Demonstrations, Images
from roboxim_policies.learning.features import memory_features
from roboxim_policies.learning.layers import Inputs, Network, Prediction

Floats = npt.NDArray[np.float32]

OPENING = 3
"""Index of the gripper's opening in the proprioception features."""
RISE_M = 0.01
"""Upward motion per tick of a gripper that closed on nothing [m]."""


class Wanted(eqx.Module):
    """Targets of the network's outputs, for B samples."""

    motion: Array
    """Normalised translations and rotations, shape (B, chunk, 6)."""
    opening: Array
    """Commanded opening, shape (B, chunk)."""
    target: Array
    """Normalised target of the auxiliary task, shape (B, `TARGET_SIZE`)."""


class Samples(eqx.Module):
    """The training data, normalised."""

    images: dict[str, Array]
    proprio: Array
    noise: Array
    position: Array
    yaw: Array
    opening: Array
    motion: Array
    gripper: Array
    targets: Array
    ends: Array
    grasps: Array
    least: Array
    released: Array
    failed: Array
    words: Array
    sentences: Array | None
    mean: Array
    scale: Array
    rise: Array
    empty: Array
    retries: bool = eqx.field(static=True)

    @staticmethod
    def of(data: Demonstrations, stats: Statistics, config: LearningConfig, sentences: Floats | None = None) -> Samples:
        """Normalise.

        Args:
            data: The demonstrations.
            stats: Their normalisation.
            config: Configuration of the training.
            sentences: Embeddings of the wordings of each instruction, shape (instructions, wordings, 512), for a
                network that reads sentences; None: it reads words.
        """
        noise = np.zeros_like(data.proprio)
        noise[:, :3] = config.position_noise_m
        noise[:, OPENING] = config.opening_noise * (1 - data.proprio[:, OPENING])
        safe = np.where(stats.motion_scale > 0, stats.motion_scale, 1.0)
        rise = np.where(stats.motion_scale[:3] > 0, RISE_M / safe[:3] * data.up, 0.0)
        empties = data.proprio[:, OPENING] < data.empty
        return Samples(
            images={name: jnp.asarray(smaller(images, config.fine_side(name, images.shape[1])))
                    for name, images in data.images.items()},
            proprio=jnp.asarray(data.proprio), noise=jnp.asarray(noise), position=jnp.asarray(data.proprio[:, :3]),
            yaw=jnp.asarray(data.yaw, jnp.float32), opening=jnp.asarray(data.proprio[:, OPENING]),
            motion=jnp.asarray((data.actions[:, :6] / safe).astype(np.float32)),
            gripper=jnp.asarray(data.actions[:, 6].astype(np.float32)),
            targets=jnp.asarray(stats.normalize_target(data.targets)), ends=jnp.asarray(data.ends),
            grasps=jnp.asarray(data.grasps, jnp.int32), least=jnp.asarray(data.least_opening),
            released=jnp.asarray(data.released), failed=jnp.asarray(data.failed),
            words=jnp.asarray(data.words if sentences is None else data.instruction),
            sentences=None if sentences is None else jnp.asarray(sentences),
            mean=jnp.asarray(stats.state_mean), scale=jnp.asarray(stats.state_scale),
            rise=jnp.asarray(rise, jnp.float32), empty=jnp.asarray(data.empty, jnp.float32),
            retries=bool(config.retry > 0 and data.empty > 0 and not empties.any()),
        )  # fmt: skip

    def draw(self, batch: Array, draws: dict[str, Any], config: LearningConfig) -> tuple[Inputs, Wanted]:
        """Return a batch's augmented inputs and the outputs that are wanted.

        Args:
            batch: Indices of the samples.
            draws: What was drawn for them, see `roboxim_policies.learning.supply.Supply`.
            config: Configuration of the training.
        """
        last = self.ends[batch][:, None]
        steps = batch[:, None] + jnp.arange(config.chunk)
        inside = (steps <= last).astype(jnp.float32)  # after the end of a demonstration, the action is to hold still
        steps = jnp.minimum(steps, last)
        motion, gripper = self.motion[steps] * inside[..., None], self.gripper[steps]
        proprio, failed = self._noisy(batch, draws["proprio"]), self.failed[batch]
        if self.retries:
            before = (self.grasps[batch] < 0) & (self.opening[batch] > self.empty)
            retry = before & (draws["retry"] < config.retry)
            closed = draws["retry"] < 0.5 * config.retry  # the others have opened again, but must still rise
            proprio = proprio.at[:, OPENING].set(jnp.where(closed & retry, 0.0, proprio[:, OPENING]))
            failed |= retry
            rising = jnp.zeros_like(motion).at[..., :3].set(self.rise[batch][:, None])
            motion = jnp.where(retry[:, None, None], rising, motion)
            gripper = jnp.where(retry[:, None], 1.0, gripper)
        yaw = self.yaw[batch]
        heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        state = jnp.concatenate([proprio, self._memory(batch, draws["late"], heading, failed)], axis=-1)
        images = {
            name: seen(pixels[batch].astype(jnp.float32) / 255.0, name, draws, config)
            for name, pixels in self.images.items()
        }
        for name, features in draws.get("features", {}).items():
            kept = draws[f"{name.partition('/')[0]}/kept"]
            images[name] = features * kept.astype(features.dtype)
        words = self.words[batch]
        if "words" in draws:
            words = words * draws["words"]
        inputs = Inputs(
            images=images, state=(state - self.mean) / self.scale, heading=heading,
            words=words if self.sentences is None
            else self.sentences[words, draws["wording"]] + draws.get("word_noise", 0.0),
            present=draws.get("present"),
        )  # fmt: skip
        return inputs, Wanted(motion=motion, opening=gripper, target=self.targets[batch])

    def _noisy(self, batch: Array, normal: Array) -> Array:
        """Return proprioception with noise; a gripper that holds something never looks empty."""
        clean = self.proprio[batch]
        noisy = clean + self.noise[batch] * normal
        opening = jnp.maximum(noisy[:, OPENING], jnp.minimum(clean[:, OPENING], self.empty))
        return noisy.at[:, OPENING].set(opening)

    def _memory(self, batch: Array, late: Array, heading: Array, failed: Array) -> Array:
        """Return the memory of a policy that noticed the grasp some ticks late."""
        grasps = self.grasps[batch]
        begin = jnp.minimum(batch, grasps + late)
        moved, turned = self.position[batch] - self.position[begin], self.yaw[batch] - self.yaw[begin]
        opened = self.opening[batch] - self.least[batch]
        features: Array = memory_features(
            moved, heading, turned, opened, self.released[batch], grasps >= 0, failed, jnp
        )
        return features


def smaller(images: Images, side: int) -> Images:
    """Return pictures of shape (N, height, width, 3) with a side of ``side`` pixels."""
    if images.shape[1] == side:
        return images
    found = np.empty((len(images), side, side, 3), np.uint8)
    for place, image in zip(found, images, strict=True):
        place[:] = resized(image, side, side)
    return found


def loss_of(network: Network, inputs: Inputs, wanted: Wanted, config: LearningConfig) -> tuple[Array, dict[str, Array]]:
    """Return the loss and its parts."""
    prediction: Prediction = network(inputs)
    move = jnp.mean(optax.huber_loss(prediction.motion, wanted.motion))
    closed = (wanted.opening < CLOSED_BELOW).astype(jnp.float32)
    grip = jnp.mean(optax.sigmoid_binary_cross_entropy(prediction.closed, closed))
    wide = jnp.mean((1 - closed) * (prediction.opening - wanted.opening) ** 2)
    aims = [
        jnp.mean(optax.huber_loss(target, wanted.target)) for target in (prediction.target, *prediction.camera_targets)
    ]
    aim = aims[0] + sum(aims[1:]) * (0.5 / max(1, len(aims) - 1))
    loss = move + config.gripper_weight * (grip + wide) + config.target_weight * aim
    return loss, {"loss": loss, "move": move, "grip": grip, "aim": aims[0]}
