"""The room's procedural textures, for tables, floors and walls: deterministic, tileable, without files."""

from __future__ import annotations

import numpy as np

import roboxim_core.models.textures  # noqa: F401  (registers the objects' textures)
from roboxim_core.vision.textures import SIZE, TEXTURES, Field, grid, noise, pixels, rolled, texture_stamp

TILE_M = 0.8
"""Side of the square that one tile covers on a mesh without texture coordinates [m]."""


@TEXTURES.register("wood")
def wood() -> Field:
    """Boards along x with grain, thin gaps between boards, and a different tone for each board."""
    _, y = grid()
    boards = 6
    board = np.minimum((y[:, 0] * boards).astype(np.int64), boards - 1)
    rng = np.random.Generator(np.random.PCG64(1))
    shift = rng.integers(0, SIZE, boards)[board]
    grain = rolled(noise(2, 2.0, 60.0), shift)
    fibre = rolled(noise(3, 10.0, 180.0), shift)
    flow = rolled(noise(4, 1.5, 5.0), shift)
    rings = np.sin(2 * np.pi * (3.0 * y * boards + 0.9 * flow))
    tone = rng.uniform(-0.05, 0.05, boards)[board][:, None]
    gap = np.abs((y * boards + 0.5) % 1.0 - 0.5) * SIZE / boards
    pores = np.clip(rolled(noise(5, 24.0, 250.0), shift) - 1.6, 0.0, 1.0)
    light = 0.82 + tone + 0.035 * rings + 0.05 * grain + 0.04 * fibre - 0.09 * pores
    light *= 1.0 - 0.45 * np.clip(1.4 - gap, 0.0, 1.0)
    warm = np.clip(0.82 - light, -0.2, 0.4)[..., None] * np.array([0.0, 0.25, 0.5])
    return np.asarray(np.clip(light, 0.25, 1.0)[..., None] - warm)


@TEXTURES.register("oak")
def oak() -> Field:
    """Short boards of a worktop along x: fine, short fibres, soft rings, narrow joints, another tone for each board.

    Finer than ``wood``, whose grain looks smeared from near.
    """
    x, y = grid()
    rows, columns = 10, 3
    row = np.minimum((y * rows).astype(np.int64), rows - 1)
    rng = np.random.Generator(np.random.PCG64(61))
    along = x * columns + rng.uniform(0.0, 1.0, rows)[row]
    board = row * columns + along.astype(np.int64) % columns
    shift = rng.integers(0, SIZE, rows)[row[:, 0]]
    flow = rolled(noise(62, 3.0, 12.0), shift)
    rings = np.sin(2 * np.pi * (2.2 * y * rows + 0.7 * flow + rng.uniform(0.0, 1.0, rows * columns)[board]))
    fibre = rolled(noise(63, 40.0, 220.0), shift)
    grain = rolled(noise(64, 12.0, 110.0), shift)
    pores = np.clip(rolled(noise(65, 55.0, 250.0), shift) - 1.7, 0.0, 1.0)
    tone = rng.uniform(-0.06, 0.06, rows * columns)[board]
    across = np.abs((y * rows + 0.5) % 1.0 - 0.5) * SIZE / rows
    end = np.abs((along + 0.5) % 1.0 - 0.5) * SIZE / columns
    joint = np.clip(1.2 - np.minimum(across, end), 0.0, 1.0)
    light = 0.84 + tone + 0.022 * rings + 0.022 * grain + 0.02 * fibre - 0.05 * pores
    light *= 1.0 - 0.3 * joint
    warm = np.clip(0.84 - light, -0.2, 0.4)[..., None] * np.array([0.0, 0.25, 0.5])
    return np.asarray(np.clip(light, 0.25, 1.0)[..., None] - warm)


@TEXTURES.register("tiles")
def tiles() -> Field:
    """Glazed wall tiles, twice as wide as high, in a bond, with grey joints and slightly different tones."""
    x, y = grid()
    rows, columns = 10, 5
    row = np.minimum((y * rows).astype(np.int64), rows - 1)
    along = (x * columns + 0.5 * (row % 2)) % columns
    rng = np.random.Generator(np.random.PCG64(71))
    tone = rng.uniform(-0.025, 0.025, rows * columns)[row * columns + along.astype(np.int64)]
    across = np.abs((y * rows + 0.5) % 1.0 - 0.5) * SIZE / rows
    end = np.abs((along + 0.5) % 1.0 - 0.5) * SIZE / columns
    joint = np.clip(2.4 - np.minimum(across, end), 0.0, 1.0)
    return np.asarray(np.clip((0.95 + tone + 0.01 * noise(72, 6.0, 6.0)) * (1.0 - 0.35 * joint), 0.0, 1.0))


@TEXTURES.register("checker")
def checker() -> Field:
    """Eight by eight squares, light and dark."""
    x, y = grid()
    return np.asarray(np.where((np.floor(x * 8) + np.floor(y * 8)) % 2 == 0, 0.95, 0.45))


@TEXTURES.register("concrete")
def concrete() -> Field:
    """Cloudy grey with fine grain and a few pores."""
    pores = np.clip(noise(13, 70, 70) - 2.3, 0.0, 1.0)
    clouds, grain = 0.05 * noise(11, 4, 4) + 0.03 * noise(12, 25, 25), 0.02 * noise(14, 200, 200)
    return np.asarray(np.clip(0.8 + clouds + grain - 0.4 * pores, 0, 1))


@TEXTURES.register("plaster")
def plaster() -> Field:
    """Painted plaster: light, faintly uneven."""
    return np.asarray(
        np.clip(0.93 + 0.012 * noise(51, 5, 5) + 0.012 * noise(52, 60, 60) + 0.008 * noise(53, 200, 200), 0, 1)
    )


@TEXTURES.register("fabric")
def fabric() -> Field:
    """Plain weave of threads with slight irregularity."""
    x, y = grid()
    threads = 64
    over = (np.floor(x * threads) + np.floor(y * threads)) % 2 == 0
    round_x, round_y = np.abs(np.sin(np.pi * x * threads)), np.abs(np.sin(np.pi * y * threads))
    weave = np.where(over, 0.62 + 0.33 * round_x, 0.58 + 0.33 * round_y)
    return np.asarray(np.clip(weave + 0.025 * noise(21, 90, 12) + 0.025 * noise(22, 12, 90), 0, 1))


@TEXTURES.register("marble")
def marble() -> Field:
    """White stone: grey veins that swell, thin out and fade, finer ones across, soft clouds beside them."""
    x, y = grid()
    bend = 0.15 * noise(31, 2.0, 2.0) + 0.04 * noise(32, 8.0, 8.0) + 0.012 * noise(34, 30.0, 30.0)
    strength = np.clip(0.55 + 0.5 * noise(35, 3.0, 3.0), 0.0, 1.0)
    vein = np.abs(np.sin(np.pi * (x + 2 * y + bend)))
    fine = np.abs(np.sin(np.pi * (2 * x - 3 * y + 1.3 * bend + 0.1 * noise(36, 5.0, 5.0))))
    lines = strength * np.clip(1.0 - vein * (26.0 - 16.0 * strength), 0.0, 1.0)
    lines += 0.4 * (1.0 - strength) * np.clip(1.0 - 22.0 * fine, 0.0, 1.0)
    clouds = strength * np.clip(1.0 - 2.2 * vein, 0.0, 1.0) ** 2
    return np.asarray(np.clip(0.94 - 0.38 * lines - 0.12 * clouds + 0.015 * noise(33, 5.0, 5.0), 0, 1))


@TEXTURES.register("speckle")
def speckle() -> Field:
    """Terrazzo: light ground with darker specks."""
    large, small = (np.clip(3.0 * (noise(seed, n, n) - 1.35), 0.0, 1.0) for seed, n in ((41, 70.0), (43, 130.0)))
    return np.asarray(np.clip(0.9 - 0.32 * large - 0.25 * small + 0.02 * noise(42, 150, 150), 0, 1))


__all__ = ["SIZE", "TEXTURES", "TILE_M", "pixels", "texture_stamp"]
