"""Messages by name: look-up of types, conversion from and to YAML, text of interface files.

Generated messages accept values of a wrong type, which then end the process inside the middleware. Every value is
therefore checked here.
"""

from __future__ import annotations

import array
import importlib
import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
)

from roboxim_core.errors import ConfigError, one_of

KINDS = ("msg", "srv", "action")
_INT_RANGES = {
    f"{sign}int{bits}": (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for bits in (8, 16, 32, 64)
    for sign in ("", "u")
} | {"octet": (0, 255)}
SHOWN_ELEMENTS = 64
"""Number of elements to which longer arrays are shortened, unless the user asks for all."""
WHOLE_MESSAGES, SHOWN_MESSAGES = 16, 4
"""Arrays of more messages than the first number, e.g. a trajectory's points, are shortened to the second: each message
takes several lines."""


def _share_folders() -> list[Path]:
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    return [Path(prefix, "share") for prefix in dict.fromkeys(prefixes) if prefix]


@cache
def interface_files() -> dict[str, Path]:
    """Return every installed interface, e.g. ``std_srvs/srv/Trigger``, and its file."""
    found = {}
    for share in reversed(_share_folders()):
        for kind in KINDS:
            for path in share.glob(f"*/{kind}/*.{kind}"):
                found[f"{path.parts[-3]}/{kind}/{path.stem}"] = path
    return dict(sorted(found.items()))


def look_up(name: str, kind: str) -> Any:
    """Import an interface class.

    Args:
        name: ``package/kind/Type`` or ``package/Type``.
        kind: ``msg``, ``srv`` or ``action``.

    Raises:
        ConfigError: When there is no such type; suggests one.
    """
    package, _, rest = name.partition("/")
    middle, _, type_name = rest.rpartition("/")
    full = f"{package}/{kind}/{type_name}"
    try:
        if middle in ("", kind):
            return getattr(importlib.import_module(f"{package}.{kind}"), type_name)
    except (ImportError, AttributeError):
        pass
    known = [known for known in interface_files() if f"/{kind}/" in known]
    same_package = [known_name for known_name in known if known_name.startswith(f"{package}/")]
    raise ConfigError(f"no {kind} type '{name}' is installed; {one_of(same_package or _packages(known), full)}")


def _packages(names: Sequence[str]) -> list[str]:
    return sorted({name.split("/")[0] for name in names})


def full_name(cls: Any) -> str:
    """Return ``package/kind/Type`` of an interface class."""
    package, kind = cls.__module__.split(".")[:2]
    return f"{package}/{kind}/{cls.__name__}"


def show(name: str) -> str:
    """Return the text of an interface file, comments included.

    Args:
        name: ``package/kind/Type`` or ``package/Type``.

    Raises:
        ConfigError: When there is no such interface.
    """
    files = interface_files()
    parts = name.split("/")
    for candidate in [name] if len(parts) == 3 else [f"{parts[0]}/{kind}/{parts[-1]}" for kind in KINDS]:
        if candidate in files:
            return files[candidate].read_text()
    raise ConfigError(f"no interface '{name}' is installed; {_near(name, list(files))}")


def _near(name: str, names: list[str]) -> str:
    same_package = [known for known in names if known.startswith(f"{name.split('/')[0]}/")]
    return one_of(same_package or _packages(names), name if same_package else name.split("/")[0])


def message_from_plain(cls: Any, data: Any, *, where: str = "") -> Any:
    """Build a message from plain data.

    Args:
        cls: Message class.
        data: Field name to value; fields left out keep their defaults. ``None``: all of them.
        where: Path of the message inside the user's message, for errors.

    Raises:
        ConfigError: When a field is unknown or does not fit; the message names it and the expected value.
    """
    message = cls()
    if data is None:
        return message
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where or cls.__name__}: expected fields of {full_name(cls)} as a mapping, got {data!r}")
    fields = dict(zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True))
    for name, value in data.items():
        path = f"{where}.{name}" if where else str(name)
        if name not in fields:
            raise ConfigError(f"unknown field '{path}' of {full_name(cls)}; {one_of(fields, str(name))}")
        setattr(message, name, _value(fields[name], value, path))
    return message


def _value(kind: Any, value: Any, path: str) -> Any:
    if isinstance(kind, NamespacedType):
        return message_from_plain(_class_of(kind), value, where=path)
    if isinstance(kind, Array | AbstractSequence):
        return _sequence(kind, value, path)
    if isinstance(kind, AbstractGenericString):
        if not isinstance(value, str):
            raise ConfigError(f"field '{path}': expected a string, got {value!r} (quote it)")
        return value
    return _scalar(kind.typename, value, path)


def _class_of(kind: NamespacedType) -> Any:
    return getattr(importlib.import_module(".".join(kind.namespaces)), kind.name)


def _scalar(typename: str, value: Any, path: str) -> Any:
    if typename == "boolean":
        if isinstance(value, bool):
            return value
        raise ConfigError(f"field '{path}': expected true or false, got {value!r}")
    if typename in ("float", "double"):
        if isinstance(value, int | float) and not isinstance(value, bool):
            return _float(typename, value, path)
        raise ConfigError(f"field '{path}': expected a number, got {value!r}")
    low, high = _INT_RANGES[typename]
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ConfigError(f"field '{path}': expected a whole number from {low} to {high}, got {value!r}")
    return bytes([value]) if typename == "octet" else value


def _float(typename: str, value: float, path: str) -> float:
    kind = np.float32 if typename == "float" else np.float64
    try:
        found = float(value)
        with np.errstate(over="ignore"):
            fits = math.isinf(found) or not np.isinf(kind(found))
    except OverflowError:  # a whole number of very many digits
        fits = False
    if not fits:
        largest = f"{np.finfo(kind).max:.8g}"
        raise ConfigError(f"field '{path}': expected a number from -{largest} to {largest}, got one beyond them")
    return found


def _sequence(kind: Any, value: Any, path: str) -> Any:
    if not isinstance(value, list):
        raise ConfigError(f"field '{path}': expected a list, got {value!r}")
    if isinstance(kind, Array) and len(value) != kind.size:
        raise ConfigError(f"field '{path}': expected {kind.size} elements, got {len(value)}")
    if isinstance(kind, BoundedSequence) and len(value) > kind.maximum_size:
        raise ConfigError(f"field '{path}': expected at most {kind.maximum_size} elements, got {len(value)}")
    items = [_value(kind.value_type, item, f"{path}[{i}]") for i, item in enumerate(value)]
    if isinstance(kind, Array) and isinstance(kind.value_type, BasicType):
        typename = {"float": "float32", "double": "float64"}.get(kind.value_type.typename, kind.value_type.typename)
        if typename not in ("boolean", "octet", "char"):
            return np.array(items, typename)  # the type in generated classes
    return items


def message_to_plain(message: Any, *, full: bool = False) -> Any:
    """Turn a message into dicts, lists and scalars.

    Args:
        message: The message.
        full: Keep long arrays; otherwise arrays are cut to `SHOWN_ELEMENTS` elements, arrays of more than
            `WHOLE_MESSAGES` messages to `SHOWN_MESSAGES`; a last element reports the cut.
    """
    if hasattr(message, "get_fields_and_field_types"):
        kinds = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
        return {name: _plain(getattr(message, name), kind, full) for name, kind in kinds.items()}
    return message


def field_to_plain(message: Any, field: str, *, full: bool = False) -> Any:
    """Turn a field of a message into dicts, lists and scalars.

    Args:
        message: The message.
        field: Names of fields and indices of elements with points between them, e.g. ``points.-1.positions``; a
            negative index counts from the end. Empty: the whole message.
        full: See `message_to_plain`.

    Raises:
        ConfigError: When the message has no such field or element.
    """
    value, kind = message, None
    for part in field.split(".") if field else ():
        if hasattr(value, "get_fields_and_field_types"):
            kinds = dict(zip(value.get_fields_and_field_types(), value.SLOT_TYPES, strict=True))
            if part not in kinds:
                raise ConfigError(f"no field '{part}' in '{field}'; {one_of(kinds, part)}")
            value, kind = getattr(value, part), kinds[part]
        elif isinstance(kind, Array | AbstractSequence):
            count = len(value)
            if not re.fullmatch("-?[0-9]{1,9}", part) or not -count <= int(part) < count:
                raise ConfigError(
                    f"no element '{part}' in '{field}': expected a whole number from {-count} to {count - 1}"
                    if count
                    else f"no element '{part}' in '{field}': the array is empty"
                )
            place = int(part) % count
            value, kind = _items(value[place : place + 1])[0], kind.value_type
        else:
            raise ConfigError(f"no field '{part}' in '{field}': what lies before it is one value")
    return message_to_plain(value, full=full) if kind is None else _plain(value, kind, full)


def _plain(value: Any, kind: Any, full: bool) -> Any:
    if isinstance(kind, NamespacedType):
        return message_to_plain(value, full=full)
    if isinstance(kind, Array | AbstractSequence):
        messages = isinstance(kind.value_type, NamespacedType) and len(value) > WHOLE_MESSAGES
        shown = value if full else value[: SHOWN_MESSAGES if messages else SHOWN_ELEMENTS]
        items = [_plain(item, kind.value_type, full) for item in _items(shown)]
        if len(value) > len(items):
            items.append(f"... {len(value) - len(items)} more, {len(value)} in all (--full shows them)")
        return items
    if isinstance(kind, BasicType) and kind.typename == "float":
        return float(str(np.float32(value)))  # the shortest text that gives the same 32 bits
    if isinstance(value, bytes):
        return value[0]
    return value


def _items(values: Any) -> list[Any]:
    return values.tolist() if isinstance(values, np.ndarray | array.array) else list(values)


def prototype(cls: Any) -> Any:
    """Return a message's default values as plain data, with one element in each empty array of messages."""
    message = cls()
    plain = {}
    for name, kind in zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True):
        if isinstance(kind, NamespacedType):
            plain[name] = prototype(_class_of(kind))
        elif isinstance(kind, AbstractSequence) and isinstance(kind.value_type, NamespacedType):
            plain[name] = [prototype(_class_of(kind.value_type))]
        else:
            plain[name] = _plain(getattr(message, name), kind, full=True)
    return plain
