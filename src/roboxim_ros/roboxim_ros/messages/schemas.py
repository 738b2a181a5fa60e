"""Definitions and hashes of message types, for bags and for serialising. No ROS is imported.

Definitions come from the interface files that every ROS package installs in its share folder, so a bag
also carries the comments. `rosbags` serialises and decodes.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from roboxim_core.errors import InvalidRequestError

_BUILTIN = re.compile(r"^(bool|byte|char|float32|float64|u?int(8|16|32|64)|w?string)\b")
_SEPARATOR = "=" * 80


@dataclass(frozen=True, kw_only=True)
class MessageSchema:
    """A message type as a bag stores it."""

    name: str
    """Full name, e.g. ``sensor_msgs/msg/Image``."""
    text: str
    """Definition with those of all nested types, in the format ``ros2msg``."""

    @cached_property
    def type_hash(self) -> str:
        """The type's REP-2011 hash, ``RIHS01_...``."""
        return typestore((self,)).hash_rihs01(self.name)


def full_name(name: str) -> str:
    """Return ``package/msg/Name``, also for the short form ``package/Name``."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest.rpartition('/')[2]}"


@cache
def message_schema(name: str) -> MessageSchema:
    """Return the schema of an installed message type.

    Args:
        name: Full name, e.g. ``sensor_msgs/msg/Image``.

    Raises:
        InvalidRequestError: If the type is not installed on this machine.
    """
    text, nested = _read(name)
    parts, seen = [text], {name}
    while nested:
        inner = nested.pop(0)
        if inner in seen:
            continue
        seen.add(inner)
        inner_text, more = _read(inner)
        parts.append(f"{_SEPARATOR}\nMSG: {inner.replace('/msg/', '/')}\n{inner_text}")
        nested += more
    return MessageSchema(name=name, text="\n".join(parts))


def _file(name: str) -> Path:
    package, _, kind = name.partition("/msg/")
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    if spec is None or spec.origin is None:
        raise InvalidRequestError(f"message type '{name}': there is no ROS package '{package}' on this machine")
    # lib/pythonX.Y/site-packages/<package>/__init__.py of an install prefix, a virtual environment's included
    return Path(spec.origin).parents[4] / "share" / package / "msg" / f"{kind}.msg"


def _read(name: str) -> tuple[str, list[str]]:
    """Return a definition's own text and the names of the types that it nests."""
    path = _file(name)
    try:
        text = path.read_text()
    except OSError:
        raise InvalidRequestError(f"message type '{name}' is not installed: no file {path}") from None
    package = name.partition("/")[0]
    nested = []
    for line in text.splitlines():
        field = line.partition("#")[0].split()
        if len(field) < 2 or _BUILTIN.match(field[0]):
            continue
        kind = field[0].partition("[")[0]
        if kind == "Header" and package != "std_msgs":
            kind = "std_msgs/Header"
        nested.append(full_name(kind if "/" in kind else f"{package}/{kind}"))
    return text, nested


def typestore(schemas: Iterable[MessageSchema]) -> Typestore:
    """Return a store that serialises and decodes messages of these schemas; made once per set of schemas."""
    return _typestore(tuple(sorted({(schema.name, schema.text) for schema in schemas})))


@lru_cache(maxsize=64)
def _typestore(definitions: tuple[tuple[str, str], ...]) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    types = {}
    for name, text in definitions:
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store
