"""Videos of depth: what their numbers mean, as the description of a column says it.

From lerobot 0.6 on a video of depth holds 12-bit levels between two distances. Other videos of grey frames hold
distances in a unit that the user states.

Source of the levels: lerobot 0.6.1, datasets/depth_utils.py, configs/video.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import printable

_LEVELS = 4095
_FARTHEST_M = 1e6
_SCALE = ("depth_min", "depth_max", "shift", "use_log")
_GREY = ("gray9le", "gray10le", "gray12le", "gray14le", "gray16le")


@dataclass(frozen=True, kw_only=True)
class Levels:
    """How the numbers of frames become metres: by a unit, or as levels between two distances."""

    unit_m: float = 0.0
    """Unit of numbers that are distances [m]; 0: they are levels."""
    near_m: float = 0.0
    """Distance of level 0 [m], and of everything nearer or unknown."""
    far_m: float = 0.0
    """Distance of the last level, 4095, and of everything farther [m]."""
    shift_m: float = 0.0
    """Added before the logarithm [m]."""
    log: bool = False
    """Whether levels are even in the logarithm of the distance."""

    def metres(self, numbers: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
        """Return distances [m] of a frame."""
        if self.unit_m:
            return np.asarray(numbers * np.float32(self.unit_m), np.float32)
        near, far = self.near_m, self.far_m
        if self.log:
            near, far = math.log(near + self.shift_m), math.log(far + self.shift_m)
        found = near + numbers.astype(np.float64) * ((far - near) / _LEVELS)
        if self.log:
            found = np.exp(found) - self.shift_m
        return np.clip(found, self.near_m, self.far_m).astype(np.float32)

    def __str__(self) -> str:
        """Return their description in an account."""
        if self.unit_m:
            return f"depth in units of {self.unit_m:g} m, read as metres"
        return (
            f"depth in {_LEVELS + 1} levels from {self.near_m:g} to {self.far_m:g} m, read as metres; the first level "
            "is also what was nearer or unknown"
        )


def is_depth_video(about: Mapping[str, Any]) -> bool:
    """Return whether a column's description says that its video is one of depth."""
    deep = any(bool(about.get(name)) for name in ("video.is_depth_map", "is_depth_map"))
    return deep or _pixels(about).startswith(("gray1", "gray9"))


def levels_of(about: Mapping[str, Any], unit_m: float) -> Levels | str:
    """Return what the numbers of a video of depth mean, or why it is not read.

    Args:
        about: The description of its column.
        unit_m: Unit that is stated for numbers that are distances [m]; 0: none.
    """
    pixels = _pixels(about)
    stated = f"a video of depth ({printable(pixels or 'is_depth_map', 40)})"
    if pixels and pixels not in _GREY:
        return f"{stated}; only grey frames of 9 to 16 bits are read as depth"
    given = {name: about[f"video.{name}"] for name in _SCALE if f"video.{name}" in about}
    if not given:
        return (
            Levels(unit_m=unit_m) if unit_m else f"{stated}, whose unit the format does not state (--depth-unit does)"
        )
    numbers = [given.get(name) for name in _SCALE[:3]]
    if all(isinstance(n, int | float) and not isinstance(n, bool) and abs(n) <= _FARTHEST_M for n in numbers):
        near, far, shift = (float(n) for n in numbers if n is not None)
        log = given.get("use_log")
        if isinstance(log, bool) and 0 <= near < far and (near + shift > 0 or not log) and pixels in ("", "gray12le"):
            return Levels(near_m=near, far_m=far, shift_m=shift, log=log)
    scale = ", ".join(f"{name} {printable(given.get(name), 20)}" for name in _SCALE)
    return f"{stated} whose numbers are levels of a scale that cannot be ({scale})"


def _pixels(about: Mapping[str, Any]) -> str:
    return str(about.get("video.pix_fmt", about.get("pix_fmt", "")))
