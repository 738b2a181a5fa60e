"""Serialises dataclasses as messages, by functions that are made once for each pair of dataclass and message type.

Such a function collects the numbers and texts of a dataclass in the order of the message's fields, and the sizes of its
texts and sequences. The sizes determine all positions, so one `struct.Struct` serves all values of equal sizes: an
episode's ticks share a few. Filling a message of `rosbags` first and traversing it takes three times as long.

Source of the layout: OMG DDS-XTypes 1.3, section 7.4.1 (plain CDR, version 1).
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from functools import lru_cache
from typing import Any, get_args, get_origin, get_type_hints

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from roboxim_core.errors import RoboximError
from roboxim_core.poses import Pose

HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
ENCAPSULATION = b"\x00\x01\x00\x00"
"""First bytes of a serialised message: plain CDR, little-endian."""
Packer = Callable[[Any], memoryview]
_CODES = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
"""Base types to the codes of `struct`."""
_SEQUENCES = {(float, "float64"), (int, "uint32"), (str, "string")}
"""Elements of tuples and of the sequences that they become."""


def packer(cls: type, name: str, store: Typestore) -> Packer:
    """Return a function that serialises a dataclass by the rules of `roboxim_ros.messages.conversions.to_msg`.

    Enums become texts, poses separate messages, dictionaries lists of ``NamedValue``. A header or a time that the
    dataclass lacks is made from its ``stamp_ns``, the header's frame from its ``frame_id`` if it has one. Padding is 0;
    nothing follows the last field.

    Args:
        cls: The dataclass.
        name: Full name of a message type whose fields it has; it may have others.
        store: Store with the type.

    Raises:
        RoboximError: When the message has a field of a kind that is not converted here.
    """
    return _packer(cls, name, store)


@lru_cache(maxsize=256)
def _packer(cls: type, name: str, store: Typestore) -> Packer:
    source = _Source(store)
    source.fields(cls, name, "v")
    layout = _Layout(source.layout)
    names: dict[str, Any] = {"struct_of": lru_cache(maxsize=1024)(layout.of), "encoded": _encoded}
    packed = f"struct_of(tuple(s)).pack({ENCAPSULATION!r}, *o)"
    code = f"def pack(v):\n s = []\n o = []\n{source.text()}\n return memoryview({packed})\n"
    exec(compile(code, f"<packer of {name}>", "exec"), names)
    pack: Packer = names["pack"]
    return pack


@lru_cache(maxsize=1024)
def _encoded(texts: Sequence[str]) -> tuple[tuple[int, ...], tuple[int | bytes, ...]]:
    """Return the sizes of texts with their final zeros, and the values to write: sizes and texts alternately."""
    found = [text.encode() for text in texts]
    sizes = tuple(len(one) + 1 for one in found)
    return sizes, tuple(part for size, one in zip(sizes, found, strict=True) for part in (size, one))


# ------------------------------------------------------------------------- layout


class _Layout:
    """Positions of a message's fields, by the sizes of its texts and sequences.

    The layout is a list of steps: a code of `struct` for a number; `TEXT`; ``(code, None)`` for a sequence of numbers,
    `TEXTS` for one of texts, and ``("", steps)`` for one of messages.
    """

    TEXT, TEXTS = "text", "texts"

    def __init__(self, steps: list[Any]) -> None:
        self._steps = steps

    def of(self, sizes: tuple[Any, ...]) -> struct.Struct:
        """Return the layout for the sizes of texts and sequences, in the order of the fields."""
        return struct.Struct("<4s" + "".join(self._codes(self._steps, iter(sizes), [0])))

    def _codes(self, steps: list[Any], sizes: Iterator[Any], at: list[int]) -> Iterator[str]:
        for step in steps:
            if step == self.TEXT:
                yield from self._text(next(sizes), at)
            elif step == self.TEXTS:
                yield self._number("I", at)
                for size in next(sizes):
                    yield from self._text(size, at)
            elif isinstance(step, str):
                yield self._number(step, at)
            else:
                code, inner = step
                yield self._number("I", at)
                for _ in range(next(sizes)):
                    yield from [self._number(code, at)] if inner is None else self._codes(inner, sizes, at)

    def _text(self, size: int, at: list[int]) -> Iterator[str]:
        yield self._number("I", at)
        at[0] += size
        yield f"{size}s"

    @staticmethod
    def _number(code: str, at: list[int]) -> str:
        size = struct.calcsize(f"<{code}")
        padding = -at[0] % size
        at[0] += padding + size
        return f"{padding}x{code}" if padding else code


# ------------------------------------------------------------------------- collecting values


class _Source:
    """Writes the source that collects the values of a dataclass in ``o`` and its sizes in ``s``."""

    def __init__(self, store: Typestore) -> None:
        self.layout: list[Any] = []
        """See `_Layout`."""
        self._store = store
        self._lines: list[str] = []
        self._values: list[str] = []
        self._sizes: list[str] = []
        self._indent, self._names = 1, 0

    def text(self) -> str:
        """Return the lines."""
        self._settle()
        return "\n".join(self._lines)

    def fields(self, cls: type, name: str, value: str) -> None:
        """Write the fields of a message that a dataclass becomes; ``value`` is the expression of the dataclass."""
        hints = get_type_hints(cls)
        for field, kind in self._store.fielddefs[name][1]:
            hint = hints.get(field)
            if hint is None and kind == (Nodetype.NAME, HEADER):
                self._time(f"{value}.stamp_ns")
                self._text(f"{value}.frame_id" if "frame_id" in hints else "''")
            elif hint is None and kind == (Nodetype.NAME, TIME):
                self._time(f"{value}.stamp_ns")
            elif not self._field(hint, kind, f"{value}.{field}"):
                raise RoboximError(f"field '{field}' of {name}: {hint} is not converted here; add it")

    def _field(self, hint: Any, kind: Any, value: str) -> bool:
        """Write a field by its annotation in the dataclass and its type in the message; return false if impossible."""
        node, what = kind
        if hint is Pose:
            self._numbers("ddddddd", f"*{value}.position", f"*{value}.quat_xyzw")
        elif node == Nodetype.BASE and what[0] == "string":
            if not (isinstance(hint, type) and issubclass(hint, str | Enum)):
                return False
            self._text(value)
        elif node == Nodetype.BASE:
            if hint not in (bool, int, float):
                return False
            self._numbers(_CODES[what[0]], value)
        elif node == Nodetype.NAME:
            if not dataclasses.is_dataclass(hint):
                return False
            self.fields(hint, what, value)  # type: ignore[arg-type]
        else:
            return self._many(hint, kind, value)
        return True

    def _many(self, hint: Any, kind: Any, value: str) -> bool:
        """Write an array or a sequence."""
        origin, args, (node, what) = get_origin(hint), get_args(hint), kind
        element = what[0][1]
        if node == Nodetype.ARRAY:
            if origin is not tuple or (args[0], element[0]) != (float, "float64"):
                return False
            self._numbers("d" * what[1], f"*{value}")
        elif origin is dict and args == (str, float):
            self._loop(f"{value}.items()", self._named_value)
        elif origin is tuple and dataclasses.is_dataclass(args[0]):
            self._loop(value, lambda item: self.fields(args[0], element, item))
        elif origin is tuple and (args[0], element[0]) in _SEQUENCES:
            if element[0] == "string":
                sizes, texts = self._name(), self._name()
                self._values.append(f"len({value})")
                self._settle()
                self._write(f"{sizes}, {texts} = encoded({value})")
                self._values.append(f"*{texts}")
                self._sizes.append(sizes)
                self.layout.append(_Layout.TEXTS)
            else:
                self._count(value)
                self._values.append(f"*{value}")
                self.layout.append((_CODES[element[0]], None))
        else:
            return False
        return True

    def _named_value(self, item: str) -> None:
        self._text(f"{item}[0]")
        self._numbers("d", f"{item}[1]")

    def _numbers(self, codes: str, *values: str) -> None:
        self.layout += codes
        self._values += values

    def _time(self, stamp_ns: str) -> None:
        self._numbers("iI", f"*divmod({stamp_ns}, 1_000_000_000)")

    def _text(self, value: str) -> None:
        text, size = self._name(), self._name()
        self._values += (f"({size} := len({text} := {value}.encode()) + 1)", text)
        self._sizes.append(size)
        self.layout.append(_Layout.TEXT)

    def _count(self, value: str) -> None:
        size = self._name()
        self._values.append(f"({size} := len({value}))")
        self._sizes.append(size)

    def _loop(self, value: str, body: Callable[[str], None]) -> None:
        """Write a sequence of messages."""
        item, outer = self._name(), self.layout
        inner: list[Any] = []
        self._count(value)
        self._settle()
        self._write(f"for {item} in {value}:")
        self._indent, self.layout = self._indent + 1, inner
        body(item)
        self._settle()
        self._indent, self.layout = self._indent - 1, outer
        self.layout.append(("", inner))

    def _settle(self) -> None:
        """Write the collected values."""
        if self._values:
            self._write(f"o += ({', '.join(self._values)},)")
        if self._sizes:
            self._write(f"s += ({', '.join(self._sizes)},)")
        self._values, self._sizes = [], []

    def _write(self, line: str) -> None:
        self._lines.append(" " * self._indent + line)

    def _name(self) -> str:
        self._names += 1
        return f"n{self._names}"
