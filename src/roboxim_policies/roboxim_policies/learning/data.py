"""Demonstrations: images at the network's size, proprioception, actions, and training targets.

Images stay uint8, and those that were read from a dataset are mapped from a file; everything else is small. All arrays
contain the steps of all episodes, one episode after another. Targets that only training can know (the gripper's pose at
its next event, the time until then) come from the later steps of the same demonstration.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ACTION_SIZE, ActionSemantics, ControlMode, GripperConvention, ReferenceFrame
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.proprioception import STATE_NAMES
from roboxim_core.user_folders import cache_dir
from roboxim_core.vision.images import resized
from roboxim_datasets.episode import BETWEEN_ROBOTS, Episode
from roboxim_datasets.formats import open_dataset
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.features import (
    NONE,
    Flags,
    Floats,
    Ints,
    empty_below,
    grasps_of,
    proprio_features,
    split_words,
    tool_yaw,
    up_in_tool,
    word_indices,
)
from roboxim_policies.recorded_actions import require_semantics

Images = npt.NDArray[np.uint8]

TARGET_SIZE = 7
"""Number of values that the auxiliary task predicts, see `_targets`."""
CLOSED_BELOW = 0.25
"""Commanded opening below which an action closes the gripper. The expert closes to 0, and opens as far as needed."""


UP = np.array([0.0, 0.0, 1.0], np.float32)
"""Upward direction in the base."""


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
    """Network input, shape (N, `features.PROPRIO_SIZE`)."""
    yaw: Floats
    """Tool's rotation about the base's z axis [rad], shape (N,)."""
    up: Floats
    """Upward direction in the frame of the actions' motions, shape (N, 3)."""
    actions: Floats
    """Shape (N, 7)."""
    ends: Ints
    """For each step, the index of its episode's last step."""
    keys: npt.NDArray[np.uint64]
    """For each step, a random number that follows from its demonstration's content and its place in it alone."""
    grasps: Ints
    """For each step, the index of the first step of its latest grasp; `features.NONE`: none yet."""
    least_opening: Floats
    """For each step, the smallest opening of the gripper since that grasp began, shape (N,)."""
    released: Flags
    """For each step, whether the action before it opens the gripper or keeps it open, shape (N,)."""
    failed: Flags
    """For each step, whether the gripper closed on nothing and has not risen since, see `features.Grasp`."""
    empty: float
    """Opening of the gripper below which it is closed and empty."""
    words: Ints
    """For each step, the indices of its instruction's words, padded with 0, shape (N, longest)."""
    targets: Floats
    """For each step, the target of the auxiliary task, shape (N, `TARGET_SIZE`)."""
    instructions: tuple[str, ...]
    """The different instructions."""
    instruction: Ints
    """For each step, the number of its instruction, shape (N,)."""
    vocabulary: tuple[str, ...]
    """Words of the instructions; word i has index i + 1, index 0 is padding and unknown words."""
    camera_sizes: dict[str, tuple[int, int]]
    """Camera name to (width, height) of the images before they were resized [px]."""
    semantics: ActionSemantics
    """Meaning of the actions."""
    episodes: int
    """Number of episodes."""
    robot: str = ""
    """Id of the robot model of the demonstrations, or of several (`BETWEEN_ROBOTS`); empty: unknown."""
    camera_views: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Camera to the files of ``config/cameras`` that define its viewpoints; a camera that is missing: unknown."""

    def __len__(self) -> int:
        """Count the steps."""
        return len(self.actions)

    @property
    def starts(self) -> Ints:
        """For each step, the index of its episode's first step."""
        firsts = np.concatenate([[0], np.unique(self.ends)[:-1] + 1]).astype(np.int32)
        return firsts[np.searchsorted(np.unique(self.ends), self.ends)]


def assemble(
    episodes: Iterable[Demonstration],
    *,
    camera_sizes: Mapping[str, tuple[int, int]],
    semantics: ActionSemantics,
    robot: str = "",
    like: Demonstrations | None = None,
    camera_views: Mapping[str, tuple[str, ...]] | None = None,
    images: Mapping[str, Images] | None = None,
) -> Demonstrations:
    """Combine demonstrations.

    Args:
        episodes: At least one; all must have the same cameras.
        camera_sizes: Camera name to (width, height) before resizing [px].
        semantics: Meaning of the actions.
        robot: Id of the robot model; empty: unknown.
        like: Demonstrations that give the vocabulary and the opening of an empty gripper, to validate a network that
            was trained on them. None: both are measured.
        camera_views: See `Demonstrations`; None: unknown.
        images: The images of all episodes, one episode after another, if they exist in this form; None: they are
            copied together.

    Raises:
        ConfigError: When there are no episodes.
    """
    kept = [episode for episode in episodes if len(episode.actions)]
    if not kept:
        raise ConfigError("no demonstrations to train on")
    lengths = [len(episode.actions) for episode in kept]
    vocabulary = tuple(sorted({word for episode in kept for word in split_words(episode.instruction)}))
    longest = max(1, *(len(split_words(episode.instruction)) for episode in kept))
    if like is not None:
        vocabulary, longest = like.vocabulary, like.words.shape[1]
    instructions = sorted({episode.instruction for episode in kept})
    indices = np.array([instructions.index(episode.instruction) for episode in kept], np.int32)
    words = [word_indices(episode.instruction, vocabulary, longest) for episode in kept]
    proprio = np.concatenate([episode.proprio for episode in kept])
    actions = np.concatenate([episode.actions for episode in kept])
    firsts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    starts = np.isin(np.arange(len(actions)), firsts)
    empty = like.empty if like is not None else empty_below(proprio[:, 9], actions[:, 6] < CLOSED_BELOW, starts)
    grasps, least_opening, released, failed = zip(
        *(grasps_of(e.proprio[:, 9], e.proprio[:, 2], e.actions[:, 6] < CLOSED_BELOW, empty) for e in kept), strict=True
    )
    return Demonstrations(
        images=dict(images or {n: np.concatenate([episode.images[n] for episode in kept]) for n in kept[0].images}),
        proprio=proprio_features(proprio),
        yaw=tool_yaw(proprio),
        up=up_in_tool(proprio) if semantics.frame is ReferenceFrame.TOOL else np.tile(UP, (len(actions), 1)),
        actions=actions,
        ends=np.repeat(np.cumsum(lengths) - 1, lengths).astype(np.int32),
        keys=_keys(kept),
        grasps=np.concatenate([np.where(g == NONE, NONE, g + at) for g, at in zip(grasps, firsts, strict=True)]),
        least_opening=np.concatenate(least_opening),
        released=np.concatenate(released),
        failed=np.concatenate(failed),
        empty=empty,
        words=np.repeat(np.stack(words), lengths, axis=0),
        targets=np.concatenate([_targets(episode.proprio, episode.actions) for episode in kept]),
        instructions=tuple(instructions),
        instruction=np.repeat(indices, lengths),
        vocabulary=vocabulary,
        camera_sizes=dict(camera_sizes),
        semantics=semantics,
        episodes=len(kept),
        robot=robot,
        camera_views=dict(camera_views or {}),
    )


def _keys(episodes: Iterable[Demonstration]) -> npt.NDArray[np.uint64]:
    """Return `Demonstrations.keys`; a demonstration that occurs again has other ones each time."""
    seen: Counter[bytes] = Counter()
    keys = []
    for episode in episodes:
        content = hashlib.blake2b(episode.instruction.encode(), digest_size=16)
        for array in (episode.proprio, episode.actions, *(images[0] for _, images in sorted(episode.images.items()))):
            content.update(np.ascontiguousarray(array).data)
        name = content.digest()
        rng = np.random.default_rng([int.from_bytes(name, "little"), seen[name]])
        seen[name] += 1
        keys.append(rng.integers(0, 2**64, len(episode.actions), dtype=np.uint64))
    return np.concatenate(keys)


def _targets(proprio: Floats, actions: Floats) -> Floats:
    """Return, for each step, the gripper's pose at its next event, relative to its present pose, and the time until it.

    Events are the closings and openings of the gripper and the end of the episode. The gripper's pose at an event shows
    where the object is or where it goes. Predicting it from every earlier image teaches the network to look there.

    Returns:
        Position difference in the base [m], change of the yaw [rad], sine and cosine of twice that change, logarithm of
        1 + ticks; shape (T, `TARGET_SIZE`).
    """
    closed = actions[:, 6] < CLOSED_BELOW
    steps = np.arange(len(actions))
    events = np.array([*(np.flatnonzero(closed[1:] != closed[:-1]) + 1), len(actions) - 1])
    following = events[np.searchsorted(events, steps)]
    position = proprio[following, :3] - proprio[:, :3]
    yaw = np.unwrap(tool_yaw(proprio))
    turn = yaw[following] - yaw
    columns = [turn, np.sin(2 * turn), np.cos(2 * turn), np.log1p(following - steps)]
    return np.concatenate([position, np.stack(columns, axis=1)], axis=1).astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """Demonstrations as they were read from a dataset."""

    episodes: list[Demonstration]
    """The episodes."""
    camera_sizes: dict[str, tuple[int, int]]
    """Camera name to (width, height) of the dataset's images [px]."""
    semantics: ActionSemantics
    """Meaning of the actions."""
    robot: str
    """Id of the robot model, or of several (`BETWEEN_ROBOTS`); empty: unknown."""
    camera_views: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """See `Demonstrations`."""
    images: dict[str, Images] = field(default_factory=dict)
    """Camera name to the images of all episodes, one episode after another, of which the episodes have views."""

    def assemble(self) -> Demonstrations:
        """Combine all episodes."""
        return self._assembled(self.episodes, images=self.images)

    def split(self, held_out: int, seed: int) -> tuple[Demonstrations, Demonstrations | None]:
        """Combine the episodes to train on, and those to hold out.

        Args:
            held_out: Number of episodes to hold out, drawn at random; 0: none.
            seed: Seed of the draw.

        Raises:
            ConfigError: When none would be left.
        """
        if not held_out:
            return self.assemble(), None
        if held_out >= len(self.episodes):
            raise ConfigError(f"held_out is {held_out}, and there are {len(self.episodes)} demonstrations in all")
        drawn = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,))).permutation(len(self.episodes))
        out = set(drawn[:held_out].tolist())
        train = self._assembled([episode for i, episode in enumerate(self.episodes) if i not in out])
        return train, self._assembled([self.episodes[i] for i in sorted(out)], like=train)

    def _assembled(
        self, episodes: list[Demonstration], like: Demonstrations | None = None,
        images: Mapping[str, Images] | None = None,
    ) -> Demonstrations:  # fmt: skip
        return assemble(
            episodes, camera_sizes=self.camera_sizes, semantics=self.semantics, robot=self.robot, like=like,
            camera_views=self.camera_views, images=images,
        )  # fmt: skip


def read_demonstrations(
    path: Path,
    *,
    image_sizes: Mapping[str, int] | None = None,
    side_of: Callable[[str], int] | None = None,
    limit: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Reading:
    """Read the split ``train`` of a dataset of any registered format.

    The images go to a file without a name in the user's cache and are mapped from there: they take disk space while
    the result is used, and memory only as far as the kernel has some to spare.

    Args:
        path: The dataset.
        image_sizes: Camera name to the side of the network's input [px]; None: all cameras.
        side_of: Camera name to its side, where ``image_sizes`` is None; None: as `LearningConfig.side_of`.
        limit: Largest number of episodes to read; 0: all.
        progress: Called with (episodes read, total episodes).

    Raises:
        ConfigError: When there is no dataset, a camera or a component of the state is not in it, episodes differ in
            their action semantics, one has no steps, or a number is not finite.
        InvalidRequestError: When there is no such split.
        OSError: When the disk is full.
        RecorderError: When the dataset is damaged.
    """
    dataset = open_dataset(path)
    total = min(dataset.splits.get("train", 0), limit or len(dataset))
    cameras = dataset.features.cameras
    default = side_of or LearningConfig().side_of
    sizes = dict(image_sizes or {camera: default(camera) for camera in cameras})
    for camera in sizes:
        if camera not in cameras:
            raise ConfigError(f"{path}: no camera '{camera}'; {one_of(cameras, camera)}")
    episodes: list[Demonstration] = []
    semantics: ActionSemantics | None = None
    robots: set[str] = set()
    views: dict[str, set[str]] = {camera: set() for camera in sizes}
    files = {camera: _ImageFile(side) for camera, side in sizes.items()}
    for index, episode in enumerate(itertools.islice(dataset.episodes("train"), total)):
        declared = require_semantics(episode, path)
        if semantics is not None:
            declared.require_compatible(semantics, owner=f"episode {index}", other_owner="episode 0")
        semantics = declared
        robots.add(episode.robot)
        for camera, seen in views.items():
            seen.add(_view(episode, camera))
        read = _demonstration(episode, sizes, f"{path}: episode {index} of split 'train'")
        for camera, file in files.items():
            file.append(read.images[camera])
        episodes.append(replace(read, images={}))
        progress(index + 1, total)
    if semantics is None:
        raise ConfigError(f"{path}: split 'train' has no episodes")
    if semantics.control is not ControlMode.END_EFFECTOR_DELTA or semantics.dimension() != ACTION_SIZE:
        raise ConfigError(
            f"{path}: its actions are {semantics.control} of {semantics.dimension()} numbers; it learns "
            f"{ControlMode.END_EFFECTOR_DELTA} of {ACTION_SIZE}, a motion of the end effector; export such actions"
        )
    if semantics.gripper is not GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0:
        raise ConfigError(f"{path}: it learns grippers with 1 = open and 0 = closed; export such actions")
    camera_sizes = {camera: (cameras[camera].width, cameras[camera].height) for camera in sizes}
    images = {camera: file.mapped() for camera, file in files.items()}
    end = 0
    for index, demonstration in enumerate(episodes):
        begin, end = end, end + len(demonstration.actions)
        own = {camera: pictures[begin:end] for camera, pictures in images.items()}
        episodes[index] = replace(demonstration, images=own)
    return Reading(
        episodes=episodes, camera_sizes=camera_sizes, semantics=semantics, robot=BETWEEN_ROBOTS.join(sorted(robots)),
        images=images, camera_views={camera: tuple(sorted(seen)) for camera, seen in views.items() if "" not in seen},
    )  # fmt: skip


class _ImageFile:
    """Images of one camera in a file without a name, which ends with the last array that is mapped from it."""

    def __init__(self, side: int) -> None:
        cache_dir().mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=cache_dir())  # noqa: SIM115 - lives as long as the arrays mapped from it
        self._shape, self._count = (side, side, 3), 0

    def append(self, images: Images) -> None:
        """Add images of shape (T, side, side, 3)."""
        self._file.write(np.ascontiguousarray(images).data)
        self._count += len(images)

    def mapped(self) -> Images:
        """Return all images, shape (N, side, side, 3), read-only."""
        self._file.flush()
        return np.memmap(self._file, np.uint8, "r", shape=(self._count, *self._shape))


def _view(episode: Episode, camera: str) -> str:
    """Return the file of ``config/cameras`` from whose place a camera saw; empty: the dataset does not say."""
    try:
        drawn = json.loads(str(episode.metadata["task"]))["drawn"]
        return str(drawn.get(f"camera.{camera}", camera))
    except (KeyError, TypeError, ValueError, AttributeError):  # the dataset of another tool
        return ""


def _require_finite(demonstration: Demonstration, where: str) -> None:
    for what, rows in (("action", demonstration.actions), ("proprioception", demonstration.proprio)):
        wrong = np.argwhere(~np.isfinite(rows))
        if len(wrong):
            step, component = wrong[0].tolist()
            raise ConfigError(
                f"{where}: component {component} of the {what} of step {step} is {rows[step, component]}; repair the "
                "dataset, or export it without this episode"
            )


def _demonstration(episode: Episode, sizes: Mapping[str, int], where: str) -> Demonstration:
    """Read an episode, each image at the network's size.

    Raises:
        ConfigError: When it has no steps, or a number is not finite.
    """
    state = episode.picker(STATE_NAMES)
    images: dict[str, list[Images]] = {camera: [] for camera in sizes}
    proprio, actions = [], []
    for step in episode.steps(list(sizes)):
        for camera, side in sizes.items():
            images[camera].append(resized(step.images[camera], side, side))
        proprio.append(state(step))
        actions.append(step.action)
    if not actions:
        raise ConfigError(f"{where} has no steps; export the dataset without it")
    read = Demonstration(
        images={camera: np.stack(frames) for camera, frames in images.items()},
        proprio=np.stack(proprio),
        actions=np.stack(actions),
        instruction=episode.instruction,
    )
    _require_finite(read, where)
    return read
