"""Colour differences as people, and cameras, see them: sRGB to CIELAB (D65), and CIEDE2000."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roboxim_core.vision.srgb import to_linear

SAMPLED_PX = 256
"""Pixels of an object that its colours are compared by, evenly spread."""
SHARE_ALIKE = 0.9
"""Share of an object's pixels whose colours another object must contain to look like it."""

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
    relative = to_linear(np.asarray(rgb, dtype=float) / 255.0) @ _XYZ_OF_RGB.T / _WHITE
    cubic = np.where(relative > (6 / 29) ** 3, np.cbrt(relative), relative / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = cubic[..., 0], cubic[..., 1], cubic[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def median_lab(pixels: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the median colour of pixels, sRGB 0..255, shape (n, 3), as L*, a*, b*, shape (3,)."""
    return np.asarray(np.median(lab_of(pixels), axis=0))


def color_difference(first: npt.ArrayLike, second: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return CIEDE2000 of colours; about 1 is just noticeable side by side.

    Args:
        first: L*, a*, b*, shape (..., 3).
        second: L*, a*, b*, of a shape that fits by broadcasting.

    Returns:
        float64, the broadcast shape without its last axis.

    Source: Sharma, Wu and Dalal, The CIEDE2000 color-difference formula, Color Research and Application 30, 2005.
    """
    l1, a1, b1 = np.moveaxis(np.asarray(first, float), -1, 0)
    l2, a2, b2 = np.moveaxis(np.asarray(second, float), -1, 0)
    mean_chroma = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 0.5 * (1 - np.sqrt(mean_chroma**7 / (mean_chroma**7 + _25_7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    d_l, d_c, d_h = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    half_turn = np.where(np.abs(h1 - h2) <= 180, 0.0, np.where(h1 + h2 < 360, 180.0, -180.0))
    mean_h = np.where(grey, h1 + h2, (h1 + h2) / 2 + half_turn)
    t = (
        1 - 0.17 * _cos(mean_h - 30) + 0.24 * _cos(2 * mean_h) + 0.32 * _cos(3 * mean_h + 6)
        - 0.20 * _cos(4 * mean_h - 63)
    )  # fmt: skip
    s_l = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    s_c, s_h = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    turning = 30 * np.exp(-(((mean_h - 275) / 25) ** 2))
    r_t = -2 * np.sqrt(mean_c**7 / (mean_c**7 + _25_7)) * np.sin(np.radians(2 * turning))
    lightness, chroma, hue = d_l / s_l, d_c / s_c, d_h / s_h
    return np.asarray(np.sqrt(np.maximum(0.0, lightness**2 + chroma**2 + hue**2 + r_t * chroma * hue)))


def palette_difference(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Return how much the colours of two objects differ, the place of a colour apart.

    It is the CIEDE2000 within which nine tenths of each object's pixels have a counterpart in the other's. So two
    buttons with equal housings differ by the colours of their caps, while a few pixels of glare do not count.

    Args:
        first: Pixels of an object, sRGB 0..255, shape (n, 3), n >= 1.
        second: Pixels of another one, shape (m, 3).

    Source: Huttenlocher et al., Comparing images using the Hausdorff distance, PAMI 15, 1993 (the partial distance).
    """
    samples = []
    for pixels in (np.asarray(first), np.asarray(second)):
        picks = np.linspace(0, len(pixels) - 1, min(SAMPLED_PX, len(pixels))).round().astype(int)
        samples.append(lab_of(pixels[picks]))
    differences = color_difference(samples[0][:, None], samples[1][None])
    return float(max(np.quantile(differences.min(axis=axis), SHARE_ALIKE) for axis in (0, 1)))


def _cos(degrees: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(np.cos(np.radians(degrees)))
