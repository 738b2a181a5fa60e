"""Checkpoints: one file, written atomically, without pickles.

The file is a ``.npz`` with the arrays and a JSON text that describes everything else that the policy needs:
configuration, cameras and their sizes, vocabulary, normalisation, action semantics.

The policy needs one of the four arrays of weights and moments: the averaged weights. `policy_only` leaves out the
others, for a copy of a finished training that is moved or stored.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ACTION_SIZE, ActionSemantics
from roboxim_core.config import digest, from_plain, to_json, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.proprioception import STATE_NAMES
from roboxim_policies.learning.checkpoint_file import FORMAT, UNREADABLE, checkpoint_file, family_in, read_description
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import TARGET_SIZE, Demonstrations
from roboxim_policies.learning.families import config_class
from roboxim_policies.learning.features import STATE_SIZE

Floats = npt.NDArray[np.float32]
ORIGINAL = "original_sha256"
"""Key of the description of a checkpoint without the training's state: the hash of the whole one's file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """Normalisation of inputs and outputs, measured on the training data."""

    state_mean: Floats
    """Mean of the state features."""
    state_scale: Floats
    """Its standard deviation."""
    motion_scale: Floats
    """Root mean square of each component of the motion; 0 for a component that is always 0."""
    target_mean: Floats
    """Mean of the auxiliary targets."""
    target_scale: Floats
    """Their standard deviation."""

    def normalize_state(self, state: Floats) -> Floats:
        """Normalise state features of shape (..., n)."""
        return np.asarray((state - self.state_mean) / self.state_scale, np.float32)

    def normalize_target(self, target: Floats) -> Floats:
        """Normalise auxiliary targets of shape (..., n)."""
        return np.asarray((target - self.target_mean) / self.target_scale, np.float32)


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """The weights that a training has chosen by held-out demonstrations."""

    step: int
    """Step after which they were the average."""
    loss: float
    """Their loss on the held-out demonstrations, the lowest so far."""
    held_out: int
    """Number of these demonstrations."""
    checks: int
    """Number of steps that were compared."""
    since: int
    """Number of comparisons since."""

    def __str__(self) -> str:
        """Say it in words."""
        return f"lowest loss on {self.held_out} held-out demonstrations, of {self.checks} checks"


@dataclass(frozen=True, kw_only=True)
class _Facts:
    """Facts of a checkpoint that its description states as they are."""

    step: int
    """Steps done."""
    vocabulary: tuple[str, ...]
    """Words."""
    word_count: int
    """Longest instruction [words]."""
    camera_sizes: dict[str, tuple[int, int]]
    """Camera name to (width, height) as recorded [px]."""
    input_sizes: dict[str, int]
    """Camera name to the side of the network's input [px]."""
    semantics: ActionSemantics
    """Meaning of the actions."""
    robot: str = ""
    """Id of the robot model of the demonstrations; empty: unknown."""
    chosen: Chosen | None = None
    """How the averaged weights were chosen; None: they are the last step's."""
    identity: str
    """Hash of configuration and data, see `Checkpoint.identity_of`."""
    digest: str
    """Hash of the averaged weights, 16 hexadecimal digits."""
    started_from: dict[str, Any] = field(default_factory=dict)
    """The checkpoint that the training began with: its ``digest``, ``step`` and, if it has one, ``pretraining``; empty:
    the first weights were drawn."""
    pretraining: dict[str, Any] = field(default_factory=dict)
    """Name and exposure of a checkpoint of ``roboxim pretrain``; empty: it is another one."""
    original_sha256: str = ""
    """SHA-256 of the whole checkpoint's file, if this one has the averaged weights only; empty: it is whole."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint(_Facts):
    """Content of a checkpoint."""

    config: LearningConfig
    """Configuration."""
    stats: Statistics
    """Normalisation."""
    empty: float
    """Opening of the gripper below which it is closed and empty."""
    continues: bool
    """Whether this version continues its training; it runs the policies of earlier formats, too."""
    arrays: list[npt.NDArray[Any]]
    """Arrays of (weights, optimiser state, averaged weights), in this order; see ``original_sha256``."""

    @staticmethod
    def identity_of(
        config: LearningConfig, data: Demonstrations, started_from: Mapping[str, Any] | None = None,
        held_out: Demonstrations | None = None,
    ) -> str:  # fmt: skip
        """Return the hash of a training's configuration, data and start, which determine its result.

        Args:
            config: Configuration of the training. ``checkpoint_every`` counts only where it determines which weights
                are compared.
            data: The training data.
            started_from: See `Checkpoint.started_from`.
            held_out: The demonstrations that choose the weights; None: there are none.
        """
        content = hashlib.blake2b(digest_size=8)
        for part in (data, held_out) if held_out else (data,):
            for name, images in sorted(part.images.items()):
                content.update(f"{name}{images.shape}".encode())
                content.update(np.ascontiguousarray(images).data)
            content.update(f"{part.vocabulary}{to_json(part.semantics)}{part.instructions}".encode())
            for array in (part.actions, part.proprio, part.ends, part.words, part.instruction):
                content.update(np.ascontiguousarray(array).data)
        if started_from:
            content.update(f"from {started_from['digest']}".encode())
        known = config if config.held_out else replace(config, checkpoint_every=1)
        return f"{config.FAMILY}-{digest(known)}-{content.hexdigest()}"

    def restore(self, state: Any) -> Any:
        """Return a tree of the given structure with the checkpoint's arrays.

        Raises:
            ConfigError: When the shapes differ.
        """
        leaves, structure = jax.tree.flatten(state)
        if [np.shape(leaf) for leaf in leaves] != [array.shape for array in self.arrays]:
            raise ConfigError(
                "the checkpoint's arrays do not fit its configuration; another version of RoboXim wrote it"
            )
        return jax.tree.unflatten(structure, [jax.numpy.asarray(array) for array in self.arrays])


@dataclass(frozen=True, kw_only=True)
class _Description(_Facts):
    """The description in a checkpoint, as far as a policy needs it."""

    config: dict[str, Any]
    stats: dict[str, tuple[float, ...]]
    empty_below: float

    def __post_init__(self) -> None:
        """Check that the parts fit each other; the weights are checked against the configuration.

        Raises:
            ConfigError: Naming the part.
        """
        sizes = {"state_mean": STATE_SIZE, "state_scale": STATE_SIZE, "motion_scale": ACTION_SIZE - 1}
        sizes |= {"target_mean": TARGET_SIZE, "target_scale": TARGET_SIZE}
        if {name: len(values) for name, values in self.stats.items()} != sizes:
            raise ConfigError(f"stats must have the lengths {sizes}")
        if not self.input_sizes or self.input_sizes.keys() != self.camera_sizes.keys():
            raise ConfigError(f"input_sizes must name the cameras of camera_sizes, {', '.join(self.camera_sizes)}")
        if (
            min(self.word_count, *self.input_sizes.values(), *(n for size in self.camera_sizes.values() for n in size))
            < 1
        ):
            raise ConfigError("word_count, input_sizes and camera_sizes must be >= 1")


def save_checkpoint(
    path: Path, state: Any, *, step: int, config: LearningConfig, data: Demonstrations, stats: Statistics,
    identity: str, chosen: Chosen | None = None, started_from: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write a checkpoint to a temporary file and rename it, so that ``path`` is always complete.

    Args:
        path: File to write.
        state: Tree of (weights, optimiser state, averaged weights), and the chosen ones if some are held out; all are
            vectors.
        step: Number of completed steps.
        config: Configuration of the training.
        data: The training data.
        stats: Normalisation of the data.
        identity: See `Checkpoint.identity_of`.
        chosen: How the last array of the state was chosen; None: it is the average after ``step``.
        started_from: See `Checkpoint.started_from`.

    Raises:
        OSError: When the disk is full.
    """
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    description = {
        "format": FORMAT,
        **({} if config.FAMILY == "bc" else {"family": config.FAMILY}),
        **({} if chosen is None else {"chosen": asdict(chosen)}),
        **({"started_from": dict(started_from)} if started_from else {}),
        "step": step,
        "config": to_plain(config),
        "stats": {name: value.tolist() for name, value in asdict(stats).items()},
        "empty_below": data.empty,
        "vocabulary": list(data.vocabulary),
        "word_count": int(data.words.shape[1]),
        "camera_sizes": {name: list(size) for name, size in data.camera_sizes.items()},
        "input_sizes": {name: int(images.shape[1]) for name, images in data.images.items()},
        "semantics": to_plain(data.semantics),
        "robot": data.robot,
        **({"camera_views": to_plain(data.camera_views)} if data.camera_views else {}),
        "state_layout": list(STATE_NAMES),
        "identity": identity,
        "digest": _digest(arrays[-1]),
        "episodes": data.episodes,
    }
    content = _content(description, arrays)
    scratch = path.with_name(f".{path.name}.tmp")
    with scratch.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    scratch.replace(path)


def policy_only(path: Path, pretraining: Mapping[str, Any] | None = None) -> bytes:
    """Return the content of a checkpoint that has what the policy needs, without the state of the training.

    It has the whole checkpoint's description and averaged weights, and the hash of its file. The policy acts the same;
    a training cannot continue from it.

    Args:
        path: The file of a whole checkpoint, or the folder of its training.
        pretraining: What its description says about a pre-training, see `Checkpoint.pretraining`; None: nothing.

    Raises:
        ConfigError: When it is missing, damaged, of another version, or has the averaged weights only.
    """
    file, whole = checkpoint_file(path), load_checkpoint(path)
    if whole.original_sha256:
        raise ConfigError(f"{file} has the averaged weights only already")
    averaged = whole.arrays[-1]
    if _digest(averaged) != whole.digest:
        raise ConfigError(f"{file} is damaged: the hash of its averaged weights differs from its description")
    description = {**read_description(path), ORIGINAL: hashlib.sha256(file.read_bytes()).hexdigest()}
    if pretraining:
        description["pretraining"] = dict(pretraining)
    return _content(description, [averaged])


def _content(description: dict[str, Any], arrays: list[npt.NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    named = {f"array_{index:04d}": array for index, array in enumerate(arrays)}
    np.savez(buffer, allow_pickle=False, said=np.array(json.dumps(description)), **named)
    return buffer.getvalue()


def _digest(averaged: npt.NDArray[Any]) -> str:
    return hashlib.blake2b(averaged.tobytes(), digest_size=8).hexdigest()


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Args:
        path: The file, or the folder of a training.

    Raises:
        ConfigError: When it is missing, damaged or of another version.
    """
    file, description = checkpoint_file(path), read_description(path)
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = [archive[name] for name in sorted(archive.files) if name.startswith("array_")]
    except UNREADABLE as error:
        raise ConfigError(f"{file} is not a readable checkpoint: {str(error) or type(error).__name__}") from None
    if not arrays:
        raise ConfigError(f"{file} is not a readable checkpoint: it has no weights")
    known = {field.name for field in fields(_Description)}  # others, e.g. of the pictures' viewpoints, have own readers
    said = from_plain(
        {key: value for key, value in description.items() if key in known}, _Description, source=str(file)
    )
    return Checkpoint(
        **{fact.name: getattr(said, fact.name) for fact in fields(_Facts)},
        config=from_plain(said.config, config_class(family_in(description)), source=str(file)),
        stats=Statistics(**{name: np.array(value, np.float32) for name, value in said.stats.items()}),
        empty=said.empty_below,
        continues=description["format"] == FORMAT,
        arrays=arrays,
    )
