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
from roboxim_policies.bc.checkpoint import load_checkpoint
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.bc.data import CLOSED_BELOW, Images
from roboxim_policies.bc.features import Floats, GraspMemory, proprio_features, tool_yaw, word_indices
from roboxim_policies.bc.network import Inputs, Prediction, make_network


class BCPolicy(BasePolicy):
    """A behaviour-cloning policy from a checkpoint.

    Note: it requires images at the size of its training data and resizes them as the training did, because an image
    rendered at a smaller size has different pixels. The network is compiled when it is loaded, so that the first action
    is not late. It remembers the episode's grasp, see `features.GraspMemory`. Words that do not occur in the training
    data are ignored.
    """

    name = "bc"
    any_thread = True

    def __init__(self, checkpoint: str | Path, *, execute: int = 0) -> None:
        """Load a checkpoint and compile the network.

        Args:
            checkpoint: Checkpoint file, or the folder of a training.
            execute: Actions executed per request; 0: the checkpoint's configuration.

        Raises:
            ConfigError: When the checkpoint cannot be used.
        """
        self._said = said = load_checkpoint(Path(checkpoint))
        self.horizon = execute or said.config.execute
        if not 1 <= self.horizon <= said.config.chunk:
            raise ConfigError(f"execute must be 1..{said.config.chunk}, the checkpoint's chunk, got {execute}")
        self.cameras = tuple(
            CameraRequirement(name=name, width=width, height=height)
            for name, (width, height) in sorted(said.camera_sizes.items())
        )
        self.semantics = said.semantics
        self.version = f"step {said.step}, {said.digest}"
        weights, _ = make_network(said.config, tuple(said.camera_sizes), len(said.vocabulary), seed=0)
        averaged = said.arrays[-1]
        if weights.shape != averaged.shape:
            raise ConfigError(
                f"{checkpoint}: its weights do not fit its configuration; another version of RoboXim wrote it"
            )
        self._weights = jnp.asarray(averaged)
        self._predict = _compiled(
            to_json(replace(said.config, seed=0)), tuple(sorted(said.camera_sizes)), len(said.vocabulary)
        )
        self._begin("")
        blank = {name: np.zeros((side, side, 3), np.uint8) for name, side in said.input_sizes.items()}
        self._infer(blank, Proprioception().vector())

    def reset(self, start: EpisodeStart) -> None:
        """Read the instruction and forget the previous episode."""
        self._begin(start.instruction)

    def another(self) -> BCPolicy:
        """Return a policy with an episode of its own that shares the compiled network."""
        shared = copy.copy(self)
        shared._begin("")
        return shared

    def act(self, window: ObservationWindow) -> ActionArray:
        """Return the next ``execute`` actions."""
        newest = window.newest
        said = self._infer(newest.images, newest.proprio.vector())
        actions = np.zeros((self.horizon, 7), np.float32)
        actions[:, :6] = np.asarray(said.motion[0, : self.horizon]) * self._said.stats.motion_scale
        opening = np.clip(np.asarray(said.opening[0, : self.horizon]), CLOSED_BELOW, 1.0)
        closed = np.asarray(said.closed[0, : self.horizon]) > 0
        actions[:, 6] = np.where(closed, 0.0, opening)
        self._memory.commanded(bool(closed[-1]))
        return actions

    def _begin(self, instruction: str) -> None:
        self._words = jnp.asarray(word_indices(instruction, self._said.vocabulary, self._said.word_count))[None]
        self._memory = GraspMemory(self._said.empty)

    def _infer(self, images: Mapping[str, Images], proprio: Floats) -> Prediction:
        pixels = {
            name: jnp.asarray(resized(images[name], side, side), jnp.float32)[None] / 255.0 - 0.5
            for name, side in self._said.input_sizes.items()
        }
        state = np.concatenate([proprio_features(proprio), self._memory.observe(proprio)])
        yaw = tool_yaw(proprio)
        inputs = Inputs(
            images=pixels, state=jnp.asarray(self._said.stats.normalize_state(state))[None],
            heading=jnp.asarray([[np.cos(yaw), np.sin(yaw)]], jnp.float32), words=self._words,
        )  # fmt: skip
        prediction: Prediction = self._predict(self._weights, inputs)
        return prediction


@lru_cache(maxsize=4)
def _compiled(config_json: str, cameras: tuple[str, ...], vocabulary: int) -> Callable[[Array, Inputs], Prediction]:
    """Return the compiled network, compiled once per process for all checkpoints of the same form."""
    _, network_of = make_network(from_json(config_json, BCConfig), cameras, vocabulary, seed=0)
    return jax.jit(lambda weights, inputs: network_of(weights)(inputs))
