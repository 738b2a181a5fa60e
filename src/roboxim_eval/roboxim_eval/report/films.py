"""Films for a page that opens offline: one picture with the frames below one another, which a script shows in turn.

A browser decodes such a strip once, so a film can be paused and scrubbed without a video codec or other files.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_eval.film_options import FILM_FRAMES, FRAME_HEIGHT

Frames = Sequence[npt.NDArray[np.uint8]]
FRAME_MS = 150
"""Time of a frame by default [ms]: films of a report are faster than the robot."""
STRIP_PX = 12_000
"""Largest height of a strip [px], below WebP's limit of 16,383; longer films have several strips."""
QUALITY = 60


@dataclass(frozen=True, kw_only=True)
class Film:
    """A film as strips of frames."""

    sources: tuple[str, ...]
    """Data URIs of WebP pictures, each with frames below one another."""
    frames: int
    """Number of frames."""
    width: int
    """Width of a frame [px]."""
    height: int
    """Height of a frame [px]."""
    frame_ms: float = FRAME_MS
    """Time of a frame [ms]."""


def film_strip(
    frames: Frames, *, max_frames: int | None = FILM_FRAMES, height: int = FRAME_HEIGHT, frame_ms: float = FRAME_MS
) -> Film:
    """Encode frames, evenly chosen, the first and the last included.

    Args:
        frames: RGB, uint8, each of shape (height, width, 3); at least one.
        max_frames: Largest number of frames; none: all.
        height: Largest height of a frame [px].
        frame_ms: Time of a frame [ms].
    """
    count = len(frames) if max_frames is None else min(max_frames, len(frames))
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int)).tolist()
    scale = min(1.0, height / frames[0].shape[0])
    size = tuple(max(1, round(side * scale)) for side in frames[0].shape[1::-1])
    each = max(1, STRIP_PX // size[1])
    return Film(
        sources=tuple(_strip(frames, chosen[i : i + each], size) for i in range(0, len(chosen), each)),
        frames=len(chosen), width=size[0], height=size[1], frame_ms=frame_ms,
    )  # fmt: skip


def _strip(frames: Frames, chosen: Sequence[int], size: tuple[int, ...]) -> str:
    """Encode frames below one another."""
    width, height = size
    strip = Image.new("RGB", (width, height * len(chosen)))
    for place, number in enumerate(chosen):
        picture = Image.fromarray(frames[number])
        shown = picture if picture.size == size else picture.resize((width, height), Image.Resampling.LANCZOS)
        strip.paste(shown, (0, place * height))
    buffer = io.BytesIO()
    strip.save(buffer, "WEBP", quality=QUALITY, method=1)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def chosen_films(outcomes: Sequence[tuple[str, bool]], max_films: int) -> list[str]:
    """Return the episodes whose films are shown: as many failures as successes, spread over the run.

    Args:
        outcomes: Episode to whether it succeeded, in the order of the run.
        max_films: Largest number of films.
    """
    failed = [episode for episode, success in outcomes if not success]
    solved = [episode for episode, success in outcomes if success]
    half = max_films // 2
    many_failed = min(len(failed), max(half, max_films - len(solved)))
    return [*_spread(failed, many_failed), *_spread(solved, min(len(solved), max_films - many_failed))]


def _spread(items: list[str], max_items: int) -> list[str]:
    return (
        [items[i] for i in np.unique(np.linspace(0, len(items) - 1, max_items).round().astype(int))]
        if max_items
        else []
    )


def chosen_scenes(outcomes: Mapping[str, Sequence[str]], max_scenes: int) -> list[str]:
    """Return the scenes whose films are shown side by side: as many of each pattern of outcomes, spread over the run.

    Args:
        outcomes: Scene to the outcomes of all policies, in the order of the run.
        max_scenes: Largest number of scenes.
    """
    patterns: dict[tuple[str, ...], list[str]] = {}
    for scene, found in outcomes.items():
        patterns.setdefault(tuple(found), []).append(scene)
    shares = dict.fromkeys(patterns, 0)
    for _ in range(min(max_scenes, len(outcomes))):
        open_ones = [pattern for pattern in patterns if shares[pattern] < len(patterns[pattern])]
        shares[min(open_ones, key=lambda pattern: (shares[pattern], len(set(pattern)) < 2))] += 1
    return [scene for pattern, share in shares.items() for scene in _spread(patterns[pattern], share)]
