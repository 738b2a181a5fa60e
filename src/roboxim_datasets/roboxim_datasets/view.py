"""Pictures of a dataset's episode: a contact sheet, and a page with the sheet and the course of its numbers."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from roboxim_datasets.episode import Episode, Floats, RGBImage

FRAMES = 8
"""Frames of a contact sheet."""
CAPTION_PX = 14
_PLOT_WIDTH, _PLOT_HEIGHT = 900, 110
_COLOURS = (
    "#4269d0",
    "#efb118",
    "#ff725c",
    "#6cc5b0",
    "#3ca951",
    "#ff8ab7",
    "#a463f2",
    "#97bbf5",
    "#9c6b4e",
    "#9498a0",
)


def contact_sheet(episode: Episode, frames: int = FRAMES, width: int = 0) -> RGBImage:
    """Return a picture with one row for each camera and frames from the first step to the last.

    Args:
        episode: The episode; it needs a camera.
        frames: Largest number of frames in a row.
        width: Width of a frame [px]; 0: as in the dataset, at most 192.

    Returns:
        uint8, shape (height, width, 3).
    """
    picks = np.unique(np.linspace(0, episode.length - 1, min(frames, episode.length)).round().astype(int))
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
    steps = list(episode.steps(()))
    series: dict[str, tuple[Floats, Sequence[str]]] = {"action": (np.stack([s.action for s in steps]), action_names)}
    if steps[0].action_executed is not None:
        executed = [step.action if step.action_executed is None else step.action_executed for step in steps]
        series["executed - action"] = (np.stack(executed) - series["action"][0], action_names)
    for name, parts in episode.vectors.items():
        series[name] = (np.stack([step.proprio[name] for step in steps]), parts)
    facts = {
        "episode": episode.episode_id,
        "steps": f"{episode.length} at {episode.fps:g} Hz",
        "robot": episode.robot,
        "success": "yes" if episode.success else "no",
        **{name: str(value) for name, value in episode.metadata.items() if name != "task"},
    }
    rows = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    sheet = ""
    if episode.cameras:
        data = base64.b64encode(encoded(contact_sheet(episode, frames), "JPEG")).decode()
        sheet = f'<img alt="frames of the episode" src="data:image/jpeg;base64,{data}">'
    plots = "".join(_plot(name, values, parts) for name, (values, parts) in series.items())
    title = html.escape(episode.instruction)
    return _PAGE.format(title=title, sheet=sheet, plots=plots, rows=rows)


def _plot(name: str, values: npt.NDArray[np.float32], parts: Sequence[str]) -> str:
    low, high = float(values.min()), float(values.max())
    span = (high - low) or 1.0
    across = np.linspace(0, _PLOT_WIDTH, max(len(values), 2))
    lines, legend = [], []
    for column, part in enumerate(parts):
        colour = _COLOURS[column % len(_COLOURS)]
        up = _PLOT_HEIGHT - (values[:, column] - low) / span * _PLOT_HEIGHT
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, up, strict=False))
        lines.append(f'<polyline fill="none" stroke="{colour}" points="{points}"/>')
        legend.append(f'<span style="color:{colour}">{html.escape(part)}</span>')
    return (
        f"<h2>{html.escape(name)}</h2><p>{low:.4g} to {high:.4g}: {', '.join(legend)}</p>"
        f'<svg viewBox="0 -2 {_PLOT_WIDTH} {_PLOT_HEIGHT + 4}" role="img" aria-label="{html.escape(name)} by step">'
        f"{''.join(lines)}</svg>"
    )


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>body{{font:14px sans-serif;max-width:960px;margin:2em auto;padding:0 1em}}img,svg{{max-width:100%}}
svg{{background:#f6f6f6}}td{{padding-right:1em;vertical-align:top}}h2{{margin-bottom:0}}</style>
<h1>{title}</h1>{sheet}{plots}<h2>episode</h2><table>{rows}</table></html>
"""
