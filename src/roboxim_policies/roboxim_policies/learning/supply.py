"""Inputs of a training step: samples, augmentation, features and wordings.

Everything random is a function of seed and step, and is drawn on the host.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from roboxim_core.plain_data.wordings import reworded
from roboxim_policies.encoders.feature_cache import Features, features_of
from roboxim_policies.encoders.sentences import SIZE, embeddings
from roboxim_policies.learning.augment import augmentation, kept_words
from roboxim_policies.learning.checkpoint import Statistics
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import Demonstrations
from roboxim_policies.learning.samples import Samples

Indices = npt.NDArray[Any]


def wordings(instructions: Sequence[str], config: LearningConfig) -> list[list[str]]:
    """Return the wordings of each instruction, itself first; as many of each, some repeated where one has fewer.

    Args:
        instructions: The instructions.
        config: Its ``wordings``, if the family has them, name the set.
    """
    name = getattr(config, "wordings", "")
    found = [[text, *(reworded(text, name) if name else ())] for text in instructions]
    length = math.lcm(*map(len, found)) if found else 1
    return [texts * (length // len(texts)) for texts in found]


class Supply:
    """Batches of one training or validation."""

    def __init__(
        self,
        data: Demonstrations,
        config: LearningConfig,
        *,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Prepare the samples; computes the features of all pictures unless they are on disk.

        Args:
            data: The demonstrations.
            config: Configuration of the training.
            progress: Called with (pictures done, pictures in all) while features are computed.

        Raises:
            UnavailableError: When the configuration needs a package that is not installed.
            ConfigError: When that package is damaged.
        """
        self._data, self._config = data, config
        self._cameras = tuple(sorted(data.images))
        self._starts = data.starts
        self._order: tuple[int, Indices] | None = None
        self._features: dict[str, Features] = {}
        if config.ENCODER:
            self._features = features_of(data.images, progress=progress)
        self._sentences = embeddings(wordings(data.instructions, config)) if config.sentences else None

    def samples(self, stats: Statistics) -> Samples:
        """Return the arrays of all samples, normalised."""
        return Samples.of(self._data, stats, self._config, self._sentences)

    def batch(self, step: int) -> tuple[Array, dict[str, Any]]:
        """Return the indices of a step's samples and their random draws."""
        last = self._shuffled(step)
        indices, present = self._windows(last)
        draws: dict[str, Any] = augmentation(self._config, self._cameras, step, len(indices))
        if self._config.sentences:
            draws |= self._worded(step, len(last))
        else:
            draws |= kept_words(self._config, step, (len(indices), self._data.words.shape[1]))
        return jnp.asarray(indices), draws | self.given(indices, present)

    def given(self, indices: Indices, present: npt.NDArray[np.bool_] | None = None) -> dict[str, Any]:
        """Return what samples always have: features of their pictures, and which belong to their history."""
        found: dict[str, Any] = {}
        if self._features:
            found["features"] = {name: jnp.asarray(features[indices]) for name, features in self._features.items()}
        if self._config.frames > 1 and present is not None:
            found["present"] = jnp.asarray(present)
        return found

    def windows_before(self, last: Indices) -> tuple[Indices, npt.NDArray[np.bool_]]:
        """Return the observations that a policy has seen up to each sample, and whether each exists; frames in a row.

        The policy observes every ``execute`` ticks. Before its first observation it repeats that one.
        """
        frames, spacing = self._config.frames, self._config.execute
        wanted = last[:, None] - spacing * np.arange(frames - 1, -1, -1)
        first = self._starts[last][:, None]
        return np.maximum(wanted, first).ravel(), (wanted >= first).ravel()

    def _windows(self, last: Indices) -> tuple[Indices, npt.NDArray[np.bool_] | None]:
        return self.windows_before(last) if self._config.frames > 1 else (last, None)

    def _shuffled(self, step: int) -> Indices:
        """Return the sample indices of a step: consecutive slices of one order per epoch."""
        batch = min(max(1, self._config.batch // self._config.frames), len(self._data))
        epoch, piece = divmod(step, len(self._data) // batch)
        if self._order is None or self._order[0] != epoch:
            self._order = epoch, self._order_of(epoch)
        return self._order[1][piece * batch : (piece + 1) * batch]

    def _order_of(self, epoch: int) -> Indices:
        """Return the random order of an epoch's samples.

        A sample's place follows from the seed, the epoch and the sample alone, so that trainings of one seed on
        demonstrations that differ in a part have those that they share in the same order (common random numbers).

        Source:
            Multiplicative hashing of the samples' keys: Dietzfelbinger et al., Journal of Algorithms 25 (1997).
        """
        seed = np.random.SeedSequence(self._config.seed, spawn_key=(0, epoch))
        return np.argsort(self._data.keys * (seed.generate_state(1, np.uint64) | np.uint64(1)), kind="stable")

    def _worded(self, step: int, windows: int) -> dict[str, Any]:
        """Draw a wording for each window, and noise on its embedding."""
        assert self._sentences is not None
        rng = np.random.default_rng(np.random.SeedSequence(self._config.seed, spawn_key=(2, step)))
        drawn = rng.integers(0, self._sentences.shape[1], windows, dtype=np.int32)
        found = {"wording": drawn}
        if self._config.word_noise:
            found["word_noise"] = rng.normal(scale=self._config.word_noise, size=(windows, SIZE)).astype(np.float32)
        return {name: jnp.asarray(np.repeat(each, self._config.frames, axis=0)) for name, each in found.items()}
