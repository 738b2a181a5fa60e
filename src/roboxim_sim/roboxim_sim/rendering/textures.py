"""Built-in procedural textures: deterministic, tileable, no files.

A texture multiplies a material's colour, so it is near grey with a mean a little under white. Pixels are the square
roots of linear values (8 bits are enough there; the shader squares them).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from roboxim_core.registry import Registry

Field = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

SIZE = 512
"""Width and height of a texture [px]."""
TILE_M = 0.8
"""Side of the square that one repeat covers on a mesh without texture coordinates [m]."""

TEXTURES: Registry[Callable[[], Field]] = Registry("texture")
"""Name to a function that returns linear factors 0..1, shape (SIZE, SIZE) or (SIZE, SIZE, 3)."""


@lru_cache(maxsize=32)
def pixels(name: str) -> Pixels:
    """Return a texture's pixels, square roots of linear values, shape (SIZE, SIZE, 3); empty name: white.

    Raises:
        ConfigError: When no texture has the name.
    """
    factor = np.ones((SIZE, SIZE)) if not name else TEXTURES[name]()
    image = np.broadcast_to(factor if factor.ndim == 3 else factor[..., None], (SIZE, SIZE, 3))
    return np.ascontiguousarray(np.rint(255.0 * np.sqrt(np.clip(image, 0.0, 1.0))).astype(np.uint8))


def _noise(seed: int, cells_x: float, cells_y: float) -> Field:
    """Return tileable smooth noise of zero mean and unit deviation with about so many blobs along x and y."""
    white = np.random.Generator(np.random.PCG64(seed)).standard_normal((SIZE, SIZE))
    fx, fy = np.fft.fftfreq(SIZE, 1 / SIZE)[None, :], np.fft.fftfreq(SIZE, 1 / SIZE)[:, None]
    weight = np.exp(-((fx / cells_x) ** 2) - (fy / cells_y) ** 2)
    field = np.fft.ifft2(np.fft.fft2(white) * weight).real
    field -= field.mean()
    return np.asarray(field / field.std())


def _grid() -> tuple[Field, Field]:
    """Return the texture coordinates 0..1 of the pixel centres (x right, y down)."""
    axis = (np.arange(SIZE) + 0.5) / SIZE
    x, y = np.meshgrid(axis, axis)
    return x, y


def _periodic(field: Field, rows: npt.NDArray[np.int64]) -> Field:
    """Roll each row of a field by its own number of pixels."""
    columns = (np.arange(SIZE)[None, :] + rows[:, None]) % SIZE
    return np.asarray(field[np.arange(SIZE)[:, None], columns])


@TEXTURES.register("wood")
def wood() -> Field:
    """Boards along x with grain, a thin gap between boards, and a tone of its own for each board."""
    _, y = _grid()
    boards = 6
    board = np.minimum((y[:, 0] * boards).astype(np.int64), boards - 1)
    rng = np.random.Generator(np.random.PCG64(1))
    shift = rng.integers(0, SIZE, boards)[board]
    grain = _periodic(_noise(2, 2.0, 60.0), shift)
    fibre = _periodic(_noise(3, 10.0, 180.0), shift)
    flow = _periodic(_noise(4, 1.5, 5.0), shift)
    rings = np.sin(2 * np.pi * (3.0 * y * boards + 0.9 * flow))
    tone = rng.uniform(-0.05, 0.05, boards)[board][:, None]
    gap = np.abs((y * boards + 0.5) % 1.0 - 0.5) * SIZE / boards
    light = 0.82 + tone + 0.035 * rings + 0.05 * grain + 0.03 * fibre
    light *= 1.0 - 0.45 * np.clip(1.4 - gap, 0.0, 1.0)
    warm = np.clip(0.82 - light, -0.2, 0.4)[..., None] * np.array([0.0, 0.25, 0.5])
    return np.asarray(np.clip(light, 0.25, 1.0)[..., None] - warm)


@TEXTURES.register("checker")
def checker() -> Field:
    """Eight by eight squares, light and dark."""
    x, y = _grid()
    return np.asarray(np.where((np.floor(x * 8) + np.floor(y * 8)) % 2 == 0, 0.95, 0.45))


@TEXTURES.register("concrete")
def concrete() -> Field:
    """Cloudy grey with fine grain and a few pores."""
    pores = np.clip(_noise(13, 70, 70) - 2.3, 0.0, 1.0)
    clouds, grain = 0.05 * _noise(11, 4, 4) + 0.03 * _noise(12, 25, 25), 0.02 * _noise(14, 200, 200)
    return np.asarray(np.clip(0.8 + clouds + grain - 0.4 * pores, 0, 1))


@TEXTURES.register("fabric")
def fabric() -> Field:
    """Plain weave of threads with slight irregularity."""
    x, y = _grid()
    threads = 64
    over = (np.floor(x * threads) + np.floor(y * threads)) % 2 == 0
    round_x, round_y = np.abs(np.sin(np.pi * x * threads)), np.abs(np.sin(np.pi * y * threads))
    weave = np.where(over, 0.62 + 0.33 * round_x, 0.58 + 0.33 * round_y)
    return np.asarray(np.clip(weave + 0.025 * _noise(21, 90, 12) + 0.025 * _noise(22, 12, 90), 0, 1))


@TEXTURES.register("marble")
def marble() -> Field:
    """White stone with thin grey veins."""
    x, y = _grid()
    bend = 0.16 * _noise(31, 3, 3) + 0.06 * _noise(32, 9, 9)
    vein = np.abs(np.sin(np.pi * (2 * x + 3 * y + 2.5 * bend)))
    return np.asarray(np.clip(0.94 - 0.35 * np.clip(1 - vein * 6, 0, 1) + 0.02 * _noise(33, 6, 6), 0, 1))


@TEXTURES.register("speckle")
def speckle() -> Field:
    """Terrazzo: light ground with darker specks."""
    speck = np.clip(3.0 * (_noise(41, 45, 45) - 1.2), 0.0, 1.0)
    return np.asarray(np.clip(0.9 - 0.35 * speck + 0.02 * _noise(42, 150, 150), 0, 1))
