"""Rigid transforms as plain hashable values: metres, quaternions xyzw, right-handed frames (REP-103)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.rotation.quaternions import Quat, quat_from_axes

if TYPE_CHECKING:
    import pinocchio as pin
    from scipy.spatial.transform import Rotation  # heavy: commands that only read a configuration do not need it

Vec3 = tuple[float, float, float]
Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Pose of a child frame in a parent frame; variables name both frames, e.g. ``pose_tcp_in_world``."""

    position: Vec3 = (0.0, 0.0, 0.0)
    """Origin of the child in the parent [m]."""
    quat_xyzw: Quat = (0.0, 0.0, 0.0, 1.0)
    """Rotation of the child in the parent, unit quaternion."""

    def __post_init__(self) -> None:
        """Check finiteness and the quaternion's norm.

        Raises:
            InvalidRequestError: On a NaN, an infinity, a wrong length or a quaternion that is not of unit norm (1e-3).
        """
        if len(self.position) == 3 and len(self.quat_xyzw) == 4:  # fast path: a tick makes many poses
            (x, y, z), (a, b, c, d) = self.position, self.quat_xyzw
            if 0.9981 < a * a + b * b + c * c + d * d < 1.0019 and math.isfinite(x + y + z):
                return
        if len(self.position) != 3 or len(self.quat_xyzw) != 4:
            raise InvalidRequestError(f"a pose is a position of 3 and a quaternion of 4 numbers, got {self}")
        (px, py, pz), (x, y, z, w) = self.position, self.quat_xyzw
        if not math.isfinite(px + py + pz + x + y + z + w):  # the sum also overflows if numbers are absurdly large
            raise InvalidRequestError(f"a pose must be finite, got {self}")
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if abs(norm - 1.0) > 1e-3:
            raise InvalidRequestError(f"a pose's quaternion must have norm 1, got {norm:.4f} in {self}")

    @staticmethod
    def from_arrays(position: npt.ArrayLike, rotation: Rotation | None = None) -> Pose:
        """Make a pose from a position of shape (3,) [m] and a scipy rotation (None: identity)."""
        x, y, z = np.asarray(position, dtype=float).tolist()
        quat: Quat = (0.0, 0.0, 0.0, 1.0) if rotation is None else tuple(rotation.as_quat(canonical=True).tolist())
        return Pose(position=(x, y, z), quat_xyzw=quat)

    @staticmethod
    def from_quaternion(position: npt.ArrayLike, quaternion: pin.Quaternion) -> Pose:
        """Make a pose from a position of shape (3,) [m] and a pinocchio quaternion, which need not be of unit norm."""
        x, y, z = np.asarray(position, dtype=float).tolist()
        qx, qy, qz, qw = quaternion.normalized().coeffs().tolist()
        return Pose(position=(x, y, z), quat_xyzw=(qx, qy, qz, qw) if qw >= 0 else (-qx, -qy, -qz, -qw))

    @staticmethod
    def from_matrix(matrix: npt.ArrayLike) -> Pose:
        """Make a pose from a homogeneous matrix of shape (4, 4)."""
        mat = np.asarray(matrix, dtype=float)
        from scipy.spatial.transform import Rotation

        return Pose.from_arrays(mat[:3, 3], Rotation.from_matrix(mat[:3, :3]))

    @cached_property
    def rotation(self) -> Rotation:
        """The rotation as a scipy ``Rotation``."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.quat_xyzw)

    @property
    def quaternion(self) -> pin.Quaternion:
        """The rotation as a pinocchio quaternion, which composes single rotations faster than scipy."""
        import pinocchio  # imported here, because processes that only render do not need it

        x, y, z, w = self.quat_xyzw
        return pinocchio.Quaternion(w, x, y, z).normalized()

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix, shape (4, 4)."""
        mat = np.eye(4)
        mat[:3, :3] = self.quaternion.matrix()
        mat[:3, 3] = self.position
        return mat

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: ``pose_b_in_a @ pose_c_in_b`` is ``pose_c_in_a``."""
        quaternion = self.quaternion
        return Pose.from_quaternion(
            quaternion * np.array(other.position) + self.position, quaternion * other.quaternion
        )

    def inverse(self) -> Pose:
        """Return the pose of the parent in the child."""
        inverse = self.quaternion.conjugate()
        return Pose.from_quaternion(-(inverse * np.array(self.position)), inverse)

    def apply(self, points: npt.ArrayLike) -> Array:
        """Map points of shape (3,) or (N, 3) [m] from the child to the parent frame."""
        return np.asarray(np.asarray(points, dtype=float) @ self.quaternion.matrix().T + self.position)


IDENTITY = Pose()


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Return the distance between two poses in the same parent: translation [m], rotation angle [rad]."""
    translation = float(np.linalg.norm(np.subtract(a.position, b.position)))
    return translation, float(a.quaternion.angularDistance(b.quaternion))


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
    """Return the pose of the optical frame (x right, y down, z forward; REP-103) of a camera that looks at a point.

    Args:
        eye: Position of the camera in the parent frame, shape (3,) [m].
        target: Point at the image's centre, in the parent frame, shape (3,) [m].
        up: Direction in the parent frame that points up in the image, shape (3,).

    Raises:
        InvalidRequestError: When the target is at the eye or along ``up``.
    """
    origin = np.asarray(eye, dtype=float)
    forward = np.asarray(target, dtype=float) - origin
    right = np.cross(forward, np.asarray(up, dtype=float))
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9:
        raise InvalidRequestError(
            f"look_at needs a target apart from eye and not along up; eye {eye!r}, target {target!r}"
        )
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    x, y, z = origin.tolist()
    return Pose(position=(x, y, z), quat_xyzw=quat_from_axes(right, down, forward))
