"""Inputs of the network that are no images: words, proprioception, and the memory of the grasp.

A single observation does not show how far a held object was turned, how high it was lifted, or whether it was put down
already. `GraspMemory` therefore keeps the robot's own measurements at the policy's last command to close the gripper.
Training computes the same features for every step of a demonstration (`grasps_of`, `state_features`). What counts as a
grasp is stated once, in `GraspRule`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

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
"""Height that the tool gains after the gripper closed on nothing, before the policy tries again [m]. At this height the
object is in view, as in the approach of the demonstrations."""
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


def up_in_tool(proprio: Floats) -> Floats:
    """Return the base's z axis in the tool's frame, shape (..., 3), from proprioception of shape (..., 10)."""
    x, y = proprio[..., 3:6], proprio[..., 6:9]
    return np.stack([x[..., 2], y[..., 2], np.cross(x, y)[..., 2]], axis=-1).astype(np.float32)


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
        failed: Whether the gripper closed on nothing and has not risen since, shape (N,).

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


class Grasp(NamedTuple):
    """What the gripper has done up to an observation of an episode."""

    begin: int
    """Index of the observation with which the latest grasp began; `NONE` before, or once the gripper is empty."""
    least_opening: float
    """Smallest opening since then; the present one without a grasp."""
    released: bool
    """Whether the action before the observation opens the gripper or keeps it open."""
    failed: bool
    """Whether the gripper closed on nothing and has not risen by `RETRY_M` since."""


class GraspRule:
    """The rule by which grasps begin, end and fail in one episode, for training and policy alike.

    Non-obvious:
    - A grasp begins with the command to close, not with a measured opening: the gripper may be opened by as little as
      some objects are wide, and a policy that believes it holds something carries nothing to its goal.
    """

    def __init__(self, empty: float) -> None:
        """Begin an episode.

        Args:
            empty: Opening below which a closed gripper is empty.
        """
        self._empty = empty
        self._seen = 0
        self._was_closing = False
        self._begin, self._least_opening = NONE, math.inf
        self._lowest: float | None = None

    def observe(self, opening: float, height: float, *, closing: bool) -> Grasp:
        """Update with an observation.

        Args:
            opening: Measured opening.
            height: Height of the tool [m].
            closing: Whether the action before the observation closes the gripper or keeps it closed.
        """
        if opening < self._empty:
            self._begin = NONE
        elif closing and not self._was_closing:
            self._begin, self._least_opening = self._seen, opening
        self._was_closing = closing
        self._seen += 1
        self._least_opening = opening if self._begin == NONE else min(self._least_opening, opening)
        self._lowest = _lowest_since_failure(self._lowest, opening, height, self._empty)
        return Grasp(self._begin, self._least_opening, not closing, self._lowest is not None)


def _lowest_since_failure(lowest: float | None, opening: float, height: float, empty: float) -> float | None:
    """Return the tool's lowest height since the gripper closed on nothing [m]; none: it did not, or has risen since."""
    if opening < empty:
        return height if lowest is None else min(lowest, height)
    return None if lowest is None or height - lowest >= RETRY_M else min(lowest, height)


def grasps_of(openings: Floats, heights: Floats, closed: Flags, empty: float) -> tuple[Ints, Floats, Flags, Flags]:
    """Return what the gripper has done up to each step of an episode: the fields of `Grasp` as arrays of shape (T,).

    Args:
        openings: Measured openings, shape (T,).
        heights: Heights of the tool [m], shape (T,).
        closed: Whether the action of a step closes the gripper or keeps it closed, shape (T,).
        empty: Opening below which a closed gripper is empty.
    """
    rule, closing = GraspRule(empty), [False, *closed[:-1].tolist()]
    steps = zip(openings.tolist(), heights.tolist(), closing, strict=True)
    begin, least_opening, released, failed = zip(*(rule.observe(o, h, closing=c) for o, h, c in steps), strict=True)
    return np.array(begin, np.int32), np.array(least_opening, openings.dtype), np.array(released), np.array(failed)


class GraspMemory:
    """The memory of one episode at test time, updated with each observation.

    Non-obvious:
    - The policy does not see every tick, so a grasp is noticed up to ``execute`` - 1 ticks after it began. Training
      draws such delays.
    """

    def __init__(self, empty: float) -> None:
        """Begin an episode.

        Args:
            empty: Opening below which a closed gripper is empty.
        """
        self._rule = GraspRule(empty)
        self._closing = False
        self._begin, self._begin_position, self._begin_yaw = NONE, np.zeros(3, np.float32), 0.0

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
        grasp = self._rule.observe(opening, float(position[2]), closing=self._closing)
        if grasp.begin == NONE:
            nothing = np.zeros(MEMORY_SIZE, np.float32)
            nothing[-1] = grasp.failed
            return nothing
        if grasp.begin != self._begin:
            self._begin, self._begin_position, self._begin_yaw = grasp.begin, position, yaw
        heading = np.array([np.cos(yaw), np.sin(yaw)], np.float32)
        moved, turned = position - self._begin_position, np.float32(yaw - self._begin_yaw)
        opened = np.float32(opening - grasp.least_opening)
        features = memory_features(
            moved, heading, turned, opened, np.bool_(grasp.released), np.True_, np.bool_(grasp.failed)
        )
        return np.asarray(features, np.float32)
