"""The parts of a request by kind, for wires with separate fields for pictures, numbers and texts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.errors import InvalidRequestError


@dataclass(frozen=True, kw_only=True)
class Parts:
    """A request, sorted by kind; each keeps the request's order."""

    text: str
    """The instruction."""
    images: Mapping[str, np.ndarray[Any, Any]]
    """Pictures: uint8 arrays with three axes or more."""
    numbers: Mapping[str, np.ndarray[Any, Any]]
    """Arrays of real numbers: states."""
    extras: Mapping[str, Any]
    """Masks, and the convention's constants."""


def parts_of(request: Mapping[str, Any], prompt_key: str) -> Parts:
    """Sort a request's values by kind.

    Args:
        request: The request.
        prompt_key: Key of the instruction.

    Raises:
        InvalidRequestError: When the instruction is missing.
    """
    images, numbers, extras = {}, {}, {}
    for key, value in request.items():
        if isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim >= 3:
            images[key] = value
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            numbers[key] = value
        elif key != prompt_key:
            extras[key] = value
    text = request.get(prompt_key)
    if not isinstance(text, str):
        raise InvalidRequestError(f"a request must have the instruction as '{prompt_key}'; it has {sorted(request)}")
    return Parts(text=text, images=images, numbers=numbers, extras=extras)


def named(key: str, sent: Iterable[str]) -> list[str]:
    """Return a convention's keys that mean a server's key: equal but for groups before it, or else in the last part.

    Args:
        key: The server's key, e.g. ``front.rgb``.
        sent: Keys of the convention, e.g. ``video.front.rgb``.
    """
    sent, wanted = list(sent), key.replace(".", "/")
    whole = [one for one in sent if f"/{one.replace('.', '/')}".endswith(f"/{wanted}")]
    return whole or [one for one in sent if last_part(one) == last_part(key)]


def last_part(key: str) -> str:
    """Return a key without the groups before it: ``observation/image`` and ``video.image`` become ``image``."""
    return key.replace(".", "/").rpartition("/")[2]
