"""The transfer function of sRGB, between the values of pictures and light.

Source: IEC 61966-2-1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def to_linear(srgb: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return the linear light of sRGB values, both 0..1; shape and precision stay."""
    values = np.asarray(srgb)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def to_srgb(light: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return the sRGB values of linear light, both 0..1; shape and precision stay."""
    values = np.asarray(light)
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
