"""The policy's action: from its numbers to RoboXim's units, and back.

`decode` and `encode` use no state of the arm: a delta stays a delta. `roboxim_core.actions.transforms` does the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.actions import ActionSemantics, ControlMode, DeltaBase, ReferenceFrame
from roboxim_core.conventions.frames import Frames
from roboxim_core.conventions.gripper import GripperOutput
from roboxim_core.conventions.normalisation import Normalisation
from roboxim_core.conventions.response import ControllerResponse
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.rotation.representations import (
    Floats,
    RotationRepresentation,
    decode_rows,
    encode_rows,
    gripper_down,
    identity_rotation,
)

SCALABLE = (
    RotationRepresentation.EULER_XYZ_EXTRINSIC,
    RotationRepresentation.EULER_XYZ_INTRINSIC,
    RotationRepresentation.ROTATION_VECTOR,
)
"""Representations whose three numbers are angles, which a scale multiplies."""
_RANGES = ("translation_range", "rotation_range", "joint_range")


@dataclass(frozen=True, kw_only=True)
class ActionOutput:
    """Meaning of a policy's action.

    Its numbers are un-normalised, put in order, clipped, scaled and turned, one after the other. The natural order of
    components is position or joints, rotation, gripper.
    """

    keys: tuple[str, ...] = ("actions",)
    """Keys of the answer that hold the action; several are joined, in this order, along the last axis."""
    control: ControlMode = ControlMode.END_EFFECTOR_DELTA
    """Commanded quantity."""
    frame: ReferenceFrame = ReferenceFrame.ROBOT_BASE
    """Frame of a motion of the tool centre point: along the base's axes, or the tool's."""
    rotation: RotationRepresentation = RotationRepresentation.EULER_XYZ_EXTRINSIC
    """Representation of the rotation."""
    delta_base: DeltaBase = DeltaBase.COMMANDED
    """State that a delta is added to; each action of a chunk uses the state at its own tick."""
    joints: int = 7
    """Number of arm joints, in joint space."""
    normalisation: Normalisation | None = None
    """Normalisation of the numbers; none: the server un-normalises."""
    size: int = 0
    """Number of components of the policy's action, if it has unused ones; 0: all are used."""
    order: tuple[int, ...] = ()
    """Index, in the policy's action, of each component in the natural order; empty: the natural order."""
    translation_range: tuple[float, ...] = ()
    """Lowest and highest number of a translation; others are clipped before scaling. Empty: no clipping."""
    rotation_range: tuple[float, ...] = ()
    """Lowest and highest number of a rotation, likewise; for Euler angles and rotation vectors."""
    joint_range: tuple[float, ...] = ()
    """Lowest and highest number of a joint, likewise."""
    translation_scale_m: float = 1.0
    """Factor from translation numbers to metres."""
    rotation_scale_rad: float = 1.0
    """Factor from rotation numbers to radians; for Euler angles and rotation vectors."""
    joint_scale: float = 1.0
    """Factor from joint numbers to radians or radians per second."""
    response: ControllerResponse | None = None
    """Response of the controller that the policy was trained with, for deltas with three rotation numbers; none: every
    delta is executed in full within its tick."""
    gripper: GripperOutput = GripperOutput()
    """Meaning of the last component."""
    max_translation_m: float = 0.05
    """Largest translation per tick [m]; the simulator clips larger ones and counts them."""
    max_rotation_rad: float = 0.25
    """Largest rotation per tick [rad]; the simulator clips larger ones and counts them."""

    def __post_init__(self) -> None:
        """Check that the fields fit together.

        Raises:
            InvalidRequestError: Naming the field.
        """
        for name in ("keys", "order", *_RANGES):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        meaning = self.semantics(10.0)  # checks control, frame, rotation, delta base and limits
        object.__setattr__(self, "frame", meaning.frame)
        object.__setattr__(self, "rotation", meaning.rotation)
        object.__setattr__(self, "delta_base", meaning.delta_base)
        natural = meaning.dimension(self.joints)
        order = self.order or tuple(range(natural))
        size = self.size or natural
        if len(order) != natural or len(set(order)) != natural or not all(0 <= i < size for i in order):
            raise InvalidRequestError(
                f"order must name {natural} different components below {size}, one per component of the action, "
                f"got {list(order)}"
            )
        for name in ("translation_scale_m", "rotation_scale_rad", "joint_scale"):
            limits.require_finite(name, [getattr(self, name)], 1e6)
            if getattr(self, name) == 0.0:
                raise InvalidRequestError(f"{name} must not be 0")
        if self.rotation_scale_rad != 1.0 and self.rotation not in SCALABLE:
            raise InvalidRequestError(f"rotation_scale_rad must be 1 with rotation '{self.rotation}'")
        for name in _RANGES:
            bounds = getattr(self, name)
            if bounds and not (len(bounds) == 2 and bounds[0] < bounds[1]):
                raise InvalidRequestError(f"{name} must be two numbers, low and high, got {list(bounds)}")
        if self.rotation_range and self.rotation not in SCALABLE:
            raise InvalidRequestError(f"rotation_range must be left out with rotation '{self.rotation}'")
        if self.normalisation and len(self.normalisation.first) not in (0, size):
            raise InvalidRequestError(
                f"normalisation has {len(self.normalisation.first)} components, an action has {size}"
            )
        if self.response and not meaning.is_vector_delta:
            raise InvalidRequestError(
                f"response needs control 'end_effector_delta' and a rotation of {SCALABLE}, got '{self.control}' and "
                f"'{self.rotation}'"
            )
        if not self.keys:
            raise InvalidRequestError("keys: at least one key of the answer is needed")

    def semantics(self, rate_hz: float) -> ActionSemantics:
        """Return the meaning of decoded actions at a rate [Hz]."""
        return ActionSemantics(
            control=self.control, frame=self.frame, rotation=self.rotation, delta_base=self.delta_base,
            rate_hz=rate_hz, max_translation_m=self.max_translation_m, max_rotation_rad=self.max_rotation_rad,
        )  # fmt: skip

    @property
    def lag(self) -> tuple[float, ...]:
        """Lag that executed motions get, see `PolicyDescription.lag`; empty: none."""
        return self.response.lag if self.response else ()

    @property
    def natural_size(self) -> int:
        """Number of components of a decoded action."""
        return self.semantics(10.0).dimension(self.joints)

    @property
    def raw_size(self) -> int:
        """Number of components of the policy's action."""
        return self.size or self.natural_size

    def decode(self, raw: npt.ArrayLike, frames: Frames) -> Floats:
        """Return actions in RoboXim's units and axes.

        Args:
            raw: The policy's numbers, shape (n, `raw_size`).
            frames: The convention's frames.

        Returns:
            float64, shape (n, `natural_size`), of the meaning `semantics`, gripper 1 = open.

        Raises:
            InvalidRequestError: With code ``INVALID_ACTION`` on a wrong shape, a number that is not finite, or numbers
                that do not describe a rotation.
        """
        rows = np.asarray(raw, dtype=float)
        rows = rows[None] if rows.ndim == 1 else rows
        if rows.ndim != 2 or rows.shape[1] != self.raw_size or not len(rows):
            raise InvalidRequestError(
                f"the policy's actions must have shape (n, {self.raw_size}), got {np.shape(raw)}",
                ErrorCode.INVALID_ACTION,
            )
        if not np.isfinite(rows).all():
            row, column = np.argwhere(~np.isfinite(rows))[0]
            raise InvalidRequestError(
                f"the policy's actions must be finite, got {rows[row, column]} at step {row}, component {column}",
                ErrorCode.INVALID_ACTION,
            )
        if self.normalisation:
            rows = self.normalisation.invert(rows)
        rows = rows[:, list(self.order)] if self.order else rows[:, : self.natural_size]
        motion, numbers = rows[:, :-1], rows[:, -1]
        if self.control.is_joint_space:
            motion = _clipped(motion, self.joint_range) * self.joint_scale
        else:
            parts = [_clipped(motion[:, :3], self.translation_range), _clipped(motion[:, 3:], self.rotation_range)]
            motion = self._turned_in(np.concatenate(parts, axis=1) * self._scales(), frames)
        return np.column_stack([motion, self.gripper.decode(numbers)])

    def encode(self, rows: npt.ArrayLike, frames: Frames) -> Floats:
        """Return the policy's numbers for actions in RoboXim's units; the inverse of `decode`.

        A number outside of its range is not clipped: it shows that the convention cannot express the action.

        Args:
            rows: Shape (n, `natural_size`), of the meaning `semantics`.
            frames: The convention's frames.

        Returns:
            float64, shape (n, `raw_size`); unused components are 0.
        """
        values = np.atleast_2d(np.asarray(rows, dtype=float))
        if self.control.is_joint_space:
            motion = values[:, :-1] / self.joint_scale
        else:
            motion = self._turned_out(values[:, :-1], frames) / self._scales()
        numbers = self.gripper.encode(values[:, -1])
        raw = np.zeros((len(values), self.raw_size))
        raw[:, list(self.order or range(self.natural_size))] = np.column_stack([motion, numbers])
        return self.normalisation.apply(raw) if self.normalisation else raw

    def _scales(self) -> Floats:
        scales = np.array([self.translation_scale_m] * 3 + [self.rotation_scale_rad] * self.rotation.size)
        return scales * self.response.gains if self.response else scales

    @property
    def _in_tool(self) -> bool:
        return self.frame == ReferenceFrame.TOOL

    def _turned_in(self, motion: Floats, frames: Frames) -> Floats:
        """Convert positions or motions with rotations from the convention's frames to RoboXim's."""
        positions, rotations = motion[:, :3], motion[:, 3:]
        if self.control == ControlMode.END_EFFECTOR_ABSOLUTE:
            turned = frames.orientations_in(decode_rows(rotations, self.rotation))
            positions = frames.positions_in(positions) - turned.apply(frames.tool_offset_m)
            if not frames.is_plain:
                rotations = encode_rows(turned, self.rotation, gripper_down())
        elif not frames.is_plain:
            positions = frames.vectors_in(positions, tool=self._in_tool)
            turned = frames.turns_in(decode_rows(rotations, self.rotation), tool=self._in_tool)
            rotations = encode_rows(turned, self.rotation, identity_rotation())
        return np.concatenate([positions, rotations], axis=1)

    def _turned_out(self, motion: Floats, frames: Frames) -> Floats:
        """Convert positions or motions with rotations from RoboXim's frames to the convention's."""
        positions, rotations = motion[:, :3], motion[:, 3:]
        if self.control == ControlMode.END_EFFECTOR_ABSOLUTE:
            held = decode_rows(rotations, self.rotation)
            positions = frames.positions_out(positions + held.apply(frames.tool_offset_m))
            if not frames.is_plain:
                turned = frames.orientations_out(held)
                near = frames.orientations_out(gripper_down())
                rotations = encode_rows(turned, self.rotation, near)
        elif not frames.is_plain:
            positions = frames.vectors_out(positions, tool=self._in_tool)
            turned = frames.turns_out(decode_rows(rotations, self.rotation), tool=self._in_tool)
            rotations = encode_rows(turned, self.rotation, identity_rotation())
        return np.concatenate([positions, rotations], axis=1)


def _clipped(numbers: Floats, bounds: tuple[float, ...]) -> Floats:
    return np.clip(numbers, bounds[0], bounds[1]) if bounds else numbers
