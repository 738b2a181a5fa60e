"""The bounds of `roboxim_core.limits`, applied to messages of any type: long strings and sequences are refused.

A walker is compiled once per message type and visits only the fields that may be long, so that a request costs
microseconds. All elements and characters of a message are also counted together, because sequences inside of sequences
multiply; counting ends at the bound.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError


@dataclass(kw_only=True)
class _Count:
    """Counts of a message's elements and characters so far."""

    items: int = 0
    characters: int = 0


Check = Callable[[Any, str, _Count], None]
"""Called with a value, its path and the message's count; raises."""


def check_message(message: Any) -> None:
    """Refuse a message with a string or a sequence beyond its bound, or with too many elements or characters in total.

    Raises:
        InvalidRequestError: When one is too long; the message names the field and the bound.
    """
    kind: Any = type(message)
    check = _message_check(kind)
    if check is not None:
        check(message, "", _Count())


@cache
def _message_check(kind: Any) -> Check | None:
    fields = [(name, _field_check(name, text)) for name, text in kind.get_fields_and_field_types().items()]
    checks = [(name, check) for name, check in fields if check is not None]
    if not checks:
        return None

    def walk(message: Any, path: str, count: _Count) -> None:
        for name, check in checks:
            check(getattr(message, name), f"{path}.{name}" if path else name, count)

    return walk


def _field_check(name: str, kind: str) -> Check | None:
    """Return the check of a field; None if the field cannot be too long.

    Args:
        name: The field's name.
        kind: Its type as `get_fields_and_field_types` gives it, e.g. ``sequence<geometry_msgs/Pose>``.
    """
    sequence = re.fullmatch(r"sequence<(.*?)(?:, *\d+)?>", kind)
    element = sequence[1] if sequence else re.sub(r"\[\d+\]$", "", kind)
    inner = _element_check(name, element)
    if sequence:
        composed = inner is not None or "/" in element
        max_items = limits.FIELD_ITEMS.get(name, limits.ITEMS) if composed else limits.NUMBERS
        return _sequence_check(max_items, inner, composed=composed)
    return _sequence_check(None, inner, composed=False) if element != kind and inner else inner


def _element_check(name: str, kind: str) -> Check | None:
    if kind.startswith(("string", "wstring")):
        return _string_check(limits.LONG_TEXT_CHARACTERS if name in limits.LONG_TEXTS else limits.SHORT_TEXT_CHARACTERS)
    if "/" in kind:
        package, _, message = kind.partition("/")
        return _message_check(getattr(importlib.import_module(f"{package}.msg"), message))
    return None


def _string_check(max_characters: int) -> Check:
    def check(value: Any, path: str, count: _Count) -> None:
        if len(value) > max_characters:
            raise InvalidRequestError(f"{path} may have {max_characters} characters, got {len(value)}")
        count.characters += len(value)
        if count.characters > limits.MESSAGE_CHARACTERS:
            raise InvalidRequestError(
                f"strings of a message may have {limits.MESSAGE_CHARACTERS} characters together; {path} exceeds that"
            )

    return check


def _sequence_check(max_items: int | None, inner: Check | None, *, composed: bool) -> Check:
    def check(value: Any, path: str, count: _Count) -> None:
        if max_items is not None and len(value) > max_items:
            raise InvalidRequestError(f"{path} may have {max_items} elements, got {len(value)}")
        if composed:
            count.items += len(value)
            if count.items > limits.MESSAGE_ITEMS:
                raise InvalidRequestError(
                    f"sequences of a message may have {limits.MESSAGE_ITEMS} elements together; {path} exceeds that"
                )
        if inner is not None:
            for item in value:
                inner(item, path, count)

    return check
