"""Pictures of a dataset's episode: a contact sheet, and a page with its frames and plots."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from roboxim_datasets.episode import Episode, Floats, RGBImage

FRAMES = 8
"""Frames of a contact sheet."""
CAPTION_PX = 14
_CHART = (250, 72)  # width and height of a chart, in its own units
STILL = 1e-6
"""Range of values that is drawn as no change."""


def contact_sheet(episode: Episode, frames: int = FRAMES, width: int = 0) -> RGBImage:
    """Return a picture with one row for each camera and frames from the first step to the last.

    Args:
        episode: The episode; it needs a camera.
        frames: Largest number of frames in a row.
        width: Width of a frame [px]; 0: as in the dataset, at most 192.

    Returns:
        uint8, shape (height, width, 3).
    """
    picks = sorted(_picks(episode, frames))
    columns: list[list[RGBImage]] = []
    for step in episode.steps():
        if step.index in picks:
            columns.append([_scaled(step.images[camera], width) for camera in episode.cameras])
    rows = []
    for row, camera in enumerate(episode.cameras):
        text = f"{camera}, steps {', '.join(map(str, picks))} of {episode.length}"
        strip = np.concatenate([column[row] for column in columns], axis=1)
        rows += [_caption(text, strip.shape[1]), strip]
    widest = max(row.shape[1] for row in rows)
    title = _caption(episode.instruction, widest)
    return np.concatenate([_padded(row, widest) for row in (title, *rows)], axis=0)


def _scaled(image: RGBImage, width: int) -> RGBImage:
    wanted = width or min(192, image.shape[1])
    height = max(1, round(image.shape[0] * wanted / image.shape[1]))
    if image.shape[:2] == (height, wanted):
        return image
    return np.asarray(Image.fromarray(image).resize((wanted, height), Image.Resampling.LANCZOS))


def _caption(text: str, width: int) -> RGBImage:
    picture = Image.new("RGB", (width, CAPTION_PX), "white")
    plain = text.encode("latin-1", "replace").decode("latin-1")  # the built-in font has no other letters
    ImageDraw.Draw(picture).text((3, 1), plain, fill="black")
    return np.asarray(picture)


def _padded(row: RGBImage, width: int) -> RGBImage:
    return np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255)


def encoded(picture: RGBImage, kind: str) -> bytes:
    """Encode a picture as a file of a kind that Pillow knows, e.g. ``PNG``; JPEG with quality 85."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, **({"quality": 85} if kind == "JPEG" else {}))
    return buffer.getvalue()


def page(episode: Episode, action_names: Sequence[str], frames: int = 12) -> str:
    """Return a page with an episode's pictures, actions and observed vectors; it needs no other file."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    steps = list(episode.steps(()))
    actions = np.stack([step.action for step in steps])
    curves = {"action": actions}
    if steps[0].action_executed is not None:
        done = [step.action if step.action_executed is None else step.action_executed for step in steps]
        curves["executed"] = np.stack(done)
    vectors = [_vector("action", curves, action_names)]
    for name, parts in episode.vectors.items():
        vectors.append(_vector(name, {name: np.stack([step.proprio[name] for step in steps])}, parts))
    facts = {
        "episode": episode.episode_id,
        "robot": episode.robot,
        **{name: str(value) for name, value in episode.metadata.items() if name != "task"},
    }
    outcome = {None: "outcome not stated", True: "solved", False: "not solved"}[episode.success]
    rate = f" at {episode.fps:g} Hz" if episode.fps else ""
    environment = Environment(
        loader=PackageLoader("roboxim_datasets"), autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True
    )
    return environment.get_template("episode.html").render(
        title=episode.instruction or episode.episode_id or "Episode",
        lead=f"{episode.length} steps{rate}, {outcome}",
        cameras=_frames(episode, frames) if episode.cameras else {},
        vectors=vectors,
        facts={name: value for name, value in facts.items() if value},
        width=_CHART[0],
        height=_CHART[1],
    )


def _frames(episode: Episode, frames: int) -> dict[str, list[tuple[int, str]]]:
    """Return camera to the numbers of some steps, from the first to the last, and their images as data URIs."""
    picks = _picks(episode, frames)
    found: dict[str, list[tuple[int, str]]] = {camera: [] for camera in episode.cameras}
    for step in episode.steps():
        if step.index in picks:
            for camera, shown in found.items():
                data = base64.b64encode(encoded(_scaled(step.images[camera], 0), "JPEG")).decode()
                shown.append((step.index, f"data:image/jpeg;base64,{data}"))
    return found


def _picks(episode: Episode, frames: int) -> set[int]:
    """Return the numbers of at most ``frames`` steps, from the first to the last."""
    return set(np.linspace(0, episode.length - 1, min(frames, episode.length)).round().astype(int).tolist())


def _vector(name: str, curves: Mapping[str, Floats], parts: Sequence[str]) -> dict[str, Any]:
    """Return what the page shows of a vector: a chart for each of its components, without numbers that are not finite.

    Args:
        name: Name of the vector.
        curves: What a chart shows, by name: values of shape (T, D).
        parts: Names of the D components.
    """
    charts = []
    for column, part in enumerate(parts):
        shown = [values[:, column] for values in curves.values()]
        numbers = np.concatenate(shown)
        finite = numbers[np.isfinite(numbers)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
        lost = len(numbers) - len(finite)
        charts.append({
            "name": f"{part} ({lost} not finite)" if lost else part,
            "low": _shown(low, high - low), "high": _shown(high, high - low),
            "lines": [_points(values, low, high) for values in shown],
        })  # fmt: skip
    return {"name": name, "curves": list(curves), "charts": charts, "steps": len(next(iter(curves.values())))}


def _shown(value: float, span: float) -> str:
    """Return a number with as many digits as a range of values needs."""
    places = 4 if span <= STILL else max(0, 2 - math.floor(math.log10(span)))
    return f"{round(value, places) + 0.0:g}"


def _points(values: Floats, low: float, high: float) -> str:
    """Return the points of an SVG polyline; a component that (nearly) never changes is a line in the middle."""
    width, height = _CHART
    span = high - low
    up = (values - low) / span if span > STILL else np.full(len(values), 0.5)
    across = np.linspace(0, width, max(len(values), 2))
    drawn = zip(across, up, np.isfinite(values), strict=False)
    return " ".join(f"{x:.1f},{height * (1 - y):.1f}" for x, y, finite in drawn if finite)
