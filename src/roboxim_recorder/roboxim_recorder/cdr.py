"""Removes the undefined bytes of serialised messages.

A middleware leaves the padding between a message's fields uninitialised and rounds the message's length up. These bytes
differ from run to run and may hold anything. `MessageLayout.clean` sets padding to 0 and cuts the rest off, without
decoding the message: a function that is made once for each type walks over it. The walk also returns the fields'
positions, so that a stamp or a checksum is read without decoding.

Source: OMG DDS-XTypes 1.3, section 7.4.1 (plain CDR, version 1).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from roboxim_core.errors import InvalidRequestError
from roboxim_ros.messages.schemas import MessageSchema, typestore

Cdr = bytes | bytearray | memoryview
"""A serialised message."""
ORIGIN = 4
"""Position from which alignment counts: after the encapsulation header [B]."""
_SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "octet", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
_unpack_uint32 = struct.Struct("<I").unpack_from
_unpack_int64 = struct.Struct("<q").unpack_from
_unpack_time = struct.Struct("<iI").unpack_from


class CleanMessage:
    """A message without undefined bytes."""

    __slots__ = ("_layout", "_offsets", "data")

    def __init__(self, data: bytearray, offsets: tuple[int, ...], layout: MessageLayout) -> None:
        """Store the results of a walk; `MessageLayout.clean` creates the instances."""
        self.data = data
        """The serialised message with its encapsulation header."""
        self._offsets = offsets
        self._layout = layout

    @property
    def name(self) -> str:
        """The message's type."""
        return self._layout.name

    def __contains__(self, field: object) -> bool:
        """Return whether the message's type has a field."""
        return field in self._layout.fields

    def _at(self, field: str) -> int:
        return self._offsets[self._layout.fields[field]]

    def uint32(self, field: str) -> int:
        """Return a uint32 field."""
        number: int = _unpack_uint32(self.data, self._at(field))[0]
        return number

    def int64(self, field: str) -> int:
        """Return an int64 field."""
        number: int = _unpack_int64(self.data, self._at(field))[0]
        return number

    def text(self, field: str) -> str:
        """Return a string field."""
        at = self._at(field)
        return self.data[at + 4 : at + 3 + _unpack_uint32(self.data, at)[0]].decode()

    def time_ns(self, field: str) -> int:
        """Return a field that is a Time, or a structure that begins with one, such as a Header [ns]."""
        seconds, nanoseconds = _unpack_time(self.data, self._at(field))
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def count(self, field: str) -> int:
        """Return the number of elements of a sequence field."""
        return self.uint32(field)

    def bytes_of(self, field: str) -> memoryview:
        """Return the elements of a uint8 sequence field, without a copy."""
        at = self._at(field)
        return memoryview(self.data)[at + 4 : at + 4 + _unpack_uint32(self.data, at)[0]]

    def clear(self, field: str) -> None:
        """Set a 64-bit number field to 0."""
        at = self._at(field)
        self.data[at : at + 8] = bytes(8)

    def stamp_ns(self) -> int | None:
        """Return the message's simulated time [ns]; None when its type has none, or it is an empty list."""
        if "stamp_ns" in self:
            return self.int64("stamp_ns")
        for field in ("header", "clock", "stamp"):
            if field in self:
                return self.time_ns(field)
        if "transforms" in self and self.count("transforms"):
            seconds, nanoseconds = _unpack_time(self.data, self._at("transforms") + 4)
            return int(seconds) * 1_000_000_000 + int(nanoseconds)
        return None


class MessageLayout:
    """Layout of the messages of one type in plain little-endian CDR."""

    def __init__(self, store: Typestore, name: str) -> None:
        """Make the walk of a type.

        Args:
            store: Store with the type.
            name: Its full name, e.g. ``sensor_msgs/msg/Image``.

        Raises:
            InvalidRequestError: When the type has fields that bags cannot hold (``wstring``, ``float128``).
        """
        self.name = name
        self.fields = {field: index for index, (field, _) in enumerate(store.fielddefs[name][1])}
        """The type's own fields to their order."""
        self._walk = _WalkSource(store, name).compile()

    def clean(self, cdr: bytes | memoryview) -> CleanMessage:
        """Copy a message without its undefined bytes.

        Args:
            cdr: The serialised message with its encapsulation header.

        Raises:
            SerdeError: When the bytes are not such a message.
        """
        if bytes(cdr[:2]) != b"\x00\x01":
            raise SerdeError(f"{self.name}: expected little-endian CDR, got encapsulation {bytes(cdr[:2]).hex()}")
        data = bytearray(cdr)
        data[2:4] = b"\x00\x00"
        try:
            end, offsets = self._walk(data)
        except (struct.error, ValueError) as error:
            raise SerdeError(f"not a {self.name}: {error}") from error
        if end > len(cdr):
            raise SerdeError(f"not a {self.name}: it ends at byte {len(cdr)} instead of {end}")
        del data[end:]
        return CleanMessage(data, offsets, self)


@lru_cache(maxsize=256)
def message_layout(schema: MessageSchema) -> MessageLayout:
    """Return the layout of a schema's messages in CDR; made once per schema.

    Raises:
        InvalidRequestError: When the type has fields that bags cannot hold.
    """
    return MessageLayout(typestore((schema,)), schema.name)


Walk = Callable[[bytearray], tuple[int, tuple[int, ...]]]
_PADDING = tuple(map(bytes, range(8)))


class _WalkSource:
    """Writes the Python source of a type's walk.

    ``p`` is the walk's position in the buffer ``b``. While the source is written, the position is known to be
    ``self._rest`` modulo ``self._step``, counted from the origin, and ``self._ahead`` bytes beyond ``p``: where both
    rule out padding, nothing is written, and runs of fields of known sizes become one addition.
    """

    def __init__(self, store: Typestore, name: str) -> None:
        self._store = store
        self._name = name
        self._lines: list[str] = []
        self._indent = 1
        self._step, self._rest, self._ahead = 8, 0, 0
        self._loops = 0

    def compile(self) -> Walk:
        """Return the walk: it gives the end of the message and the positions of its fields."""
        offsets: list[str] = []
        for field, kind in self._members(self._name):
            self._align(self._alignment(kind))
            self._settle()
            self._write(f"at_{len(offsets)} = p")
            offsets.append(f"at_{len(offsets)}")
            self._field(kind, f"{self._name}.{field}")
        self._settle()
        body = "\n".join(self._lines)
        source = f"def walk(b):\n p = {ORIGIN}\n{body}\n return p, ({', '.join(offsets)},)\n"
        names: dict[str, Any] = {"U": _unpack_uint32, "Z": _PADDING}
        exec(compile(source, f"<walk of {self._name}>", "exec"), names)
        walk: Walk = names["walk"]
        return walk

    def _write(self, line: str) -> None:
        self._lines.append(" " * self._indent + line)

    def _settle(self) -> None:
        """Make ``p`` the position itself."""
        if self._ahead:
            self._write(f"p += {self._ahead}")
            self._ahead = 0

    def _advance(self, size: int) -> None:
        self._ahead += size
        self._rest = (self._rest + size) % self._step

    def _forget(self, step: int = 1) -> None:
        """Forget the position, except that it is a multiple of ``step``."""
        self._step, self._rest = step, 0

    def _align(self, size: int) -> None:
        """Write code that clears the padding before a field with an alignment."""
        if self._step % size == 0:
            gap = -self._rest % size
            if gap:
                self._settle()
                self._write(f"b[p:p + {gap}] = Z[{gap}]")
                self._advance(gap)
            return
        self._settle()
        self._write(f"g = {ORIGIN} - p & {size - 1}")
        self._write("if g:")
        self._write(" b[p:p + g] = Z[g]")
        self._write(" p += g")
        self._forget(size)

    def _members(self, name: str) -> list[tuple[str, Any]]:
        if name not in self._store.fielddefs:
            raise InvalidRequestError(f"{self._name} has fields of type {name}, which bags cannot hold")
        return list(self._store.fielddefs[name][1])

    def _alignment(self, kind: Any) -> int:
        """Return the alignment of a field's first element."""
        node, what = kind
        if node == Nodetype.BASE:
            return 4 if what[0] == "string" else self._size(what[0])
        if node == Nodetype.NAME:
            return self._alignment(self._members(what)[0][1])
        return self._alignment(what[0]) if node == Nodetype.ARRAY else 4

    def _size(self, base: str) -> int:
        if base not in _SIZES:
            raise InvalidRequestError(f"{self._name} has fields of type {base}, which bags cannot hold")
        return _SIZES[base]

    def _field(self, kind: Any, where: str) -> None:
        node, what = kind
        if node == Nodetype.BASE and what[0] == "string":
            self._string()
        elif node == Nodetype.BASE:
            size = self._size(what[0])
            self._align(size)
            self._advance(size)
        elif node == Nodetype.NAME:
            for field, inner in self._members(what):
                self._field(inner, f"{what}.{field}")
        elif node == Nodetype.ARRAY:
            self._array(what[0], what[1], where)
        else:
            self._sequence(what[0], where)

    def _string(self) -> None:
        self._align(4)
        self._write(f"p += {self._ahead + 4} + U(b, p + {self._ahead})[0]")
        self._ahead = 0
        self._forget()

    def _array(self, element: Any, length: int, where: str) -> None:
        block = self._block(element)
        if block:
            self._align(block[0])
            self._advance(block[1] * length)
        else:
            self._loop(element, str(length), where)

    def _sequence(self, element: Any, where: str) -> None:
        self._align(4)
        self._settle()
        count = f"n{self._loops}"
        self._write(f"{count} = U(b, p)[0]")
        self._advance(4)
        block = self._block(element)
        if not block:
            self._write(f"if {count} > len(b):")
            self._write(f" raise ValueError('{where} has %d elements' % {count})")
            self._loop(element, count, where)
            return
        align, size = block
        self._settle()
        if self._step % align or self._rest % align:  # an empty sequence is not aligned
            self._write(f"if {count}:")
            self._indent += 1
            self._align(align)
            self._settle()
            self._write(f"p += {size} * {count}")
            self._indent -= 1
        else:
            self._write(f"p += {size} * {count}")
        self._forget(min(4, align) if size % min(4, align) == 0 else 1)

    def _loop(self, element: Any, count: str, where: str) -> None:
        self._settle()
        self._loops += 1
        self._write(f"for _ in range({count}):")
        self._indent += 1
        self._forget()
        self._field(element, where)
        self._settle()
        self._indent -= 1
        self._forget()

    def _block(self, kind: Any) -> tuple[int, int] | None:
        """Return the alignment and size of a type whose sequences have no padding; None if padding can occur."""
        node, what = kind
        if node == Nodetype.BASE:
            return None if what[0] == "string" else (self._size(what[0]),) * 2
        if node == Nodetype.SEQUENCE:
            return None
        if node == Nodetype.ARRAY:
            inner = self._block(what[0])
            return inner and (inner[0], inner[1] * what[1])
        parts = [self._block(inner) for _, inner in self._members(what)]
        first = parts[0]
        total = 0
        for part in parts:
            if first is None or part is None or part[0] > first[0] or total % part[0]:
                return None
            total += part[1]
        return (first[0], total) if first and total % first[0] == 0 else None
