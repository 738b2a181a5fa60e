"""Inputs of the network that are no images: words, proprioception, and the memory of the grasp.

A single observation does not say how far a held object was turned, how high it was lifted, or that it was put down
already. `GraspMemory` therefore keeps the robot's own measurements at the policy's last command to close the gripper.
Training computes the same features for every step of a demonstration (`grasp_starts`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

PROPRIO_SIZE = 8
"""Number of proprioception features, see `proprio_features`."""
MEMORY_SIZE = 11
"""Number of features of the memory, see `memory_features`."""
STATE_SIZE = PROPRIO_SIZE + MEMORY_SIZE
"""Number of state features that the network receives."""
RETRY_M = 0.08
"""Height that the tool gains after the gripper closed on nothing, before the policy tries again [m]. From there the
object is in view, as it is when the demonstrations approach it."""
NONE = -1
"""Index of a step that does not exist."""


def split_words(instruction: str) -> list[str]:
    """Split an instruction into lower-case words."""
    return "".join(c if c.isalnum() else " " for c in instruction.lower()).split()


def word_indices(instruction: str, vocabulary: tuple[str, ...], length: int) -> Ints:
    """Return the indices of an instruction's known words, padded with 0 to a given length."""
    index = {word: i + 1 for i, word in enumerate(vocabulary)}
    known = [index[word] for word in split_words(instruction) if word in index][:length]
    return np.array(known + [0] * (length - len(known)), np.int32)


def tool_yaw(proprio: Floats) -> Floats:
    """Return the tool's rotation about the base's z axis [rad], from proprioception of shape (..., 10)."""
    return np.arctan2(proprio[..., 4], proprio[..., 3])  # of the tool's x axis


def proprio_features(proprio: Floats) -> Floats:
    """Reduce proprioception to features: position, gripper opening, sine and cosine of twice the yaw, and tilt.

    The angle is doubled because a parallel gripper is symmetric under half a turn. The tilt is the horizontal part of
    the tool's z axis.

    Args:
        proprio: Shape (..., 10): `roboxim_core.proprioception.STATE_NAMES`.

    Returns:
        Shape (..., `PROPRIO_SIZE`).
    """
    yaw = tool_yaw(proprio)
    tilt = np.cross(proprio[..., 3:6], proprio[..., 6:9])[..., :2]
    parts = [proprio[..., :3], proprio[..., 9:10], np.sin(2 * yaw)[..., None], np.cos(2 * yaw)[..., None], tilt]
    return np.concatenate(parts, axis=-1).astype(np.float32)


def memory_features(
    moved: Any, heading: Any, turned: Any, opened: Any, released: Any, grasped: Any, failed: Any, xp: Any = np
) -> Any:
    """Return the features of the memory: what changed since the gripper closed.

    Args:
        moved: Displacement of the tool in the base [m], shape (..., 3).
        heading: Cosine and sine of the tool's yaw, shape (..., 2).
        turned: Change of the yaw [rad], shape (...).
        opened: Opening of the gripper beyond its smallest one since then, shape (...).
        released: Whether the last action opened the gripper again, shape (...).
        grasped: Whether it has closed on something, shape (...); where it is False, the features so far are 0.
        failed: Whether it has closed on nothing and has not risen by `RETRY_M` since, shape (...).
        xp: Module with NumPy's functions: NumPy, or JAX's.

    Returns:
        Shape (..., `MEMORY_SIZE`).
    """
    cos, sin = heading[..., 0], heading[..., 1]
    ahead, aside = cos * moved[..., 0] + sin * moved[..., 1], cos * moved[..., 1] - sin * moved[..., 0]
    columns = [*(moved[..., i] for i in range(3)), ahead, aside, xp.sin(turned), xp.cos(turned), opened]
    columns.append(xp.asarray(released, xp.float32))
    held = xp.asarray(grasped, xp.float32)
    return xp.stack([held, *(held * column for column in columns), xp.asarray(failed, xp.float32)], axis=-1)


def state_features(
    proprio: Floats, yaw: Floats, grasps: Ints, least_opening: Floats, released: Flags, failed: Flags
) -> Floats:
    """Return the state features of all steps of a dataset, with a memory that notices each grasp at once.

    Args:
        proprio: Features, shape (N, `PROPRIO_SIZE`).
        yaw: Tool's yaw [rad], shape (N,).
        grasps: First step of the latest grasp, or `NONE`, shape (N,).
        least_opening: Smallest opening since then, shape (N,).
        released: Whether the action before a step opens the gripper or keeps it open, shape (N,).
        failed: See `failures`, shape (N,).

    Returns:
        Shape (N, `STATE_SIZE`).
    """
    begin = np.maximum(grasps, 0)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    moved, opened = proprio[:, :3] - proprio[begin, :3], proprio[:, 3] - least_opening
    memory = memory_features(moved, heading, yaw - yaw[begin], opened, released, grasps != NONE, failed)
    return np.concatenate([proprio, memory], axis=-1).astype(np.float32)


def empty_below(openings: Floats, closed: Flags, starts: Flags) -> float:
    """Return the opening below which a closed gripper is empty, measured on demonstrations; 0 if none holds anything.

    Args:
        openings: Measured openings of all steps, shape (N,).
        closed: Whether the action of a step closes the gripper or keeps it closed, shape (N,).
        starts: Whether a step is the first one of its episode, shape (N,).
    """
    before = np.concatenate([[False], closed[:-1]]) & ~starts
    held = openings[before & np.concatenate([[False], before[:-1]]) & closed]  # the fingers have arrived
    return 0.5 * float(held.min()) if len(held) else 0.0


def grasp_starts(openings: Floats, closed: Flags, empty: float) -> Ints:
    """Return, for each step of an episode, the first step of its latest grasp; `NONE` before, or once it is empty.

    Args:
        openings: Measured openings, shape (T,).
        closed: Whether the action of a step closes the gripper or keeps it closed, shape (T,).
        empty: Opening below which a closed gripper is empty.
    """
    starts = np.full(len(openings), NONE, np.int32)
    current, was_closing = NONE, False
    for step, opening in enumerate(openings.tolist()):
        closing = step > 0 and bool(closed[step - 1])
        if opening < empty:
            current = NONE
        elif closing and not was_closing:
            current = step
        was_closing = closing
        starts[step] = current
    return starts


def failures(openings: Floats, heights: Floats, empty: float) -> Flags:
    """Return, for each step of an episode, whether the gripper closed on nothing and has not risen by `RETRY_M` since.

    Args:
        openings: Measured openings, shape (T,).
        heights: Heights of the tool [m], shape (T,).
        empty: Opening below which a closed gripper is empty.
    """
    found = np.zeros(len(openings), np.bool_)
    lowest: float | None = None
    for step, (opening, height) in enumerate(zip(openings.tolist(), heights.tolist(), strict=True)):
        lowest = _lowest_since_failure(lowest, opening, height, empty)
        found[step] = lowest is not None
    return found


def _lowest_since_failure(lowest: float | None, opening: float, height: float, empty: float) -> float | None:
    """Return the tool's lowest height since the gripper closed on nothing [m]; none: it did not, or has risen since."""
    if opening < empty:
        return height if lowest is None else min(lowest, height)
    return None if lowest is None or height - lowest >= RETRY_M else min(lowest, height)


class GraspMemory:
    """The memory of one episode at test time, updated with each observation.

    Non-obvious:
    - A grasp begins with the policy's own command to close, not with a measured opening: the gripper may be opened by
      as little as some objects are wide, and a policy that believes to hold something carries nothing to its goal.
    - The policy does not see every tick, so a grasp is noticed up to ``execute`` - 1 ticks after it began. Training
      draws such delays.
    """

    def __init__(self, empty: float) -> None:
        """Begin an episode.

        Args:
            empty: Opening below which a closed gripper is empty.
        """
        self._empty = empty
        self._pose: tuple[Floats, float, float] | None = None
        self._closing = self._was_closing = False
        self._lowest: float | None = None

    def commanded(self, closed: bool) -> None:
        """Note whether the last action that is executed before the next observation closes the gripper."""
        self._closing = closed

    def observe(self, proprio: Floats) -> Floats:
        """Update with an observation and return the features.

        Args:
            proprio: Shape (10,): `roboxim_core.proprioception.STATE_NAMES`.

        Returns:
            Shape (`MEMORY_SIZE`,).
        """
        position, yaw, opening = proprio[:3], float(tool_yaw(proprio)), float(proprio[9])
        if opening < self._empty:
            self._pose = None
        elif self._closing and not self._was_closing:
            self._pose = position, yaw, opening
        self._was_closing = self._closing
        self._lowest = _lowest_since_failure(self._lowest, opening, float(position[2]), self._empty)
        heading = np.array([np.cos(yaw), np.sin(yaw)], np.float32)
        if self._pose is None:
            nothing = np.zeros(MEMORY_SIZE, np.float32)
            nothing[-1] = self._lowest is not None
            return nothing
        begin, begin_yaw, least = self._pose
        self._pose = begin, begin_yaw, min(least, opening)
        opened = np.float32(opening - self._pose[2])
        turned, released = np.float32(yaw - begin_yaw), np.bool_(not self._closing)
        failed = np.bool_(self._lowest is not None)
        features = memory_features(position - begin, heading, turned, opened, released, np.True_, failed)
        return np.asarray(features, np.float32)
