"""The policy that runs a trained checkpoint."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roboxim_core.actions import ActionArray
from roboxim_core.config import from_json, to_json
from roboxim_core.errors import ConfigError
from roboxim_core.policies import CameraRequirement, EpisodeStart, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_core.vision.images import resized
from roboxim_policies.base import BasePolicy
from roboxim_policies.encoders.feature_cache import encode
from roboxim_policies.encoders.sentences import embedding
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_policies.learning.data import CLOSED_BELOW, Images
from roboxim_policies.learning.families import config_class, make_network
from roboxim_policies.learning.features import Floats, GraspMemory, proprio_features, tool_yaw, word_indices
from roboxim_policies.learning.layers import Inputs, Prediction
from roboxim_policies.learning.samples import smaller


class LearnedPolicy(BasePolicy):
    """A policy of any family from a checkpoint.

    Note: it requires images at the size of its training data and resizes them as the training did, because an image
    rendered at a smaller size has different pixels. The network is compiled when it is loaded, so that the first action
    is not late. It remembers the episode's grasp, see `features.GraspMemory`, and the observations that its network
    has a history of. Words that do not occur in the training data are ignored, unless a sentence encoder reads them.
    """

    any_thread = True

    def __init__(self, checkpoint: str | Path, *, execute: int = 0, family: str = "") -> None:
        """Load a checkpoint and compile the network.

        Args:
            checkpoint: Checkpoint file, or the folder of a training.
            execute: Actions executed per request; 0: the checkpoint's configuration.
            family: Family that the checkpoint must be of; empty: any.

        Raises:
            ConfigError: When the checkpoint cannot be used.
        """
        self._loaded = loaded = load_checkpoint(Path(checkpoint))
        self.name = loaded.config.FAMILY
        if family not in ("", self.name):
            raise ConfigError(f"{checkpoint} is a checkpoint of '{self.name}', not of '{family}': --policy {self.name}")
        self.horizon = execute or loaded.config.execute
        if not 1 <= self.horizon <= loaded.config.chunk:
            raise ConfigError(f"execute must be 1..{loaded.config.chunk}, the checkpoint's chunk, got {execute}")
        self.cameras = tuple(
            CameraRequirement(name=name, width=width, height=height)
            for name, (width, height) in sorted(loaded.camera_sizes.items())
        )
        self.semantics = loaded.semantics
        self.version = f"step {loaded.step}, {loaded.digest}"
        if loaded.chosen:
            self.version = f"step {loaded.chosen.step} ({loaded.chosen}), {loaded.digest}"
        if loaded.started_from:
            self.version += f", fine-tuned from {loaded.started_from['digest']}"
        weights, _ = make_network(loaded.config, tuple(loaded.camera_sizes), len(loaded.vocabulary), seed=0)
        averaged = loaded.arrays[-1]
        if weights.shape != averaged.shape:
            raise ConfigError(
                f"{checkpoint}: its weights do not fit its configuration; another version of RoboXim wrote it"
            )
        self._weights = jnp.asarray(averaged)
        self._predict = _compiled(
            loaded.config.FAMILY,
            to_json(replace(loaded.config, seed=0)),
            tuple(sorted(loaded.camera_sizes)),
            len(loaded.vocabulary),
        )
        self._begin("")
        blank = {name: np.zeros((side, side, 3), np.uint8) for name, side in loaded.input_sizes.items()}
        self._infer(blank, Proprioception().vector())

    def reset(self, start: EpisodeStart) -> None:
        """Read the instruction and forget the previous episode."""
        self._begin(start.instruction)

    def another(self) -> LearnedPolicy:
        """Return a policy that shares the compiled network but keeps its own episode."""
        shared = copy.copy(self)
        shared._begin("")
        return shared

    def act(self, window: ObservationWindow) -> ActionArray:
        """Return the next ``execute`` actions."""
        newest = window.newest
        if window.commanded_opening is not None:
            self._memory.commanded(window.commanded_opening < CLOSED_BELOW)
        prediction = self._infer(newest.images, newest.proprio.vector(), window.seq)
        actions = np.zeros((self.horizon, 7), np.float32)
        actions[:, :6] = np.asarray(prediction.motion[-1, : self.horizon]) * self._loaded.stats.motion_scale
        opening = np.clip(np.asarray(prediction.opening[-1, : self.horizon]), CLOSED_BELOW, 1.0)
        closed = np.asarray(prediction.closed[-1, : self.horizon]) > 0
        actions[:, 6] = np.where(closed, 0.0, opening)
        self._memory.commanded(bool(closed[-1]))  # unless the next request knows what was executed
        return actions

    def _begin(self, instruction: str) -> None:
        loaded = self._loaded
        self._words = (
            embedding(instruction) if loaded.config.sentences
            else word_indices(instruction, loaded.vocabulary, loaded.word_count)
        )  # fmt: skip
        self._seen: list[tuple[int, Inputs]] = []
        self._memory = GraspMemory(self._loaded.empty)

    def _infer(self, images: Mapping[str, Images], proprio: Floats, tick: int = 0) -> Prediction:
        pixels = {name: resized(images[name], side, side)[None] for name, side in self._loaded.input_sizes.items()}
        state = np.concatenate([proprio_features(proprio), self._memory.observe(proprio)])
        yaw = tool_yaw(proprio)
        inputs = Inputs(
            images=self._look(pixels), state=jnp.asarray(self._loaded.stats.normalize_state(state))[None],
            heading=jnp.asarray([[np.cos(yaw), np.sin(yaw)]], jnp.float32), words=jnp.asarray(self._words)[None],
        )  # fmt: skip
        prediction: Prediction = self._predict(self._weights, self._with_history(inputs, tick))
        return prediction

    def _look(self, pixels: Mapping[str, Images]) -> dict[str, Array]:
        """Return what the network sees of pictures of shape (1, side, side, 3)."""
        config = self._loaded.config
        fine = {name: smaller(picture, config.fine_side(name, picture.shape[1])) for name, picture in pixels.items()}
        found = {name: jnp.asarray(picture, jnp.float32) / 255.0 - 0.5 for name, picture in fine.items()}
        if config.ENCODER:
            for name, picture in pixels.items():
                found |= {f"{name}/{stride}": array for stride, array in encode(picture).items()}
        return found

    def _with_history(self, newest: Inputs, tick: int) -> Inputs:
        """Return what was last observed at each of the training's ticks, ``execute`` apart, as one window.

        Requests may come at other ticks, e.g. at every one for an ensemble, or late. Before the first observation, it
        is repeated and marked as absent.
        """
        config = self._loaded.config
        if config.frames == 1:
            return newest
        wanted = [tick - config.execute * age for age in reversed(range(config.frames))]
        self._seen.append((tick, newest))
        while len(self._seen) > 1 and self._seen[1][0] <= wanted[0]:
            del self._seen[0]
        first = self._seen[0]
        window = [next((one for one in reversed(self._seen) if one[0] <= at), first) for at in wanted]
        joined: Inputs = jax.tree.map(lambda *parts: jnp.concatenate(parts), *(inputs for _, inputs in window))
        return replace(joined, present=jnp.asarray(wanted) >= first[0])


@lru_cache(maxsize=4)
def _compiled(
    family: str, config_json: str, cameras: tuple[str, ...], vocabulary: int
) -> Callable[[Array, Inputs], Prediction]:
    """Return the compiled network, compiled once per process for all checkpoints of the same form."""
    _, network_of = make_network(from_json(config_json, config_class(family)), cameras, vocabulary, seed=0)
    return jax.jit(lambda weights, inputs: network_of(weights)(inputs))
