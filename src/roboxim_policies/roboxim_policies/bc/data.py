"""Demonstrations in memory: images at the network's size, proprioception, actions, and training targets.

Images stay uint8; everything else is small. All arrays contain the steps of all episodes, one episode after another.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ACTION_SIZE, ActionSemantics
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.images import resized
from roboxim_core.proprioception import STATE_NAMES
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_policies.recorded_actions import require_semantics

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Images = npt.NDArray[np.uint8]

PROPRIO_SIZE = 6
"""Number of proprioception features that the network receives, see `proprio_features`."""
TARGET_SIZE = 5
"""Number of values that the auxiliary task predicts, see `_targets`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """One demonstrated episode of T steps."""

    images: Mapping[str, Images]
    """Camera name to uint8 images at the network's size, shape (T, side, side, 3)."""
    proprio: Floats
    """Shape (T, 10): `roboxim_core.proprioception.STATE_NAMES`."""
    actions: Floats
    """Shape (T, 7)."""
    instruction: str
    """Natural language instruction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstrations:
    """All steps of a dataset, N in total."""

    images: dict[str, Images]
    """Camera name to uint8 images, shape (N, side, side, 3)."""
    proprio: Floats
    """Network input, shape (N, `PROPRIO_SIZE`)."""
    actions: Floats
    """Shape (N, 7)."""
    ends: Ints
    """For each step, the index of its episode's last step."""
    words: Ints
    """For each step, the indices of its instruction's words, padded with 0, shape (N, longest)."""
    targets: Floats
    """For each step, the target of the auxiliary task, shape (N, `TARGET_SIZE`)."""
    vocabulary: tuple[str, ...]
    """Words of the instructions; word i has index i + 1, index 0 is padding and unknown words."""
    camera_sizes: dict[str, tuple[int, int]]
    """Camera name to (width, height) of the images before they were resized [px]."""
    semantics: ActionSemantics
    """Meaning of the actions."""
    episodes: int
    """Number of episodes."""
    robot: str = ""
    """Id of the robot model of the demonstrations; empty: unknown."""

    def __len__(self) -> int:
        """Count the steps."""
        return len(self.actions)


def split_words(instruction: str) -> list[str]:
    """Split an instruction into lower-case words."""
    return "".join(c if c.isalnum() else " " for c in instruction.lower()).split()


def word_indices(instruction: str, vocabulary: tuple[str, ...], length: int) -> Ints:
    """Return the indices of an instruction's known words, padded with 0 to a given length."""
    index = {word: i + 1 for i, word in enumerate(vocabulary)}
    known = [index[word] for word in split_words(instruction) if word in index][:length]
    return np.array(known + [0] * (length - len(known)), np.int32)


def proprio_features(proprio: Floats) -> Floats:
    """Reduce proprioception to the network's features: position, gripper opening, sine and cosine of twice the yaw.

    The angle is doubled because a parallel gripper is symmetric under half a turn.

    Args:
        proprio: Shape (..., 10): `roboxim_core.proprioception.STATE_NAMES`.

    Returns:
        Shape (..., `PROPRIO_SIZE`).
    """
    yaw = np.arctan2(proprio[..., 4], proprio[..., 3])  # of the tool's x axis
    parts = [proprio[..., :3], proprio[..., 9:10], np.sin(2 * yaw)[..., None], np.cos(2 * yaw)[..., None]]
    return np.concatenate(parts, axis=-1).astype(np.float32)


def default_sizes(cameras: Iterable[str]) -> dict[str, int]:
    """Return the default side of the network's input [px] by camera."""
    return {name: 64 if "wrist" in name else 96 for name in cameras}


def assemble(
    episodes: Iterable[Demonstration],
    *,
    camera_sizes: Mapping[str, tuple[int, int]],
    semantics: ActionSemantics,
    robot: str = "",
) -> Demonstrations:
    """Combine demonstrations.

    Args:
        episodes: At least one; all must have the same cameras.
        camera_sizes: Camera name to (width, height) before resizing [px].
        semantics: Meaning of the actions.
        robot: Id of the robot model; empty: unknown.

    Raises:
        ConfigError: When there are no episodes.
    """
    kept = [episode for episode in episodes if len(episode.actions)]
    if not kept:
        raise ConfigError("no demonstrations to train on")
    lengths = [len(episode.actions) for episode in kept]
    vocabulary = tuple(sorted({word for episode in kept for word in split_words(episode.instruction)}))
    longest = max(len(split_words(episode.instruction)) for episode in kept)
    words = [word_indices(episode.instruction, vocabulary, max(longest, 1)) for episode in kept]
    features = [proprio_features(episode.proprio) for episode in kept]
    targets = [_targets(f, e.actions) for f, e in zip(features, kept, strict=True)]
    return Demonstrations(
        images={name: np.concatenate([episode.images[name] for episode in kept]) for name in kept[0].images},
        proprio=np.concatenate(features),
        actions=np.concatenate([episode.actions for episode in kept]),
        ends=np.repeat(np.cumsum(lengths) - 1, lengths).astype(np.int32),
        words=np.repeat(np.stack(words), lengths, axis=0),
        targets=np.concatenate(targets),
        vocabulary=vocabulary,
        camera_sizes=dict(camera_sizes),
        semantics=semantics,
        episodes=len(kept),
        robot=robot,
    )


def _targets(features: Floats, actions: Floats) -> Floats:
    """Return, for each step, the gripper's pose at its next event, relative to its present pose.

    Events are the openings and closings of the gripper and the end of the episode. The gripper's pose at an event shows
    where the object is or where it goes. Predicting it from every earlier image teaches the network to look there.

    Returns:
        Position difference [m] and sine and cosine of twice the yaw at the event, shape (T, 5).
    """
    closed = actions[:, 6] < 0.5
    events = [*(np.flatnonzero(closed[1:] != closed[:-1]) + 1), len(actions) - 1]
    following = np.array([events[i] for i in np.searchsorted(events, np.arange(len(actions)))])
    position = features[following, :3] - features[:, :3]
    return np.concatenate([position, features[following, 4:6]], axis=1).astype(np.float32)


def load_demonstrations(
    path: Path,
    *,
    image_sizes: Mapping[str, int] | None = None,
    split: str = "train",
    limit: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Demonstrations:
    """Read a dataset of any registered format.

    Args:
        path: The dataset.
        image_sizes: Camera name to the side of the network's input [px]; None: `default_sizes`.
        split: ``train`` or ``val``.
        limit: Largest number of episodes to read; 0: all.
        progress: Called with (episodes read, total episodes).

    Raises:
        ConfigError: When there is no dataset, a camera or a component of the state is not in it, or episodes differ in
            their action semantics or their robot.
        InvalidRequestError: When there is no such split.
        RecorderError: When the dataset is damaged.
    """
    dataset = open_dataset(path)
    total = min(dataset.splits.get(split, 0), limit or len(dataset))
    cameras = dataset.features.cameras
    sizes = dict(image_sizes or default_sizes(cameras))
    for camera in sizes:
        if camera not in cameras:
            raise ConfigError(f"{path}: no camera '{camera}'; {one_of(cameras, camera)}")
    episodes: list[Demonstration] = []
    semantics: ActionSemantics | None = None
    robots: set[str] = set()
    for index, episode in enumerate(itertools.islice(dataset.episodes(split), total)):
        said = require_semantics(episode, path)
        if semantics is not None:
            said.require_compatible(semantics, mine=f"episode {index}", theirs="episode 0")
        semantics = said
        robots.add(episode.robot)
        episodes.append(_demonstration(episode, sizes))
        progress(index + 1, total)
    if semantics is None:
        raise ConfigError(f"{path}: split '{split}' has no episodes")
    if semantics.control.is_joint_space or semantics.dimension() != ACTION_SIZE:
        raise ConfigError(f"{path}: bc learns {ACTION_SIZE} numbers, an end-effector motion; export such actions")
    if len(robots) > 1:
        raise ConfigError(f"{path}: episodes of several robots ({', '.join(sorted(robots))}); export each robot apart")
    camera_sizes = {camera: (cameras[camera].width, cameras[camera].height) for camera in sizes}
    return assemble(episodes, camera_sizes=camera_sizes, semantics=semantics, robot=robots.pop())


def _demonstration(episode: Episode, sizes: Mapping[str, int]) -> Demonstration:
    """Read an episode, each image at the network's size."""
    state = episode.picker(STATE_NAMES)
    images: dict[str, list[Images]] = {camera: [] for camera in sizes}
    proprio, actions = [], []
    for step in episode.steps(list(sizes)):
        for camera, side in sizes.items():
            images[camera].append(resized(step.images[camera], side, side))
        proprio.append(state(step))
        actions.append(step.action)
    return Demonstration(
        images={camera: np.stack(frames) for camera, frames in images.items()},
        proprio=np.stack(proprio),
        actions=np.stack(actions),
        instruction=episode.instruction,
    )
