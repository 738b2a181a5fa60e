"""Initial weights of a training: random, or those of a checkpoint (fine-tuning).

Weights are valid only with the normalisation that they were trained with, so fine-tuning keeps it. A family that learns
an embedding for each word keeps those of the words that both datasets have.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.differences import differences
from roboxim_policies.learning.checkpoint import Checkpoint, Statistics
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import Demonstrations
from roboxim_policies.learning.families import make_network

SHAPE = ("chunk", "image_sizes")
"""Fields of `LearningConfig` that shape the network; a family's own fields may, too."""


def require_start(start: Checkpoint, config: LearningConfig, data: Demonstrations) -> None:
    """Check that a training can begin with a checkpoint.

    Args:
        start: The checkpoint.
        config: Configuration of the training.
        data: Its demonstrations.

    Raises:
        ConfigError: When the checkpoint is of another family, or of other cameras.
        RoboximError: When its actions mean something else.
    """
    if start.config.FAMILY != config.FAMILY:
        raise ConfigError(
            f"the training is of '{config.FAMILY}', and the checkpoint that it should begin with of "
            f"'{start.config.FAMILY}': roboxim train {start.config.FAMILY}"
        )
    sizes = {name: int(images.shape[1]) for name, images in data.images.items()}
    if start.input_sizes != sizes:
        raise ConfigError(
            f"the checkpoint sees the cameras {_listed(start.input_sizes)}, and the training {_listed(sizes)}; "
            "export these cameras, or set image_sizes"
        )
    data.semantics.require_compatible(start.semantics, owner="the dataset", other_owner="the checkpoint")


def carried_weights(start: Checkpoint, config: LearningConfig, data: Demonstrations) -> Array:
    """Return a checkpoint's averaged weights as the first weights of a training.

    Args:
        start: The checkpoint.
        config: Configuration of the training.
        data: Its demonstrations.

    Raises:
        ConfigError: When the network has another shape.
    """
    cameras = tuple(sorted(data.images))
    drawn, network_of = make_network(config, cameras, len(data.vocabulary), config.seed)
    vector, before_of = make_network(start.config, cameras, len(start.vocabulary), 0)
    if vector.shape != start.arrays[-1].shape:
        raise ConfigError("the checkpoint's weights do not fit its configuration; another version of RoboXim wrote it")
    new, before = network_of(drawn), before_of(jnp.asarray(start.arrays[-1]))
    table = getattr(before, "words", None)  # of a family that has an embedding for each word
    if isinstance(table, Array):
        words = np.array(new.words)
        if words.shape[1] == table.shape[1]:
            words[0] = table[0]  # of padding
            for index, word in enumerate(start.vocabulary):
                if word in data.vocabulary:
                    words[data.vocabulary.index(word) + 1] = table[index + 1]
        before = eqx.tree_at(lambda network: network.words, before, jnp.asarray(words))
    if _form(before) != _form(new):
        ignored = [f.name for f in fields(LearningConfig) if f.name not in SHAPE]
        changed = differences(to_plain(start.config), to_plain(config), ignore=ignored)
        raise ConfigError(
            f"the checkpoint has a network of another shape ({changed}); leave these fields out, so that the "
            "checkpoint's are used"
        )
    weights: Array = ravel_pytree(before)[0]
    return weights


def carried_statistics(start: Checkpoint, own: Statistics) -> Statistics:
    """Return a checkpoint's normalisation; a component of motion that it never saw gets the data's scale.

    Of x and y the one that it saw gives the scale of both, because the network turns these vectors.
    """
    known = start.stats.motion_scale
    scale = np.where(known > 0, known, own.motion_scale)
    if known[:2].any():
        scale[:2] = np.where(scale[:2] > 0, known[:2].max(), 0.0)
    return replace(start.stats, motion_scale=scale)


def record_of(start: Checkpoint) -> dict[str, Any]:
    """Return what the description of a fine-tuned checkpoint says about the one that it began with."""
    content: dict[str, Any] = {"digest": start.digest, "step": start.step}
    if start.pretraining:
        content["pretraining"] = dict(start.pretraining)
    return content


def _form(network: Any) -> tuple[Any, list[tuple[int, ...]]]:
    leaves, structure = jax.tree.flatten(network)
    return structure, [leaf.shape for leaf in leaves]


def _listed(sizes: dict[str, int]) -> str:
    return ", ".join(f"{name} ({side} px)" for name, side in sorted(sizes.items()))
