"""Serialises the core's values with `rosbags`, without rclpy.

rclpy copies a Python message field by field into a C message before it serialises that one, and the Python message must
be made first. `rosbags` serialises objects by the definition of their type. `to_cdr` serialises a whole dataclass, by
the rules of `roboxim_ros.conversions.to_msg`. The bytes are those of rclpy, except that padding is 0 and that nothing
follows the last field.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from enum import Enum
from functools import cache, lru_cache
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from roboxim_core.errors import RoboximError
from roboxim_core.poses import Pose
from roboxim_ros.schemas import message_schema, typestore

HEADER = "std_msgs/msg/Header"
Convert = Callable[[Any], Any]


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
        name: Full name of a message type with the same field names.

    Raises:
        InvalidRequestError: If the type is not installed on this machine.
        RoboximError: When the message has a field of a kind that is not converted here.
    """
    store = _store(name)
    return store.serialize_cdr(filled(value, name, store), name, little_endian=True)


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


def filled(value: Any, name: str, store: Typestore) -> Any:
    """Return a dataclass as a message of a store, whose definition may be of an earlier version.

    Args:
        value: The dataclass.
        name: Full name of a message type with the same field names.
        store: Store that knows the type.

    Raises:
        RoboximError: When the message has a field of a kind that is not converted here.
    """
    return _filler(type(value), name, store)(value)  # type: ignore[arg-type]  # classes are hashable


@lru_cache(maxsize=256)
def _filler(cls: type, name: str, store: Typestore) -> Convert:
    hints, made = get_type_hints(cls), store.types[name]
    fields: list[tuple[str, Convert]] = []
    for field, kind in store.fielddefs[name][1]:
        if kind == (Nodetype.NAME, HEADER) and field not in hints:
            fields.append(("stamp_ns", lambda stamp_ns: header_message(stamp_ns, "")))
        else:
            convert = _converter(hints.get(field), kind, store)
            if convert is None:
                raise RoboximError(f"field '{field}' of {name}: {hints.get(field)} is not converted here; add it")
            fields.append((field, convert))
    return lambda value: made(*[convert(getattr(value, field)) for field, convert in fields])


def _converter(hint: Any, kind: Any, store: Typestore) -> Convert | None:
    """Return what converts a field, by its annotation in the dataclass and its type in the message."""
    node, what = kind
    if hint is Pose:
        return pose_message
    if node == Nodetype.BASE:
        text = isinstance(hint, type) and issubclass(hint, str | Enum)
        return _same if (text if what[0] == "string" else hint in (bool, int, float)) else None
    if node == Nodetype.NAME:
        return _filler(hint, what, store) if dataclasses.is_dataclass(hint) else None  # type: ignore[arg-type]
    origin, args, element = get_origin(hint), get_args(hint), what[0][1]
    if origin is dict and args == (str, float):
        pair = store.types[element]
        return lambda values: [pair(name, value) for name, value in values.items()]
    if origin is not tuple:
        return None
    if dataclasses.is_dataclass(args[0]):
        fill = _filler(args[0], element, store)  # type: ignore[arg-type]  # classes are hashable
        return lambda values: [fill(value) for value in values]
    return {(float, "float64"): doubles, (str, "string"): _same}.get((args[0], element[0]))


def _same(value: Any) -> Any:
    return value
