"""Rotations as numbers: the representations that actions and proprioception use, and the positions of their seams.

Three numbers cannot describe all rotations without a jump, and neither can a quaternion, because q and -q are the same
rotation. `encode` takes a rotation, ``near``, that the seam is kept away from:

- a quaternion gets the sign that is nearer to ``near``; it jumps only half a turn or more away from it;
- a rotation vector is computed from the quaternion with that sign, so it can be longer than pi;
- each Euler angle lies within pi of the same angle of ``near``. At a pitch of +-90 degrees Euler angles jump anyway;
- ``rotation_6d`` is the first two columns of the rotation matrix. It has no seam, nor have its two relatives.

For a rotation delta ``near`` is the identity, for an absolute pose of the tool it is `gripper_down`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.plain_data.closed_enum import ClosedEnum

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Floats = npt.NDArray[np.float64]

_SMALLEST = 1e-6


class RotationRepresentation(ClosedEnum):
    """Representation of a rotation as numbers."""

    EULER_XYZ_EXTRINSIC = "euler_xyz_extrinsic"
    """Roll, pitch, yaw [rad] about the fixed x, then y, then z axis."""
    EULER_XYZ_INTRINSIC = "euler_xyz_intrinsic"
    """Angles [rad] about the moving x, then y, then z axis."""
    ROTATION_VECTOR = "rotation_vector"
    """Axis times angle [rad]."""
    ROTATION_6D = "rotation_6d"
    """First column of the rotation matrix, then the second."""
    ROTATION_6D_INTERLEAVED = "rotation_6d_interleaved"
    """The first two columns of the rotation matrix, read row by row (X-VLA)."""
    ROTATION_6D_ROWS = "rotation_6d_rows"
    """First row of the rotation matrix, then the second (PyTorch3D, GR00T)."""
    QUATERNION_XYZW = "quaternion_xyzw"
    """Unit quaternion, scalar last."""
    QUATERNION_WXYZ = "quaternion_wxyz"
    """Unit quaternion, scalar first."""
    NONE = "none"
    """The action contains no rotation (joint space)."""

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the numbers, in order."""
        return _NAMES[self]

    @property
    def size(self) -> int:
        """Count of the numbers."""
        return len(_NAMES[self])

    @property
    def is_continuous(self) -> bool:
        """Whether it has no seam: the numbers are parts of the rotation matrix."""
        return self.value.startswith("rotation_6d")


_NAMES: dict[RotationRepresentation, tuple[str, ...]] = {
    RotationRepresentation.EULER_XYZ_EXTRINSIC: ("roll", "pitch", "yaw"),
    RotationRepresentation.EULER_XYZ_INTRINSIC: ("angle_x", "angle_y", "angle_z"),
    RotationRepresentation.ROTATION_VECTOR: ("rx", "ry", "rz"),
    RotationRepresentation.ROTATION_6D: ("x_axis.x", "x_axis.y", "x_axis.z", "y_axis.x", "y_axis.y", "y_axis.z"),
    RotationRepresentation.ROTATION_6D_INTERLEAVED: (
        "x_axis.x", "y_axis.x", "x_axis.y", "y_axis.y", "x_axis.z", "y_axis.z",
    ),
    RotationRepresentation.ROTATION_6D_ROWS: ("x_axis.x", "y_axis.x", "z_axis.x", "x_axis.y", "y_axis.y", "z_axis.y"),
    RotationRepresentation.QUATERNION_XYZW: ("qx", "qy", "qz", "qw"),
    RotationRepresentation.QUATERNION_WXYZ: ("qw", "qx", "qy", "qz"),
    RotationRepresentation.NONE: (),
}  # fmt: skip
_INTERLEAVED = [0, 3, 1, 4, 2, 5]
"""Places of the interleaved numbers among those of ``rotation_6d``."""


@cache
def identity_rotation() -> Rotation:
    """Return the rotation that turns nothing."""
    from scipy.spatial.transform import Rotation

    return Rotation.identity()


@cache
def gripper_down() -> Rotation:
    """Return the working pose's rotation: the tool's z axis points down, its x axis forwards."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


def encode(rotation: Rotation, representation: RotationRepresentation, near: Rotation | None = None) -> Floats:
    """Encode a rotation as numbers.

    Args:
        rotation: One rotation.
        representation: The representation of the result.
        near: The rotation that the seam is kept away from (None: the identity); see the module.

    Returns:
        float64, shape (`RotationRepresentation.size`,).
    """
    near = identity_rotation() if near is None else near
    kind = RotationRepresentation
    match representation:
        case kind.ROTATION_6D:
            return np.asarray(rotation.as_matrix().T[:2].ravel())
        case kind.ROTATION_6D_INTERLEAVED:
            return np.asarray(rotation.as_matrix()[:, :2].ravel())
        case kind.ROTATION_6D_ROWS:
            return np.asarray(rotation.as_matrix()[:2].ravel())
        case kind.QUATERNION_XYZW:
            return _signed(rotation, near)
        case kind.QUATERNION_WXYZ:
            return np.roll(_signed(rotation, near), 1)
        case kind.ROTATION_VECTOR:
            *vector, scalar = _signed(rotation, near)
            length = math.hypot(*vector)
            half_angle = math.atan2(length, scalar)
            return np.array(vector) * (2.0 * half_angle / length if length > 1e-12 else 2.0)
        case kind.EULER_XYZ_EXTRINSIC:
            return _near(_extrinsic_xyz(rotation.as_matrix()), _extrinsic_xyz(near.as_matrix()))
        case kind.EULER_XYZ_INTRINSIC:
            return _near(_intrinsic_xyz(rotation.as_matrix()), _intrinsic_xyz(near.as_matrix()))
        case kind.NONE:
            return np.zeros(0)


def decode(values: npt.ArrayLike, representation: RotationRepresentation) -> Rotation:
    """Decode a rotation from numbers. Quaternions and 6D rotations need not be normalised.

    Args:
        values: Shape (`RotationRepresentation.size`,).
        representation: The representation of the values.

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION`` on numbers that do not describe a rotation, e.g. a quaternion
            of zeros.
    """
    from scipy.spatial.transform import Rotation

    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (representation.size,) or not np.isfinite(numbers).all():
        raise _no_rotation(representation, f"it takes {representation.size} finite numbers", numbers)
    kind = RotationRepresentation
    match representation:
        case kind.ROTATION_6D:
            return Rotation.from_matrix(_matrix_of_6d(numbers))
        case kind.ROTATION_6D_INTERLEAVED:
            return Rotation.from_matrix(_matrix_of_6d(numbers[np.argsort(_INTERLEAVED)]))
        case kind.ROTATION_6D_ROWS:
            return Rotation.from_matrix(_matrix_of_6d(numbers).T)
        case kind.QUATERNION_XYZW | kind.QUATERNION_WXYZ:
            if float(np.linalg.norm(numbers)) < _SMALLEST:
                raise _no_rotation(representation, "a quaternion has norm 1", numbers)
            return Rotation.from_quat(numbers if representation == kind.QUATERNION_XYZW else np.roll(numbers, -1))
        case kind.ROTATION_VECTOR:
            return Rotation.from_rotvec(numbers)
        case kind.EULER_XYZ_EXTRINSIC:
            return Rotation.from_euler("xyz", numbers)
        case kind.EULER_XYZ_INTRINSIC:
            return Rotation.from_euler("XYZ", numbers)
        case kind.NONE:
            return identity_rotation()


def encode_rows(rotations: Rotation, representation: RotationRepresentation, near: Rotation | None = None) -> Floats:
    """Encode many rotations as numbers; row by row the same as `encode`, up to rounding.

    Args:
        rotations: n rotations.
        representation: The representation of the result.
        near: The rotation that the seam is kept away from (None: the identity); see the module.

    Returns:
        float64, shape (n, `RotationRepresentation.size`).
    """
    rows = [encode(rotation, representation, near) for rotation in rotations]
    return np.array(rows).reshape(len(rows), representation.size)


def decode_rows(values: npt.ArrayLike, representation: RotationRepresentation) -> Rotation:
    """Decode many rotations from numbers; row by row the same as `decode`.

    Args:
        values: Shape (n, `RotationRepresentation.size`).
        representation: The representation of the values.

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION`` on numbers that do not describe a rotation.
    """
    from scipy.spatial.transform import Rotation

    rows = np.asarray(values, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != representation.size:
        raise _no_rotation(representation, f"it takes rows of {representation.size} numbers", rows)
    if not len(rows) or representation == RotationRepresentation.NONE:
        return Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1)))
    return Rotation.from_quat([decode(row, representation).as_quat() for row in rows])


def _signed(rotation: Rotation, near: Rotation) -> Floats:
    quaternion = np.asarray(rotation.as_quat(), dtype=float)
    return -quaternion if float(quaternion @ near.as_quat()) < 0.0 else quaternion


def _near(angles: Floats, reference: Floats) -> Floats:
    return np.asarray(angles - 2.0 * math.pi * np.round((angles - reference) / (2.0 * math.pi)))


def _extrinsic_xyz(matrix: Floats) -> Floats:
    """Return roll, pitch, yaw [rad], accurate also at a pitch of +-90 degrees, where only roll +- yaw is defined."""
    pitch = math.atan2(-matrix[2, 0], math.hypot(matrix[0, 0], matrix[1, 0]))
    yaw = math.atan2(matrix[1, 0], matrix[0, 0])
    sine, cosine = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(
        sine * matrix[0, 2] - cosine * matrix[1, 2], cosine * matrix[1, 1] - sine * matrix[0, 1]
    )  # from the rotation that remains after yaw is undone
    return np.array([roll, pitch, yaw])


def _intrinsic_xyz(matrix: Floats) -> Floats:
    """Return the intrinsic angles: R = Rx Ry Rz, so R^T has the extrinsic angles (-x, -y, -z) in reverse order."""
    angle_y = math.atan2(matrix[0, 2], math.hypot(matrix[1, 2], matrix[2, 2]))
    angle_x = math.atan2(-matrix[1, 2], matrix[2, 2])
    sine, cosine = math.sin(angle_x), math.cos(angle_x)
    angle_z = math.atan2(
        cosine * matrix[1, 0] + sine * matrix[2, 0], cosine * matrix[1, 1] + sine * matrix[2, 1]
    )  # from the rotation that remains after the first angle is undone
    return np.array([angle_x, angle_y, angle_z])


def _matrix_of_6d(numbers: Floats) -> Floats:
    """Return the rotation matrix whose first two columns are nearest (Gram-Schmidt).

    Source: Zhou et al., On the Continuity of Rotation Representations in Neural Networks, CVPR 2019, section 4.2.
    """
    first, second = numbers[:3], numbers[3:]
    length = float(np.linalg.norm(first))
    if length < _SMALLEST:
        raise _no_rotation(RotationRepresentation.ROTATION_6D, "its first axis has no length", numbers)
    first = first / length
    second = second - (first @ second) * first
    length = float(np.linalg.norm(second))
    if length < _SMALLEST:
        raise _no_rotation(RotationRepresentation.ROTATION_6D, "its two axes are parallel", numbers)
    second = second / length
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _no_rotation(representation: RotationRepresentation, why: str, numbers: Floats) -> InvalidRequestError:
    return InvalidRequestError(
        f"{np.array2string(numbers, precision=4)} is not a valid {representation}: {why}", ErrorCode.INVALID_ACTION
    )
