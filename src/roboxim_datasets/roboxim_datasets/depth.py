"""Depth images of others' datasets: their camera, and the meaning of their numbers.

The formats state no unit of depth, so a user states it (`open_dataset`). An image belongs to the colour camera whose
name has the same words, apart from those for the kind of image: ``top_depth`` or ``depth/top`` to ``top``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from roboxim_core.errors import InvalidRequestError

_KINDS = {"depth", "image", "images", "img", "rgb", "color", "colour", "map", "m", "mm", "obs", "observation"}
_LARGEST_UNIT_M = 1000.0


def is_named_depth(name: str) -> bool:
    """Return whether a key is called like one of depth images."""
    return "depth" in _words(name)


def camera_of(name: str, cameras: Iterable[str]) -> str:
    """Return the colour camera that depth images belong to; empty: there is none, or more than one."""
    own_words = [word for word in _words(name) if word not in _KINDS]
    named = {camera: [word for word in _words(camera) if word not in _KINDS] for camera in cameras}
    found = [camera for camera, words in named.items() if words == own_words]
    return found[0] if len(found) == 1 else ""


def checked_unit(unit_m: float) -> float:
    """Return a unit of depth [m] that a user states.

    Raises:
        InvalidRequestError: When it is no length.
    """
    if not (math.isfinite(unit_m) and 0 < unit_m <= _LARGEST_UNIT_M):
        raise InvalidRequestError(
            f"--depth-unit is the length of one unit of depth in metres, above 0 and at most {_LARGEST_UNIT_M:g} "
            f"(0.001 for millimetres); got {unit_m:g}"
        )
    return unit_m


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
