"""Single rotations as unit quaternions xyzw in plain floats, ten times as fast as arrays for one rotation.

For many rotations at once, use scipy's ``Rotation``. Where this module says "the same bits as scipy", results may be
part of a recorded episode; importing scipy's ``Rotation`` takes longer than most commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal

Quat = tuple[float, float, float, float]


def quat_product(a: Quat, b: Quat) -> Quat:
    """Return the rotation ``b`` followed by ``a``, of unit norm and with w >= 0."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return _canonical(
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def quat_inverse(quat: Quat) -> Quat:
    """Return the inverse rotation."""
    x, y, z, w = quat
    return -x, -y, -z, w


def quat_from_euler(roll: float, pitch: float, yaw: float) -> Quat:
    """Return the rotation by angles about the fixed axes x, then y, then z [rad]: scipy's ``xyz``."""
    sr, cr = math.sin(roll / 2), math.cos(roll / 2)
    sp, cp = math.sin(pitch / 2), math.cos(pitch / 2)
    sy, cy = math.sin(yaw / 2), math.cos(yaw / 2)
    return _canonical(
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quat_about(axis: Literal["x", "y", "z"], angle: float) -> Quat:
    """Return the rotation about one axis by an angle [rad]: the same bits as scipy's ``from_euler``."""
    sine, cosine = math.sin(angle / 2), math.cos(angle / 2)
    x, y, z = (sine if name == axis else 0.0 for name in "xyz")
    return _positive(x, y, z, cosine)


def quat_from_axes(x_axis: Iterable[float], y_axis: Iterable[float], z_axis: Iterable[float]) -> Quat:
    """Return the rotation whose matrix has these orthonormal columns: the same bits as scipy's ``from_matrix``.

    Source: Markley, Unit Quaternion from Rotation Matrix, Journal of Guidance, Control, and Dynamics 31 (2008).
    """
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = (map(float, axis) for axis in (x_axis, y_axis, z_axis))
    trace = m00 + m11 + m22
    largest = max(m00, m11, m22, trace)
    if largest == m00:
        x, y, z, w = 1 - trace + 2 * m00, m10 + m01, m20 + m02, m21 - m12
    elif largest == m11:
        y, z, x, w = 1 - trace + 2 * m11, m21 + m12, m01 + m10, m02 - m20
    elif largest == m22:
        z, x, y, w = 1 - trace + 2 * m22, m02 + m20, m12 + m21, m10 - m01
    else:
        x, y, z, w = m21 - m12, m02 - m20, m10 - m01, 1 + trace
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return _positive(x / norm, y / norm, z / norm, w / norm)


def axes_of_quat(quat: Quat) -> tuple[float, float, float, float, float, float]:
    """Return the first two columns of the rotation's matrix, x axis and y axis: the same bits as scipy's ``as_matrix``.

    Args:
        quat: Quaternion, which need not be of unit norm.
    """
    norm = math.sqrt(sum(value * value for value in quat))
    x, y, z, w = (value / norm for value in quat)
    x2, y2, z2, w2 = x * x, y * y, z * z, w * w
    return (
        x2 - y2 - z2 + w2, 2 * (x * y + z * w), 2 * (x * z - y * w),
        2 * (x * y - z * w), -x2 + y2 - z2 + w2, 2 * (y * z + x * w),
    )  # fmt: skip


def euler_from_quat(quat: Quat) -> tuple[float, float, float]:
    """Return the angles about the fixed axes x, then y, then z [rad].

    Roll and yaw are not unique if the pitch is +-90 degrees; the roll is then 0.
    """
    x, y, z, w = quat
    sine = max(-1.0, min(1.0, 2.0 * (w * y - z * x)))
    if abs(sine) > 1.0 - 1e-12:
        return 0.0, math.copysign(math.pi / 2, sine), -2.0 * math.copysign(1.0, sine) * math.atan2(x, w)
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(sine),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def _canonical(x: float, y: float, z: float, w: float) -> Quat:
    scale = math.copysign(1.0 / math.sqrt(x * x + y * y + z * z + w * w), w)
    return x * scale, y * scale, z * scale, w * scale


def _positive(x: float, y: float, z: float, w: float) -> Quat:
    """Return the one of q and -q whose w, else x, else y, else z, is positive."""
    negative = next((value < 0 for value in (w, x, y, z) if value != 0), False)
    return (-x, -y, -z, -w) if negative else (x, y, z, w)
