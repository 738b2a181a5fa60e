"""Frames of a convention: where its base and its tool axes lie, relative to RoboXim's.

RoboXim's base frame is that of the robot (x forward, y left, z up), and its tool frame is the model's tool centre point
(z out of the hand; the gripper-down pose is a turn by pi about x). A convention may name the axes otherwise, also in a
left-handed system such as Unity's (thesis, section 5.2.1), and may measure positions from another origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Vec3
from roboxim_core.rotation.representations import Floats

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Axes = tuple[str, str, str]
_UNIT = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Frames that a convention's positions, motions and rotations are expressed in."""

    base_axes: Axes = ("x", "y", "z")
    """The convention's x, y and z axis, each named by RoboXim's base axes: ``["-y", "z", "x"]`` for Unity's x right,
    y up, z forward. Motions and rotations of actions and states are expressed in these axes."""
    base_origin_m: Vec3 = (0.0, 0.0, 0.0)
    """Position of the robot's base in the convention's frame, along the convention's axes [m]: LIBERO's positions are
    measured from the middle of its table. Concerns states and absolute actions only."""
    tool_offset_m: Vec3 = (0.0, 0.0, 0.0)
    """Position of the convention's tool centre point in RoboXim's tool frame [m]: robosuite's grip site lies nearer to
    the hand. Concerns positions of states and of absolute actions."""
    tool_axes: Axes = ("x", "y", "z")
    """The x, y and z axis of the convention's tool frame, each named by RoboXim's tool axes. Concerns absolute
    rotations, and actions in the tool's frame."""

    def __post_init__(self) -> None:
        """Check the axes.

        Raises:
            InvalidRequestError: On axes that are not three different ones of x, y, z with signs, or on a left-handed
                tool frame in a right-handed base frame, in which no rotation has a meaning.
        """
        for name in ("base_axes", "tool_axes"):
            axes = getattr(self, name)
            if len(axes) != 3 or sorted(axis.removeprefix("-") for axis in axes) != ["x", "y", "z"]:
                raise InvalidRequestError(
                    f"{name} must name x, y and z once each, with or without a minus, e.g. [y, -x, z]; got {list(axes)}"
                )
        limits.require_finite("base_origin_m", self.base_origin_m, limits.LENGTH_M)
        limits.require_finite("tool_offset_m", self.tool_offset_m, limits.LENGTH_M)
        if round(float(np.linalg.det(self.base_matrix) * np.linalg.det(self.tool_matrix))) != 1:
            raise InvalidRequestError(
                "base_axes and tool_axes must both be right-handed or both be left-handed, "
                f"got {list(self.base_axes)} and {list(self.tool_axes)}"
            )

    @cached_property
    def base_matrix(self) -> Floats:
        """The convention's base axes in RoboXim's base frame, as columns, shape (3, 3)."""
        return _columns(self.base_axes)

    @cached_property
    def tool_matrix(self) -> Floats:
        """The convention's tool axes in RoboXim's tool frame, as columns, shape (3, 3)."""
        return _columns(self.tool_axes)

    @property
    def is_plain(self) -> bool:
        """Whether the axes are RoboXim's own."""
        return self.base_axes == self.tool_axes == ("x", "y", "z")

    def vectors_in(self, vectors: Floats, *, tool: bool = False) -> Floats:
        """Convert motions, shape (n, 3), from the convention's axes to RoboXim's base, or tool, axes."""
        return np.asarray(vectors @ (self.tool_matrix if tool else self.base_matrix).T)

    def vectors_out(self, vectors: Floats, *, tool: bool = False) -> Floats:
        """Convert motions, shape (n, 3), from RoboXim's base, or tool, axes to the convention's."""
        return np.asarray(vectors @ (self.tool_matrix if tool else self.base_matrix))

    def positions_in(self, positions: Floats) -> Floats:
        """Convert positions, shape (n, 3), from the convention's frame to RoboXim's base [m]."""
        return self.vectors_in(positions - np.array(self.base_origin_m))

    def positions_out(self, positions: Floats) -> Floats:
        """Convert positions, shape (n, 3), from RoboXim's base to the convention's frame [m]."""
        return np.asarray(self.vectors_out(positions) + np.array(self.base_origin_m))

    def turns_in(self, rotations: Rotation, *, tool: bool = False) -> Rotation:
        """Convert rotation deltas from the convention's axes to RoboXim's base, or tool, axes."""
        from scipy.spatial.transform import Rotation

        matrix = self.tool_matrix if tool else self.base_matrix
        return rotations if self.is_plain else Rotation.from_matrix(matrix @ rotations.as_matrix() @ matrix.T)

    def turns_out(self, rotations: Rotation, *, tool: bool = False) -> Rotation:
        """Convert rotation deltas from RoboXim's base, or tool, axes to the convention's."""
        from scipy.spatial.transform import Rotation

        matrix = self.tool_matrix if tool else self.base_matrix
        return rotations if self.is_plain else Rotation.from_matrix(matrix.T @ rotations.as_matrix() @ matrix)

    def orientations_in(self, rotations: Rotation) -> Rotation:
        """Convert rotations of the tool in the base from the convention's frames to RoboXim's."""
        from scipy.spatial.transform import Rotation

        if self.is_plain:
            return rotations
        return Rotation.from_matrix(self.base_matrix @ rotations.as_matrix() @ self.tool_matrix.T)

    def orientations_out(self, rotations: Rotation) -> Rotation:
        """Convert rotations of the tool in the base from RoboXim's frames to the convention's."""
        from scipy.spatial.transform import Rotation

        if self.is_plain:
            return rotations
        return Rotation.from_matrix(self.base_matrix.T @ rotations.as_matrix() @ self.tool_matrix)


def _columns(axes: Axes) -> Floats:
    columns = [np.array(_UNIT[axis.removeprefix("-")]) * (-1.0 if axis.startswith("-") else 1.0) for axis in axes]
    return np.stack(columns, axis=1)
