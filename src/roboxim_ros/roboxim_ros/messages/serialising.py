"""Serialises the core's values with `rosbags`, without rclpy.

rclpy needs a Python message, and copies it field by field into a C message before it serialises the latter. `rosbags`
serialises objects by the definition of their type. `to_cdr` serialises a whole dataclass (module `packing`), by the
rules of `conversions.to_msg`. The bytes are those of rclpy, except that padding is 0 and that nothing follows the last
field.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys.store import Typestore

from roboxim_core.poses import Pose
from roboxim_ros.messages.packing import HEADER, packer
from roboxim_ros.messages.schemas import message_schema, typestore


@cache
def _store(name: str) -> Typestore:
    return typestore((message_schema(name),))


def message(name: str, /, **fields: Any) -> Any:
    """Return an object that `rosbags` serialises.

    Args:
        name: Full name of its type, e.g. ``sensor_msgs/msg/Image``.
        fields: All its fields: texts, numbers, NumPy arrays of the field's type, other messages and lists of these.

    Raises:
        InvalidRequestError: If the type is not installed on this machine.
    """
    return _store(name).types[name](**fields)


def serialise(name: str, /, **fields: Any) -> memoryview:
    """Return a serialised message; see `message`. An array is copied once."""
    return _store(name).serialize_cdr(message(name, **fields), name, little_endian=True)


def to_cdr(value: Any, name: str) -> memoryview:
    """Return a dataclass as a serialised message.

    Args:
        value: The dataclass.
        name: Full name of a message type with the same field names; see `packer`.

    Raises:
        InvalidRequestError: If the type is not installed on this machine.
        RoboximError: When the message has a field of a kind that is not converted here.
    """
    return packer(type(value), name, _store(name))(value)


def time_message(stamp_ns: int) -> Any:
    """Return a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header_message(stamp_ns: int, frame: str) -> Any:
    """Return a ``std_msgs/Header``."""
    return message(HEADER, stamp=time_message(stamp_ns), frame_id=frame)


def vector_message(values: Sequence[float]) -> Any:
    """Return a ``geometry_msgs/Vector3``; a ``Point`` has the same fields."""
    x, y, z = values
    return message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def quaternion_message(quat_xyzw: Sequence[float]) -> Any:
    """Return a ``geometry_msgs/Quaternion``."""
    x, y, z, w = quat_xyzw
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def pose_message(pose: Pose) -> Any:
    """Return a ``geometry_msgs/Pose``."""
    position, orientation = vector_message(pose.position), quaternion_message(pose.quat_xyzw)
    return message("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def doubles(values: Sequence[float]) -> npt.NDArray[np.float64]:
    """Return the value of a field of type ``float64[]``."""
    return np.array(values, np.float64)
