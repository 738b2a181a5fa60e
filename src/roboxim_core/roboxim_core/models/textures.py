"""Procedural textures of the objects, e.g. an apple's skin or a can's print.

Written for the texture coordinates of their generators (`turned`, `solids`): u around, v along the profile from the
bottom, or from one end of a tube to the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roboxim_core.vision.textures import SIZE, TEXTURES, Field, grid, noise

PLATE_LINES = ((0.538, 0.010), (0.561, 0.0035))
"""Painted lines of a plate: position along its profile and half width."""
PLATE_COVE = 0.664
"""Where along a plate's profile the rim falls to the well."""


def _mixed(first: npt.ArrayLike, second: npt.ArrayLike, share: Field) -> Field:
    """Blend two linear colours by a share of the second, shape (SIZE, SIZE)."""
    weight = np.clip(share, 0.0, 1.0)[..., None]
    return np.asarray((1.0 - weight) * np.asarray(first) + weight * np.asarray(second))


def _spots(seed: int, cells: float, share: float) -> Field:
    """Return 0..1: soft round spots that cover about a share of the texture."""
    field = noise(seed, cells, cells)
    return np.asarray(np.clip(4.0 * (field - np.quantile(field, 1.0 - share)), 0.0, 1.0))


def _print(lines: list[tuple[str, float, float]]) -> Field:
    """Return 0..1: centred lines of text, each with its height above the lower edge and its size, as fractions."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.new("L", (SIZE, SIZE))
    draw = ImageDraw.Draw(image)
    for text, height, size in lines:
        font = ImageFont.load_default(size * SIZE)
        draw.text((SIZE / 2, (1.0 - height) * SIZE), text, fill=255, font=font, anchor="mm", stroke_width=2)
    return np.asarray(image, dtype=np.float64)[::-1] / 255.0


@TEXTURES.register("wood_grain")
def wood_grain() -> Field:
    """One piece of wood with its grain along u."""
    _, v = grid()
    rings = np.sin(2 * np.pi * (6 * v + 0.35 * noise(104, 1.5, 3.0)))
    light = 0.80 + 0.09 * rings + 0.07 * noise(105, 2.0, 60.0) + 0.035 * noise(106, 10.0, 180.0)
    warm = np.clip(0.86 - light, -0.1, 0.4)[..., None] * np.array([0.0, 0.3, 0.6])
    return np.asarray(np.clip(light, 0.3, 1.0)[..., None] - warm)


@TEXTURES.register("wood_fibre")
def wood_fibre() -> Field:
    """Wood with its grain along v."""
    return np.ascontiguousarray(wood_grain().transpose(1, 0, 2))


@TEXTURES.register("apple_skin")
def apple_skin() -> Field:
    """Streaks from pole to pole, pale dots, darker towards the stem's hollow."""
    _, v = grid()
    streaks = 0.07 * noise(111, 40.0, 3.0) + 0.05 * noise(112, 110.0, 5.0)
    blush = 0.12 * noise(113, 2.0, 1.0)
    light = 0.74 + streaks + blush + 0.3 * _spots(114, 60.0, 0.012)
    hollow = np.clip((v - 0.86) / 0.1, 0.0, 1.0)
    return _mixed(np.repeat(np.clip(light, 0.2, 1.0)[..., None], 3, axis=2), [0.42, 0.5, 0.25], 0.75 * hollow)


@TEXTURES.register("onion_skin")
def onion_skin() -> Field:
    """Dry layers: fine lines from root to neck, coppery and straw-coloured patches, a dry neck."""
    u, v = grid()
    lines = np.abs(np.sin(np.pi * 22 * (u + 0.012 * noise(121, 6.0, 2.0)))) ** 0.4
    flakes = noise(122, 6.0, 1.5)
    light = 0.58 + 0.36 * lines + 0.08 * noise(123, 120.0, 6.0)
    pale = _mixed([1.0, 0.92, 0.8], [1.0, 1.0, 0.95], flakes)
    skin = _mixed(np.clip(light, 0.15, 1.0)[..., None] * pale, [0.95, 0.9, 0.7], np.clip((v - 0.82) / 0.12, 0, 1))
    return _mixed(skin, [0.8, 0.7, 0.5], np.clip((0.08 - v) / 0.05, 0.0, 0.8))


@TEXTURES.register("cucumber_skin")
def cucumber_skin() -> Field:
    """Pale stripes that fade towards the stem, small warts, a yellowish end."""
    u, v = grid()
    wave = np.cos(2 * np.pi * (10 * u + 0.07 * noise(131, 2.0, 6.0)))
    stripes = np.clip(2.0 * wave - 1.2, 0.0, 1.0) * np.clip(1.3 - 1.1 * v + 0.1 * noise(135, 20.0, 8.0), 0.0, 1.0)
    light = 0.40 + 0.06 * noise(132, 20.0, 40.0)
    skin = _mixed(np.repeat(np.clip(light, 0.1, 1)[..., None], 3, axis=2), [0.95, 0.95, 0.62], 0.75 * stripes)
    skin = _mixed(skin, [1.0, 1.0, 0.9], 0.75 * _spots(133, 34.0, 0.045))
    return _mixed(skin, [0.25, 0.2, 0.15], _spots(134, 60.0, 0.015))


@TEXTURES.register("banana_skin")
def banana_skin() -> Field:
    """Yellow with brown flecks, greenish next to the stem, dark ends."""
    u, v = grid()
    ridges = 0.06 * np.cos(2 * np.pi * 5 * u)
    light = np.clip(0.92 + ridges + 0.025 * noise(141, 5.0, 3.0), 0.0, 1.0)
    skin = np.repeat(light[..., None], 3, axis=2)
    skin = _mixed(skin, [0.55, 0.85, 0.6], np.clip((0.16 - v) / 0.1, 0.0, 0.8))
    skin = _mixed(skin, [0.35, 0.22, 0.2], 0.8 * np.clip(noise(142, 16.0, 5.0) - 2.0, 0.0, 1.0))
    skin = _mixed(skin, [0.30, 0.18, 0.15], _spots(143, 34.0, 0.012))
    return _mixed(skin, [0.10, 0.07, 0.08], np.clip((v - 0.955) / 0.02, 0, 1) + np.clip((0.03 - v) / 0.02, 0, 1))


@TEXTURES.register("citrus_peel")
def citrus_peel() -> Field:
    """Fine pores and a faint green at both ends."""
    _, v = grid()
    light = 0.95 - 0.09 * _spots(151, 70.0, 0.2) + 0.02 * noise(152, 4.0, 4.0)
    ends = np.clip((np.abs(v - 0.5) - 0.40) / 0.08, 0.0, 0.6)
    return _mixed(np.repeat(np.clip(light, 0, 1)[..., None], 3, axis=2), [0.6, 0.75, 0.5], ends)


@TEXTURES.register("carrot_skin")
def carrot_skin() -> Field:
    """Broken dark creases across, faint stripes along."""
    _, v = grid()
    rows = np.abs(np.sin(np.pi * (17 * v + 0.5 * noise(161, 2.0, 10.0))))
    creases = np.clip(1.0 - 7.0 * rows, 0.0, 1.0) * np.clip(noise(162, 5.0, 14.0) + 0.4, 0.0, 1.0)
    light = 0.90 - 0.45 * creases + 0.04 * noise(163, 30.0, 3.0)
    return np.clip(light, 0.1, 1.0)


@TEXTURES.register("plate_rings")
def plate_rings() -> Field:
    """A broad blue line and a thin one under the rim, on white glaze that is shaded where the well begins."""
    _, v = grid()
    lines = sum(np.clip((half - np.abs(v - at)) * SIZE + 0.5, 0, 1) for at, half in PLATE_LINES)
    cove = np.exp(-(((v - PLATE_COVE) / 0.014) ** 2))
    glaze = _mixed([1.0, 1.0, 1.0], [0.66, 0.66, 0.68], cove)
    return _mixed(glaze, [0.022, 0.065, 0.34], np.asarray(lines))


@TEXTURES.register("sponge_pores")
def sponge_pores() -> Field:
    """Round holes of two sizes, in the foam's own shade, paler foam around them."""
    light = 0.93 + 0.04 * noise(171, 60.0, 60.0)
    large, small = _spots(172, 22.0, 0.07), _spots(173, 48.0, 0.10)
    foam = np.clip(light, 0.0, 1.0)[..., None] * np.array([1.0, 1.0, 1.0])
    return _mixed(_mixed(foam, [0.72, 0.62, 0.42], 0.8 * small), [0.46, 0.36, 0.2], 0.85 * large)


@TEXTURES.register("scouring_pad")
def scouring_pad() -> Field:
    """A felt of coarse fibres."""
    return np.clip(0.72 + 0.14 * noise(181, 90.0, 30.0) + 0.14 * noise(182, 30.0, 90.0), 0.2, 1.0)


def _sheen(place: Field) -> Field:
    """Return 0..1: the broad bright and dark bands that scratched metal stretches reflections to, once per unit."""
    turn = 2 * np.pi * place
    return np.asarray(np.clip(0.5 + 0.34 * np.cos(turn) + 0.22 * np.cos(2 * turn + 0.9), 0.0, 1.0))


@TEXTURES.register("brushed_metal")
def brushed_metal() -> Field:
    """Fine scratches along u, and what they stretch reflections to."""
    u, _ = grid()
    scratches = 0.04 * noise(191, 3.0, 160.0) + 0.02 * noise(192, 2.0, 12.0)
    return np.clip(0.74 + 0.24 * _sheen(2 * u) + 0.7 * scratches, 0.0, 1.0)


@TEXTURES.register("blade_steel")
def blade_steel() -> Field:
    """Polished steel, darker towards v = 1, with two slanting streaks of light, and a brighter ground edge at v = 0."""
    u, v = grid()
    streaks = np.exp(-(((u - 0.30 - 0.10 * v) / 0.11) ** 2)) + 0.8 * np.exp(-(((u - 0.72 - 0.10 * v) / 0.06) ** 2))
    steel = np.clip(0.66 - 0.14 * v + 0.40 * streaks + 0.025 * noise(191, 3.0, 160.0), 0.0, 1.0)
    return np.where(v < 0.2, 1.0, np.where(v < 0.225, 0.6, steel))


@TEXTURES.register("soda_print")
def soda_print() -> Field:
    """The word on a can's ribbon, dark on white."""
    return _mixed([0.98, 0.98, 0.98], [0.10, 0.12, 0.35], _print([("SODA", 0.5, 0.34)]))


@TEXTURES.register("milk_print")
def milk_print() -> Field:
    """The front of a milk carton: the word, a blue wave below, a splash."""
    u, v = grid()
    wave = v < 0.36 + 0.05 * np.sin(2 * np.pi * u) + 0.015 * np.sin(6 * np.pi * u)
    front = _mixed([0.97, 0.97, 0.95], [0.04, 0.20, 0.62], wave.astype(np.float64))
    drop = (((u - 0.5) / 0.16) ** 2 + ((v - 0.17) / 0.09) ** 2 < 1.0).astype(np.float64)
    front = _mixed(front, [0.97, 0.97, 0.97], drop)
    return _mixed(front, [0.03, 0.12, 0.45], _print([("MILK", 0.68, 0.3), ("fresh", 0.47, 0.1)]))


@TEXTURES.register("bottle_label")
def bottle_label() -> Field:
    """A paper label: a coloured band with a word, lines of small print."""
    u, v = grid()
    label = np.full((SIZE, SIZE, 3), 0.95)
    label = _mixed(label, [0.03, 0.22, 0.45], ((v > 0.34) & (v < 0.80)).astype(np.float64))
    small = (((v * 24) % 1.0 < 0.45) & (v > 0.08) & (v < 0.26) & (np.abs(u - 0.5) < 0.3)).astype(np.float64)
    label = _mixed(label, [0.35, 0.35, 0.4], small)
    return _mixed(label, [0.97, 0.97, 0.97], _print([("WATER", 0.57, 0.24)]))
