"""Writes the core's values as serialised messages, without a message in between.

rclpy copies a Python message field by field into a C message before it serialises that one, and the Python message must
be made first. Both take most of the time for the nested messages of a tick. `CdrWriter` appends fields to the
serialised message; `to_cdr` does so for a whole dataclass, by the rules of `roboxim_ros.conversions.to_msg`. The bytes
are those of rclpy, except that padding is 0 and that nothing follows the last field.

Source: OMG DDS-XTypes 1.3, section 7.4.1 (plain CDR, version 1, little-endian).
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Sequence
from enum import Enum
from functools import cache, lru_cache
from typing import Any, get_args, get_origin, get_type_hints

import numpy.typing as npt

from roboxim_core.errors import RoboximError
from roboxim_core.poses import Pose
from roboxim_ros.conversions import element_class

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation: little-endian plain CDR. Alignment counts from behind it."""
_PADDING = tuple(map(bytes, range(8)))
_pack_uint32 = struct.Struct("<I").pack
_pack_time = struct.Struct("<iI").pack
_pack_pose = struct.Struct("<7d").pack
_SCALARS = {
    "boolean": "<?", "uint8": "<B", "int32": "<i", "uint32": "<I", "int64": "<q", "uint64": "<Q", "double": "<d",
}  # fmt: skip
Write = Callable[["CdrWriter", Any], None]


class CdrWriter:
    """A serialised message that grows; ``data`` is what there is of it."""

    __slots__ = ("data",)

    def __init__(self) -> None:
        """Begin a message."""
        self.data = bytearray(HEADER)

    def align(self, size: int) -> None:
        """Pad to a multiple of ``size`` bytes."""
        gap = (len(HEADER) - len(self.data)) % size
        if gap:
            self.data += _PADDING[gap]

    def scalar(self, packer: struct.Struct, value: Any) -> None:
        """Append a number or a truth value."""
        self.align(packer.size)
        self.data += packer.pack(value)

    def uint32(self, value: int) -> None:
        """Append a uint32, or the number of elements of a sequence."""
        self.align(4)
        self.data += _pack_uint32(value)

    def text(self, value: str) -> None:
        """Append a string."""
        self.align(4)
        self.data += _encoded(value)

    def texts(self, values: Sequence[str]) -> None:
        """Append a sequence of strings."""
        self.uint32(len(values))
        for value in values:
            self.text(value)

    def time(self, stamp_ns: int) -> None:
        """Append a ``builtin_interfaces/Time``."""
        self.align(4)
        self.data += _pack_time(*divmod(stamp_ns, 1_000_000_000))

    def header(self, stamp_ns: int, frame: str) -> None:
        """Append a ``std_msgs/Header``."""
        self.time(stamp_ns)
        self.text(frame)

    def pose(self, pose: Pose) -> None:
        """Append a ``geometry_msgs/Pose`` or ``Transform``."""
        self.align(8)
        self.data += _pack_pose(*pose.position, *pose.quat_xyzw)

    def double_array(self, values: Sequence[float]) -> None:
        """Append an array of doubles, of fixed length."""
        self.align(8)
        self.data += _doubles(len(values)).pack(*values)

    def doubles(self, values: Sequence[float]) -> None:
        """Append a sequence of doubles."""
        self.uint32(len(values))
        if values:
            self.double_array(values)

    def elements(self, array: npt.NDArray[Any], size: int, count: int) -> None:
        """Append a sequence whose elements lie in a C-contiguous, little-endian array without padding.

        Args:
            array: The elements.
            size: Alignment of an element [B].
            count: How many there are.
        """
        self.uint32(count)
        if count:
            self.align(size)
            self.data += array.data.cast("B")


@lru_cache(maxsize=4096)
def _encoded(text: str) -> bytes:
    data = text.encode()
    return _pack_uint32(len(data) + 1) + data + b"\x00"


@cache
def _doubles(count: int) -> struct.Struct:
    return struct.Struct(f"<{count}d")


def to_cdr(value: Any, msg_cls: Any) -> bytearray:
    """Return a dataclass as a serialised message.

    Args:
        value: The dataclass.
        msg_cls: Message class with the same field names.

    Raises:
        RoboximError: When the message has a field of a kind that is not written here.
    """
    writer = CdrWriter()
    _write_all(writer, value, _fields(type(value), msg_cls))  # type: ignore[arg-type]  # classes are hashable
    return writer.data


def _write_all(writer: CdrWriter, value: Any, fields: tuple[tuple[str, Write], ...]) -> None:
    for name, write in fields:
        write(writer, getattr(value, name))


@cache
def _fields(cls: type, msg_cls: Any) -> tuple[tuple[str, Write], ...]:
    """Return how the fields of a dataclass are written, in the message's order."""
    hints = get_type_hints(cls)
    fields: list[tuple[str, Write]] = []
    for name, kind in msg_cls.get_fields_and_field_types().items():
        if kind == "std_msgs/Header" and name not in hints:
            fields.append(("stamp_ns", lambda writer, stamp_ns: writer.header(stamp_ns, "")))
        else:
            fields.append((name, _write(name, hints.get(name), kind, msg_cls)))
    return tuple(fields)


def _write(name: str, hint: Any, kind: str, msg_cls: Any) -> Write:
    """Return how a field is written, by its annotation in the dataclass and its type in the message."""
    origin, args = get_origin(hint), get_args(hint)
    if hint is Pose:
        return CdrWriter.pose
    if kind == "string" and isinstance(hint, type) and issubclass(hint, str | Enum):
        return CdrWriter.text
    if kind in _SCALARS and hint in (bool, int, float):
        packer = struct.Struct(_SCALARS[kind])
        return lambda writer, value: writer.scalar(packer, value)
    if dataclasses.is_dataclass(hint):
        fields = _fields(hint, element_class(msg_cls, name))  # type: ignore[arg-type]
        return lambda writer, value: _write_all(writer, value, fields)
    if origin is tuple and args[0] is float and kind == "sequence<double>":
        return CdrWriter.doubles
    if origin is tuple and args[0] is float and kind.startswith("double["):
        return CdrWriter.double_array
    if origin is tuple and args[0] is str and kind == "sequence<string>":
        return CdrWriter.texts
    if origin is tuple and dataclasses.is_dataclass(args[0]):
        return _write_sequence(_fields(args[0], element_class(msg_cls, name)))  # type: ignore[arg-type]
    if origin is dict and args == (str, float):
        return _write_named_values
    raise RoboximError(f"field '{name}' of {msg_cls.__name__}: {kind} from {hint} is not written here; add it")


def _write_sequence(fields: tuple[tuple[str, Write], ...]) -> Write:
    def write(writer: CdrWriter, values: Sequence[Any]) -> None:
        writer.uint32(len(values))
        for value in values:
            _write_all(writer, value, fields)

    return write


def _write_named_values(writer: CdrWriter, values: dict[str, float]) -> None:
    writer.uint32(len(values))
    for name, value in values.items():
        writer.text(name)
        writer.double_array((value,))
