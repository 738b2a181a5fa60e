"""Proprioception: a robot's measurements of its own state, in named fields.

The tool's rotation is stored as the first two columns of its matrix (``rotation_6d``), which are continuous everywhere.
A quaternion whose scalar part is kept positive jumps in the working pose, where the gripper points down.
`Proprioception.vector` returns quaternions or Euler angles on request. Their seam lies half a turn away from that pose,
see `roboxim_core.rotation.representations`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.plain_data.closed_enum import ClosedEnum
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.rotation.quaternions import axes_of_quat
from roboxim_core.rotation.representations import RotationRepresentation, decode, encode, gripper_down
from roboxim_core.state import StateRecord

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Vec6 = tuple[float, float, float, float, float, float]


class ProprioField(ClosedEnum):
    """Fields that `Proprioception.vector` can contain; the number of components is in parentheses."""

    TCP_POSITION = "tcp_position"
    """Position of the tool centre point in the base [m] (3)."""
    TCP_ROTATION_6D = "tcp_rotation_6d"
    """Rotation of the tool: its x axis, then its y axis, in the base (6)."""
    TCP_QUATERNION_XYZW = "tcp_quaternion_xyzw"
    """Rotation of the tool in the base as a quaternion, with the sign nearer to the gripper-down pose (4)."""
    TCP_EULER_XYZ = "tcp_euler_xyz"
    """Rotation of the tool as roll, pitch, yaw [rad] about the base's axes; roll within 0 and 2 pi (3)."""
    JOINT_POSITIONS = "joint_positions"
    """Arm joint positions [rad] (one per joint)."""
    JOINT_VELOCITIES = "joint_velocities"
    """Arm joint velocities [rad/s] (one per joint)."""
    GRIPPER_OPENING = "gripper_opening"
    """1 = open, 0 = closed, linear in the total opening (1)."""


STATE_FIELDS = (ProprioField.TCP_POSITION, ProprioField.TCP_ROTATION_6D, ProprioField.GRIPPER_OPENING)
"""Fields of ``observation/state`` in exports, and the default fields of `Proprioception.vector`."""
_ROTATIONS = {
    ProprioField.TCP_ROTATION_6D: RotationRepresentation.ROTATION_6D,
    ProprioField.TCP_QUATERNION_XYZW: RotationRepresentation.QUATERNION_XYZW,
    ProprioField.TCP_EULER_XYZ: RotationRepresentation.EULER_XYZ_EXTRINSIC,
}


@dataclass(frozen=True, kw_only=True)
class Proprioception:
    """Measurements of a robot's own state at one tick. The defaults describe an arm without joints at its base."""

    tcp_position: Vec3 = (0.0, 0.0, 0.0)
    """Measured position of the tool centre point in the robot's base [m]."""
    tcp_rotation_6d: Vec6 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Measured rotation of the tool in the base: first column (the tool's x axis), then second column (its y axis)."""
    joint_names: tuple[str, ...] = ()
    """Names of the arm joints, in the model's order."""
    joint_positions: tuple[float, ...] = ()
    """Measured positions of these joints [rad]."""
    joint_velocities: tuple[float, ...] = ()
    """Measured velocities of these joints [rad/s]."""
    gripper_opening: float = 1.0
    """Measured opening, 1 = open, 0 = closed, linear in the total opening."""

    def __post_init__(self) -> None:
        """Check lengths and finiteness.

        Raises:
            InvalidRequestError: On a wrong length, a NaN or an infinity.
        """
        sizes = {"tcp_position": 3, "tcp_rotation_6d": 6}
        sizes |= dict.fromkeys(("joint_positions", "joint_velocities"), len(self.joint_names))
        for name, size in sizes.items():
            values = getattr(self, name)
            if len(values) != size or not all(math.isfinite(value) for value in values):
                raise InvalidRequestError(f"proprioception: {name} must be {size} finite numbers, got {values}")
        if not math.isfinite(self.gripper_opening):
            raise InvalidRequestError(f"proprioception: gripper_opening must be finite, got {self.gripper_opening}")

    @staticmethod
    def of(state: StateRecord, pose_base_in_world: Pose = IDENTITY) -> Proprioception:
        """Return the proprioception of a state, as `Act` carries it and exports store it.

        Args:
            state: The state record.
            pose_base_in_world: Pose of the robot's base.
        """
        robot = state.robot
        tcp = robot.pose_tcp_measured
        if pose_base_in_world != IDENTITY:
            tcp = pose_base_in_world.inverse() @ tcp
        return Proprioception(
            tcp_position=tcp.position,
            tcp_rotation_6d=axes_of_quat(tcp.quat_xyzw),
            joint_names=robot.joint_names,
            joint_positions=robot.joint_positions,
            joint_velocities=robot.joint_velocities,
            gripper_opening=robot.gripper_opening,
        )

    @cached_property
    def tcp_rotation(self) -> Rotation:
        """Rotation of the tool centre point in the base.

        Raises:
            InvalidRequestError: When ``tcp_rotation_6d`` does not describe a rotation.
        """
        return decode(self.tcp_rotation_6d, RotationRepresentation.ROTATION_6D)

    @property
    def tcp_pose(self) -> Pose:
        """Pose of the tool centre point in the base."""
        return Pose.from_arrays(self.tcp_position, self.tcp_rotation)

    def vector(self, fields: Sequence[ProprioField | str] = STATE_FIELDS) -> npt.NDArray[np.float32]:
        """Return fields as one array.

        Args:
            fields: The fields, in this order, e.g. ``("tcp_position", "joint_positions")``.

        Returns:
            float32, shape (n,); `component_names` names the components.

        Raises:
            InvalidRequestError: On an unknown field.
        """
        parts = [self._values(field) for field in _fields(fields)]
        return np.concatenate([np.zeros(0), *parts]).astype(np.float32)

    def component_names(self, fields: Sequence[ProprioField | str] = STATE_FIELDS) -> tuple[str, ...]:
        """Return the names of the components of `vector`, e.g. ``tcp.x`` or ``panda_joint1.position``.

        Raises:
            InvalidRequestError: On an unknown field.
        """
        return component_names(fields, self.joint_names)

    def _values(self, field: ProprioField) -> npt.NDArray[np.float64]:
        if field in (ProprioField.TCP_QUATERNION_XYZW, ProprioField.TCP_EULER_XYZ):
            return encode(self.tcp_rotation, _ROTATIONS[field], gripper_down())
        return np.atleast_1d(np.asarray(getattr(self, field.value), dtype=np.float64))


def component_names(
    fields: Sequence[ProprioField | str] = STATE_FIELDS, joint_names: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the names of the components of `Proprioception.vector`.

    Args:
        fields: The fields.
        joint_names: Names of the arm joints; needed for joint fields only.

    Raises:
        InvalidRequestError: On an unknown field.
    """
    names: list[str] = []
    for field in _fields(fields):
        if field in _ROTATIONS:
            names += [f"tcp.{name}" for name in _ROTATIONS[field].component_names]
        elif field == ProprioField.TCP_POSITION:
            names += ["tcp.x", "tcp.y", "tcp.z"]
        elif field == ProprioField.GRIPPER_OPENING:
            names.append("gripper.opening")
        else:
            kind = "position" if field == ProprioField.JOINT_POSITIONS else "velocity"
            names += [f"{name}.{kind}" for name in joint_names]
    return tuple(names)


def _fields(fields: Sequence[ProprioField | str]) -> list[ProprioField]:
    try:
        return [ProprioField(field) for field in ((fields,) if isinstance(fields, str) else fields)]
    except ValueError as error:
        raise InvalidRequestError(str(error)) from None


STATE_NAMES = component_names()
"""Names of the components of ``observation/state`` in exports."""
STATE_SIZE = len(STATE_NAMES)
"""Number of components of ``observation/state``."""
