"""Colour differences as people, and cameras, see them: sRGB to CIELAB (D65), and CIEDE2000."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Lab = tuple[float, float, float]

_WHITE = np.array([0.95047, 1.0, 1.08883])
_XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_25_7 = 25.0**7


def lab_of(rgb: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Convert sRGB, 0..255, to L*, a*, b*.

    Args:
        rgb: Shape (..., 3).

    Returns:
        float64, shape (..., 3).

    Source: IEC 61966-2-1 and CIE 15:2004.
    """
    values = np.asarray(rgb, dtype=float) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    relative = linear @ _XYZ_OF_RGB.T / _WHITE
    cubic = np.where(relative > (6 / 29) ** 3, np.cbrt(relative), relative / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = cubic[..., 0], cubic[..., 1], cubic[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def median_lab(pixels: npt.ArrayLike) -> Lab:
    """Return the median colour of pixels, shape (n, 3), sRGB 0..255."""
    lightness, red, yellow = np.median(lab_of(pixels), axis=0).tolist()
    return lightness, red, yellow


def color_difference(first: Lab, second: Lab) -> float:
    """Return CIEDE2000 of two colours; about 1 is just noticeable side by side.

    Source: Sharma, Wu and Dalal, The CIEDE2000 color-difference formula, Color Research and Application 30, 2005.
    """
    (l1, a1, b1), (l2, a2, b2) = first, second
    mean_chroma = (math.hypot(a1, b1) + math.hypot(a2, b2)) / 2
    g = 0.5 * (1 - math.sqrt(mean_chroma**7 / (mean_chroma**7 + _25_7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = math.hypot(a1, b1), math.hypot(a2, b2)
    h1, h2 = (math.degrees(math.atan2(b, a)) % 360 if a or b else 0.0 for a, b in ((a1, b1), (a2, b2)))
    turn = 0.0 if c1 * c2 == 0 else (h2 - h1 + 180) % 360 - 180
    d_l, d_c, d_h = l2 - l1, c2 - c1, 2 * math.sqrt(c1 * c2) * math.sin(math.radians(turn / 2))
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    mean_h = h1 + h2 if c1 * c2 == 0 else (h1 + h2) / 2 + (180 if abs(h1 - h2) > 180 and h1 + h2 < 360 else 0)
    mean_h -= 180 if c1 * c2 and abs(h1 - h2) > 180 and h1 + h2 >= 360 else 0
    t = (
        1 - 0.17 * _cos(mean_h - 30) + 0.24 * _cos(2 * mean_h) + 0.32 * _cos(3 * mean_h + 6)
        - 0.20 * _cos(4 * mean_h - 63)
    )  # fmt: skip
    s_l = 1 + 0.015 * (mean_l - 50) ** 2 / math.sqrt(20 + (mean_l - 50) ** 2)
    s_c, s_h = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    turning = 30 * math.exp(-(((mean_h - 275) / 25) ** 2))
    r_t = -2 * math.sqrt(mean_c**7 / (mean_c**7 + _25_7)) * math.sin(math.radians(2 * turning))
    terms = (d_l / s_l, d_c / s_c, d_h / s_h)
    return math.sqrt(sum(term**2 for term in terms) + r_t * terms[1] * terms[2])


def _cos(degrees: float) -> float:
    return math.cos(math.radians(degrees))
