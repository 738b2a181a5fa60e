"""Films for a page that opens offline: the frames below one another in one picture, which a script shows one by one.

A browser decodes such a strip once, so that a film pauses and scrubs without any codec, in a page without other files.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

Frames = Sequence[npt.NDArray[np.uint8]]
FILM_FRAMES = 24
"""Largest number of frames of a film."""
FRAME_HEIGHT = 192
"""Largest height of a frame [px]; 24 of them stay far below WebP's limit of 16,383."""
QUALITY = 60


@dataclass(frozen=True, kw_only=True)
class Film:
    """A film as a strip of frames."""

    source: str
    """Data URI of a WebP picture with the frames below one another."""
    frames: int
    """Number of frames."""
    width: int
    """Width of a frame [px]."""
    height: int
    """Height of a frame [px]."""


def film_strip(frames: Frames) -> Film:
    """Encode at most `FILM_FRAMES` frames, evenly chosen, the first and the last included.

    Args:
        frames: RGB, uint8, each of shape (height, width, 3); at least one.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(FILM_FRAMES, len(frames))).round().astype(int))
    height, width = frames[0].shape[:2]
    scale = min(1.0, FRAME_HEIGHT / height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    strip = Image.new("RGB", (size[0], size[1] * len(chosen)))
    for place, number in enumerate(chosen):
        picture = Image.fromarray(frames[number])
        strip.paste(picture if scale == 1.0 else picture.resize(size, Image.Resampling.LANCZOS), (0, place * size[1]))
    buffer = io.BytesIO()
    strip.save(buffer, "WEBP", quality=QUALITY, method=4)
    source = "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
    return Film(source=source, frames=len(chosen), width=size[0], height=size[1])


def chosen_films(outcomes: Sequence[tuple[str, bool]], most: int) -> list[str]:
    """Return the episodes whose films are shown: as many failures as successes, spread over the run.

    Args:
        outcomes: Episode to whether it succeeded, in the order of the run.
        most: Largest number of films.
    """
    failed = [episode for episode, success in outcomes if not success]
    solved = [episode for episode, success in outcomes if success]
    half = most // 2
    many_failed = min(len(failed), max(half, most - len(solved)))
    return [*_spread(failed, many_failed), *_spread(solved, min(len(solved), most - many_failed))]


def _spread(items: list[str], most: int) -> list[str]:
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))] if most else []
