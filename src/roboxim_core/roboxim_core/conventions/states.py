"""The state of a request: named vectors that a recipe composes from the robot's measurements.

A recipe is linear, so that it can be undone: `StateInput.split` returns the measurements in a vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.conventions.frames import Frames
from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.plain_data.closed_enum import ClosedEnum
from roboxim_core.proprioception import Proprioception
from roboxim_core.rotation.representations import Floats, RotationRepresentation, decode_rows, encode_rows, gripper_down

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


class StateField(ClosedEnum):
    """Measurements that a state can contain."""

    TCP_POSITION = "tcp_position"
    """Position of the tool centre point in the convention's frame [m] (3)."""
    TCP_ROTATION = "tcp_rotation"
    """Rotation of the tool in the convention's frame, in the representation of ``rotation``."""
    JOINT_POSITIONS = "joint_positions"
    """Arm joint positions [rad] (one per joint)."""
    JOINT_VELOCITIES = "joint_velocities"
    """Arm joint velocities [rad/s] (one per joint)."""
    GRIPPER = "gripper"
    """Opening of the gripper, linear from ``closed`` to ``open`` (one number or several, e.g. one per finger)."""
    CONSTANT = "constant"
    """The numbers ``values``, e.g. padding."""


@dataclass(frozen=True, kw_only=True)
class StatePart:
    """Consecutive components of a state vector."""

    field: StateField
    """The measurement."""
    rotation: RotationRepresentation = RotationRepresentation.ROTATION_VECTOR
    """Representation of ``tcp_rotation``. Its seam lies half a turn from the gripper-down pose, so a rotation vector
    may be longer than pi, as robosuite's is."""
    open: tuple[float, ...] = (1.0,)
    """Numbers of ``gripper`` when fully open, e.g. finger positions [m]."""
    closed: tuple[float, ...] = (0.0,)
    """Numbers of ``gripper`` when closed."""
    values: tuple[float, ...] = ()
    """Numbers of ``constant``."""
    scale: float = 1.0
    """Factor on the measurement: 1000 converts metres to millimetres. Not for ``gripper`` and ``constant``."""
    components: tuple[int, ...] = ()
    """Indices of the components that are used, in this order, from 0; empty: all."""

    def __post_init__(self) -> None:
        """Check that the fields fit together.

        Raises:
            InvalidRequestError: Naming the field.
        """
        for name in ("open", "closed", "values", "components"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.field == StateField.GRIPPER:
            if len(self.open) != len(self.closed) or self.open == self.closed:
                raise InvalidRequestError(
                    f"gripper: open and closed must be different lists of one length, got {list(self.open)} and "
                    f"{list(self.closed)}"
                )
        elif self.field == StateField.CONSTANT and not self.values:
            raise InvalidRequestError("values: a constant part of a state needs numbers")
        elif self.field == StateField.TCP_ROTATION and self.rotation == RotationRepresentation.NONE:
            raise InvalidRequestError("rotation: a tcp_rotation needs a representation, got 'none'")
        limits.require_finite("the numbers of a state", (*self.open, *self.closed, *self.values, self.scale), 1e6)
        if self.scale == 0.0:
            raise InvalidRequestError("scale must not be 0")
        size = self.full_size()
        for index in self.components:
            if index < 0 or (size is not None and index >= size):
                raise InvalidRequestError(f"components: '{self.field}' has no component {index}")

    def full_size(self, joints: int | None = None) -> int | None:
        """Return the number of components before the selection; None: it depends on the robot's joints."""
        sizes = {
            StateField.TCP_POSITION: 3,
            StateField.TCP_ROTATION: self.rotation.size,
            StateField.GRIPPER: len(self.open),
            StateField.CONSTANT: len(self.values),
        }
        return sizes.get(self.field, joints)

    def names(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Return the components' names, e.g. ``tcp.x`` or ``panda_joint1.position``."""
        match self.field:
            case StateField.TCP_POSITION:
                every = ["tcp.x", "tcp.y", "tcp.z"]
            case StateField.TCP_ROTATION:
                every = [f"tcp.{name}" for name in self.rotation.component_names]
            case StateField.GRIPPER:
                every = ["gripper"] if len(self.open) == 1 else [f"gripper.{i}" for i in range(len(self.open))]
            case StateField.CONSTANT:
                every = ["pad"] * len(self.values)
            case _:
                kind = self.field.removeprefix("joint_").removesuffix("s").replace("velocitie", "velocity")
                every = [f"{name}.{kind}" for name in joint_names]
        return tuple(every[i] for i in (self.components or range(len(every))))


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmReadings:
    """Measurements at n ticks, as arrays: one row a tick, in RoboXim's frames and units."""

    tcp_positions: Floats
    """Positions of the tool centre point in the base, shape (n, 3) [m]."""
    tcp_rotations: Rotation
    """n rotations of the tool in the base."""
    joint_positions: Floats
    """Shape (n, joints) [rad]; (n, 0): unknown."""
    joint_velocities: Floats
    """Shape (n, joints) [rad/s]; (n, 0): unknown."""
    openings: Floats
    """Openings of the gripper, shape (n,), 1 = open."""

    @staticmethod
    def of(proprio: Sequence[Proprioception]) -> ArmReadings:
        """Return the measurements of ticks."""
        return ArmReadings(
            tcp_positions=np.array([p.tcp_position for p in proprio], dtype=float).reshape(-1, 3),
            tcp_rotations=decode_rows(
                np.array([p.tcp_rotation_6d for p in proprio], dtype=float).reshape(-1, 6),
                RotationRepresentation.ROTATION_6D,
            ),
            joint_positions=np.array([p.joint_positions for p in proprio], dtype=float),
            joint_velocities=np.array([p.joint_velocities for p in proprio], dtype=float),
            openings=np.array([p.gripper_opening for p in proprio], dtype=float),
        )

    def __len__(self) -> int:
        """Count the ticks."""
        return len(self.openings)


@dataclass(frozen=True, kw_only=True)
class StateInput:
    """A vector of a request."""

    key: str
    """Key in the request, e.g. ``observation/state``."""
    parts: tuple[StatePart, ...]
    """Its parts, in order."""
    dtype: str = "float32"
    """``float32`` or ``float64``, as genuine clients of the policy send it."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: On no parts or an unknown type.
        """
        if not self.parts:
            raise InvalidRequestError(f"state '{self.key}' has no parts")
        if self.dtype not in ("float32", "float64"):
            raise InvalidRequestError(f"dtype of state '{self.key}': {one_of(['float32', 'float64'], self.dtype)}")

    def rows(self, readings: ArmReadings, frames: Frames) -> npt.NDArray[np.floating]:
        """Return the vector at every tick, shape (n, size), of the type ``dtype``.

        Raises:
            InvalidRequestError: When the robot has fewer joints than ``components`` names, or reports none.
        """
        rows = np.concatenate([self._part(part, readings, frames) for part in self.parts], axis=1)
        return rows.astype(self.dtype)

    def size(self, joints: int) -> int:
        """Return the number of components for a robot with ``joints`` arm joints."""
        return sum(len(part.components) or (part.full_size(joints) or 0) for part in self.parts)

    def names(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the components."""
        return tuple(name for part in self.parts for name in part.names(joint_names))

    def split(self, rows: npt.ArrayLike, frames: Frames, joints: int) -> ArmReadings:
        """Return the measurements in vectors; the inverse of `rows`.

        Args:
            rows: Shape (n, size).
            frames: The convention's frames.
            joints: Number of the robot's arm joints.

        Returns:
            Measurements; those that the vector does not hold completely are NaN (positions), the identity (rotations)
            or empty (joints).
        """
        from scipy.spatial.transform import Rotation

        values = np.asarray(rows, dtype=float)
        count = len(values)
        known = ArmReadings(
            tcp_positions=np.full((count, 3), np.nan), tcp_rotations=Rotation.identity(count),
            joint_positions=np.zeros((count, 0)), joint_velocities=np.zeros((count, 0)),
            openings=np.full(count, np.nan),
        )  # fmt: skip
        start = 0
        for part in self.parts:
            full = part.full_size(joints) or 0
            size = len(part.components) or full
            block, start = values[:, start : start + size], start + size
            if part.components and sorted(part.components) != list(range(full)):
                continue
            if part.components:
                block = block[:, np.argsort(part.components)]
            known = _with(known, part, block, frames)
        return replace(known, tcp_positions=known.tcp_positions - known.tcp_rotations.apply(frames.tool_offset_m))

    def _part(self, part: StatePart, readings: ArmReadings, frames: Frames) -> Floats:
        every = _values(part, readings, frames)
        if any(index >= every.shape[1] for index in part.components) or not every.shape[1]:
            raise InvalidRequestError(
                f"state '{self.key}' needs {part.field} {list(part.components) or ''}, the robot reports "
                f"{every.shape[1]} components"
            )
        return every[:, list(part.components)] if part.components else every


def _values(part: StatePart, readings: ArmReadings, frames: Frames) -> Floats:
    """Return all components of a part at every tick, shape (n, full size)."""
    from scipy.spatial.transform import Rotation

    match part.field:
        case StateField.TCP_POSITION:
            points = readings.tcp_positions + readings.tcp_rotations.apply(frames.tool_offset_m)
            return frames.positions_out(points) * part.scale
        case StateField.TCP_ROTATION:
            near = frames.orientations_out(Rotation.from_quat(gripper_down().as_quat()[None]))[0]
            rotations = frames.orientations_out(readings.tcp_rotations)
            return encode_rows(rotations, part.rotation, near) * part.scale
        case StateField.GRIPPER:
            span = np.subtract(part.open, part.closed)
            return np.asarray(np.array(part.closed) + readings.openings[:, None] * span)
        case StateField.CONSTANT:
            return np.tile(np.array(part.values, dtype=float), (len(readings), 1))
        case StateField.JOINT_POSITIONS:
            return readings.joint_positions * part.scale
        case StateField.JOINT_VELOCITIES:
            return readings.joint_velocities * part.scale


def _with(known: ArmReadings, part: StatePart, block: Floats, frames: Frames) -> ArmReadings:
    """Return measurements, updated from a part's components."""
    match part.field:
        case StateField.TCP_POSITION:
            return replace(known, tcp_positions=frames.positions_in(block / part.scale))
        case StateField.TCP_ROTATION:
            return replace(known, tcp_rotations=frames.orientations_in(decode_rows(block / part.scale, part.rotation)))
        case StateField.GRIPPER:
            span = np.subtract(part.open, part.closed)
            openings = (block - np.array(part.closed)) @ span / (span @ span)
            return replace(known, openings=openings)
        case StateField.JOINT_POSITIONS:
            return replace(known, joint_positions=block / part.scale)
        case StateField.JOINT_VELOCITIES:
            return replace(known, joint_velocities=block / part.scale)
        case StateField.CONSTANT:
            return known
