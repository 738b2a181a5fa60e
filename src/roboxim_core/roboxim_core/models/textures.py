"""Procedural textures of the objects: what an apple's skin or a can's print looks like."""

from __future__ import annotations

import numpy as np

from roboxim_core.textures import TEXTURES, Field, grid, noise


@TEXTURES.register("wood_grain")
def wood_grain() -> Field:
    """One piece of wood with its grain along u."""
    _, v = grid()
    rings = np.sin(2 * np.pi * (6 * v + 0.35 * noise(104, 1.5, 3.0)))
    light = 0.86 + 0.05 * rings + 0.05 * noise(105, 2.0, 60.0) + 0.025 * noise(106, 10.0, 180.0)
    warm = np.clip(0.86 - light, -0.1, 0.3)[..., None] * np.array([0.0, 0.25, 0.5])
    return np.asarray(np.clip(light, 0.3, 1.0)[..., None] - warm)
