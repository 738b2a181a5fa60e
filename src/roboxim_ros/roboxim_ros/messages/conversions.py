"""Conversion between messages and the core's values, by field name: one mechanism for all types.

A message and its dataclass have the same field names; the dataclass's annotations define the conversion. The types
differ here:

- `Pose` is ``geometry_msgs/Pose``;
- ``dict[str, str]`` is ``diagnostic_msgs/KeyValue[]``; ``dict[str, Scalar]`` too, with the values as JSON scalars;
- ``dict[str, float]`` is ``NamedValue[]``; a dict of dataclasses is an array of two-field messages (key, value);
- a dataclass's ``stamp_ns`` may be a message's ``header.stamp``;
- a `StrEnum` is a ``string``;
- an optional dataclass is an array of 0 or 1 elements.

`from_msg` only reads attributes. It therefore also converts objects deserialised by `rosbags`, without a ROS
installation.
"""

from __future__ import annotations

import array
import dataclasses
import json
import sys
import types
from collections.abc import Callable
from enum import Enum
from functools import cache, partial
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.errors import ConfigError, InvalidRequestError, RoboximError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.poses import Pose

T = TypeVar("T")
Convert = Callable[[Any], Any]


def stamp_to_ns(stamp: Any) -> int:
    """Convert a ``builtin_interfaces/Time`` to nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def fill_stamp(stamp: Any, stamp_ns: int) -> Any:
    """Set a ``builtin_interfaces/Time`` to nanoseconds and return it."""
    stamp.sec, stamp.nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return stamp


def pose_from_msg(msg: Any) -> Pose:
    """Convert a ``geometry_msgs/Pose``.

    Raises:
        InvalidRequestError: When the pose is not finite or its quaternion is not of unit norm.
    """
    p, q = msg.position, msg.orientation
    return Pose(position=(p.x, p.y, p.z), quat_xyzw=(q.x, q.y, q.z, q.w))


def fill_pose(msg: Any, pose: Pose) -> Any:
    """Set a ``geometry_msgs/Pose`` and return it."""
    p, q = msg.position, msg.orientation
    p.x, p.y, p.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.quat_xyzw)
    return msg


def element_class(msg_cls: Any, field: str) -> Any:
    """Return the message class of a field or of its elements."""
    kind = msg_cls.get_fields_and_field_types()[field].removeprefix("sequence<").rstrip(">")
    package, _, name = kind.split("[")[0].split(",")[0].partition("/")
    module = sys.modules.get(f"{package}.msg") or __import__(f"{package}.msg", fromlist=[name])
    return getattr(module, name)


def _optional_of(kind: Any) -> Any:
    if get_origin(kind) in (Union, types.UnionType):
        rest = [k for k in get_args(kind) if k is not type(None)]
        if len(rest) == 1 and dataclasses.is_dataclass(rest[0]):
            return rest[0]
    return None


def to_msg(value: Any, msg_cls: type[T]) -> T:
    """Convert a dataclass to a message.

    Args:
        value: The dataclass.
        msg_cls: Message class with the same field names.
    """
    msg = msg_cls()
    for name, set_field in _setters(type(value), msg_cls):  # type: ignore[arg-type]  # classes are hashable
        set_field(msg, getattr(value, name))
    return msg


@cache
def _setters(cls: type, msg_cls: Any) -> list[tuple[str, Callable[[Any, Any], None]]]:
    hints = get_type_hints(cls)
    slots = msg_cls.get_fields_and_field_types()
    setters = []
    for field in dataclasses.fields(cls):
        if field.name in slots:
            setters.append((field.name, _setter(field.name, hints[field.name], msg_cls)))
        elif field.name == "stamp_ns" and "header" in slots:
            setters.append((field.name, lambda msg, value: fill_stamp(msg.header.stamp, value)))
        else:
            raise RoboximError(f"{msg_cls.__name__} has no field '{field.name}' of {cls.__name__}")
    return setters


def _setter(name: str, kind: Any, msg_cls: Any) -> Callable[[Any, Any], None]:
    if kind is Pose:
        return lambda msg, value: fill_pose(getattr(msg, name), value)
    convert = _encoder(name, kind, msg_cls)
    return lambda msg, value: setattr(msg, name, convert(value))


def _encoder(name: str, kind: Any, msg_cls: Any) -> Convert:
    if dataclasses.is_dataclass(kind):
        inner = element_class(msg_cls, name)
        return lambda value: to_msg(value, inner)
    optional = _optional_of(kind)
    if optional is not None:
        inner = element_class(msg_cls, name)
        return lambda value: [] if value is None else [to_msg(value, inner)]
    origin, args = get_origin(kind), get_args(kind)
    if origin is dict:
        return _dict_encoder(args[1], element_class(msg_cls, name))
    if origin is tuple and dataclasses.is_dataclass(args[0]):
        inner = element_class(msg_cls, name)
        return lambda value: [to_msg(item, inner) for item in value]
    if origin is tuple and args[0] is float and _is_sequence_of_doubles(msg_cls, name):
        return lambda value: array.array("d", value)
    if origin is tuple:
        return list
    if kind is float:
        return float  # rclpy takes the bytes of an int for those of a float
    return lambda value: value


def _is_sequence_of_doubles(msg_cls: Any, name: str) -> bool:
    return bool(msg_cls.get_fields_and_field_types()[name] == "sequence<double>")


def _dict_encoder(kind: Any, pair: Any) -> Convert:
    key_field, value_field = pair.get_fields_and_field_types()
    if dataclasses.is_dataclass(kind):
        inner = element_class(pair, value_field)
        encode: Convert = lambda value: to_msg(value, inner)  # noqa: E731
    elif kind in (str, float):
        encode = kind
    else:
        encode = json.dumps
    return lambda items: [pair(**{key_field: key, value_field: encode(value)}) for key, value in items.items()]


def from_msg(msg: Any, cls: type[T]) -> T:
    """Convert a message, or an object with its attributes, to a dataclass.

    A message of an older version, from a bag, may lack fields that have a default. The default of a field that is added
    must therefore describe what was recorded before. A class that sets ``NO_DEFAULTS_WHEN_READ`` needs every field.

    Args:
        msg: The message.
        cls: Dataclass with the same field names.

    Raises:
        InvalidRequestError: When a value does not fit the class or fails the class's own checks.
    """
    getters = _getters(cls)  # type: ignore[arg-type]  # classes are hashable
    return cls(**{name: get_field(msg) for name, get_field in getters})


@cache
def _getters(cls: type) -> list[tuple[str, Convert]]:
    hints = get_type_hints(cls)
    getter = _field_getter if getattr(cls, "NO_DEFAULTS_WHEN_READ", False) else _field_getter_or_default
    return [(field.name, getter(field, hints[field.name])) for field in dataclasses.fields(cls)]


def _field_getter(field: dataclasses.Field[Any], kind: Any) -> Convert:
    return _getter(field.name, kind)


def _field_getter_or_default(field: dataclasses.Field[Any], kind: Any) -> Convert:
    get = _field_getter(field, kind)
    if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        return get

    def get_or_default(msg: Any) -> Any:
        try:
            return get(msg)
        except AttributeError:
            if hasattr(msg, field.name):
                raise
            return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()

    return get_or_default


def _items(kind: Any, values: Any) -> tuple[Any, ...]:
    """Return a sequence's items: of an array in one call, since its numbers are Python's already."""
    if kind is float and hasattr(values, "tolist"):
        items = values.tolist()
        if not items or type(items[0]) is float:
            return tuple(items)
    return tuple(map(kind, values))


def _getter(name: str, kind: Any) -> Convert:
    decode = _decoder(kind)
    if name != "stamp_ns":
        return lambda msg: decode(getattr(msg, name))

    def stamp(msg: Any) -> int:
        value = getattr(msg, "stamp_ns", None)
        return stamp_to_ns(msg.header.stamp) if value is None else int(value)

    return stamp


def _decoder(kind: Any) -> Convert:
    if kind is Pose:
        return pose_from_msg
    if dataclasses.is_dataclass(kind):
        return lambda value: from_msg(value, cast(type[Any], kind))
    optional = _optional_of(kind)
    if optional is not None:
        return lambda value: from_msg(value[0], optional) if len(value) else None
    origin, args = get_origin(kind), get_args(kind)
    if origin is dict:
        return _dict_decoder(args[1])
    if origin is tuple and dataclasses.is_dataclass(args[0]):
        return lambda value: tuple(from_msg(item, args[0]) for item in value)
    if origin is tuple:
        return partial(_items, args[0])
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _enum_decoder(kind)
    if kind in (int, float, bool, str):
        return cast(Convert, kind)
    return lambda value: value


def _enum_decoder(kind: type[Enum]) -> Convert:
    def decode(value: Any) -> Any:
        try:
            return kind(value)
        except ValueError as error:
            raise InvalidRequestError(str(error)) from None

    return decode


def scalar_from_json(text: str) -> str | float | int | bool:
    """Return the value of JSON text that must be a string, a number, true or false.

    Raises:
        InvalidRequestError: When it is anything else.
    """
    try:
        value = parse_json(text, source="the value", max_bytes=limits.SHORT_TEXT_CHARACTERS)
    except ConfigError as error:
        problem = f": {error}"
    else:
        if isinstance(value, str | bool) or (isinstance(value, int | float) and -(2**63) <= value < 2**64):
            return value
        problem = ""
    raise InvalidRequestError(
        f'values must be JSON scalars such as "red" (with quotes), 0.05 or true, got {limits.echo(text)}{problem}'
    )


def _dict_decoder(kind: Any) -> Convert:
    if dataclasses.is_dataclass(kind):
        return lambda pairs: {pair.role: from_msg(pair.object, cast(type[Any], kind)) for pair in pairs}
    if kind is float:
        return lambda pairs: {pair.name: float(pair.value) for pair in pairs}
    if kind is str:
        return lambda pairs: {pair.key: pair.value for pair in pairs}

    def scalars(pairs: Any) -> dict[str, Any]:
        return {pair.key: scalar_from_json(pair.value) for pair in pairs}

    return scalars


_ENCODINGS = {"rgb8": (np.uint8, 3), "32FC1": (np.float32, 1), "16UC1": (np.uint16, 1), "mono8": (np.uint8, 1)}


def fill_image(msg: Any, image: npt.NDArray[Any], encoding: str) -> Any:
    """Set a ``sensor_msgs/Image`` from an array and return it.

    Args:
        msg: The message.
        image: Shape (height, width) or (height, width, channels), of the encoding's type.
        encoding: ``rgb8``, ``32FC1`` or ``16UC1``.
    """
    data = np.ascontiguousarray(image, dtype=_ENCODINGS[encoding][0])
    msg.height, msg.width = data.shape[:2]
    msg.encoding = encoding
    msg.is_bigendian = 0
    msg.step = data.strides[0]
    msg.data = array.array("B", data.tobytes())
    return msg


def image_from_msg(msg: Any) -> npt.NDArray[Any]:
    """Return a read-only array of shape (height, width) or (height, width, 3).

    It shares the message's memory, unless the message has the other byte order.

    Raises:
        InvalidRequestError: On an unknown encoding, or a size that does not fit the data.
    """
    try:
        scalar, channels = _ENCODINGS[msg.encoding]
    except KeyError:
        raise InvalidRequestError(
            f"image encoding '{msg.encoding}' is not supported; expected one of {', '.join(_ENCODINGS)}"
        ) from None
    dtype = np.dtype(scalar)
    size = int(msg.height) * int(msg.width) * channels * dtype.itemsize
    if not size:
        raise InvalidRequestError(f"an image of {msg.width}x{msg.height} has no pixels")
    if len(msg.data) != size:
        raise InvalidRequestError(
            f"an image of {msg.width}x{msg.height} {msg.encoding} has {len(msg.data)} bytes, expected {size}: rows "
            "must have no padding"
        )
    stored = np.frombuffer(msg.data, dtype.newbyteorder(">" if msg.is_bigendian else "<"))
    image = stored.astype(dtype, copy=False)
    image = image.reshape((msg.height, msg.width, channels) if channels > 1 else (msg.height, msg.width))
    image.flags.writeable = False
    return image
