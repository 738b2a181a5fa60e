"""The parts of a request by kind, for wires that give pictures, numbers and texts places of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.errors import InvalidRequestError


@dataclass(frozen=True, kw_only=True)
class Parts:
    """A request, sorted by kind; each keeps the request's order."""

    images: Mapping[str, np.ndarray[Any, Any]]
    """Pictures: uint8 arrays with three axes or more."""
    numbers: Mapping[str, np.ndarray[Any, Any]]
    """All other arrays."""
    texts: Mapping[str, str]
    """Texts."""

    @property
    def text(self) -> str:
        """The instruction.

        Raises:
            InvalidRequestError: When the request does not have exactly one text.
        """
        if len(self.texts) != 1:
            raise InvalidRequestError(f"a request must have one text, the instruction; it has {sorted(self.texts)}")
        return next(iter(self.texts.values()))


def parts_of(request: Mapping[str, Any]) -> Parts:
    """Sort a request's values by kind.

    Raises:
        InvalidRequestError: On a value that is neither an array nor a text.
    """
    images, numbers, texts = {}, {}, {}
    for key, value in request.items():
        if isinstance(value, str):
            texts[key] = value
        elif isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim >= 3:
            images[key] = value
        elif isinstance(value, np.ndarray):
            numbers[key] = value
        else:
            raise InvalidRequestError(f"'{key}' of a request must be an array or a text, got {type(value).__name__}")
    return Parts(images=images, numbers=numbers, texts=texts)


def last_part(key: str) -> str:
    """Return a key without the groups before it: ``observation/image`` and ``video.image`` become ``image``."""
    return key.replace(".", "/").rpartition("/")[2]
