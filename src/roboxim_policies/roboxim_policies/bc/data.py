"""Demonstrations in memory: images at the network's size, proprioception, actions, and training targets.

Images stay uint8; everything else is small. All arrays contain the steps of all episodes, one episode after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.documents import parse_json
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.images import resized
from roboxim_datasets.rlds import RldsEpisode, RldsReader
from roboxim_policies.recorded_actions import rlds_semantics

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Images = npt.NDArray[np.uint8]

IMAGE_KEYS = {"image": "workspace", "wrist_image": "wrist"}
"""Image key of an export to camera name, for exports that do not name the camera."""
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


def load_rlds(
    path: Path,
    *,
    image_sizes: Mapping[str, int] | None = None,
    split: str = "train",
    limit: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Demonstrations:
    """Read an RLDS export.

    Args:
        path: Folder of the export.
        image_sizes: Camera name to the side of the network's input [px]; None: `default_sizes`.
        split: ``train`` or ``val``.
        limit: Largest number of episodes to read; 0: all.
        progress: Called with (episodes read, total episodes).

    Raises:
        ConfigError: When a camera is not in the export, or episodes differ in their action semantics or their robot.
        RecorderError: When the export is missing or damaged.
    """
    reader = RldsReader(path)
    total = min(reader.count(split), limit or reader.count(split))
    episodes: list[Demonstration] = []
    semantics: ActionSemantics | None = None
    robots: set[str] = set()
    for index, episode in enumerate(reader.episodes(split)):
        if index == total:
            break
        cameras = _cameras(episode)
        sizes = dict(image_sizes or default_sizes(cameras))
        for camera in sizes:
            if camera not in cameras:
                raise ConfigError(f"{path}: no camera '{camera}'; {one_of(cameras, camera)}")
        said = rlds_semantics(episode)
        if semantics is not None:
            said.require_compatible(semantics, mine=f"episode {index}", theirs="episode 0")
        semantics = said
        robots.add(str(episode.metadata.get("robot", "")))
        episodes.append(
            Demonstration(
                images={camera: _frames(episode, cameras[camera], side) for camera, side in sizes.items()},
                proprio=episode.state,
                actions=episode.action,
                instruction=episode.instruction,
            )
        )
        progress(index + 1, total)
    if semantics is None:
        raise ConfigError(f"{path}: split '{split}' has no episodes")
    if len(robots) > 1:
        raise ConfigError(f"{path}: episodes of several robots ({', '.join(sorted(robots))}); export each robot apart")
    camera_sizes = {
        camera: (reader.features.images[cameras[camera]][1], reader.features.images[cameras[camera]][0])
        for camera in sizes
    }
    return assemble(episodes, camera_sizes=camera_sizes, semantics=semantics, robot=robots.pop())


def _cameras(episode: RldsEpisode) -> dict[str, str]:
    """Return camera name to image key, as named in the export or else by the usual names."""
    said = episode.metadata.get("cameras")
    names = parse_json(said, source="episode_metadata/cameras") if isinstance(said, str) else {}
    if not isinstance(names, dict):
        raise ConfigError(f"episode_metadata/cameras is a {type(names).__name__}, expected a JSON object")
    return {str(names.get(key, IMAGE_KEYS.get(key, key))): key for key in episode.images}


def _frames(episode: RldsEpisode, key: str, side: int) -> Images:
    return np.stack([resized(episode.frame(key, step), side, side) for step in range(len(episode))])
