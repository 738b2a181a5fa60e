"""An episode of a run, for scripts and notebooks: its result, its bag, its film."""

from __future__ import annotations

import base64
import html
import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import RecorderError
from roboxim_runs.storage.store import readable_run

FILM_PX = 320
"""Height of a film [px]."""
EVERY = 2
"""Ticks from one frame of a film to the next."""


@dataclass(frozen=True)
class Film:
    """A film, which a notebook shows and `save` writes as an animated WebP picture."""

    data: bytes
    """The picture."""

    def save(self, file: Path | str) -> Path:
        """Write the film; return the file."""
        path = Path(file)
        path.write_bytes(self.data)
        return path

    def _repr_html_(self) -> str:
        return f'<img src="data:image/webp;base64,{base64.b64encode(self.data).decode()}" loading="lazy">'


@dataclass(frozen=True, kw_only=True)
class Episode:
    """An episode of an evaluation or of a generation."""

    policy: str
    """Name of the policy; of a demonstration `expert`."""
    result: EpisodeResult
    """How it ended."""
    folder: Path
    """Folder of the run."""

    @cached_property
    def bag(self) -> Path | None:
        """The bag; none: it has none."""
        return self.folder / self.result.bag if self.result.bag else None

    def film(self, height: int = FILM_PX) -> Film:
        """Return the episode as its cameras saw it, side by side, in the time of the robot.

        Args:
            height: Largest height [px].

        Raises:
            RecorderError: When the episode has no bag, or no cameras.
        """
        from PIL import Image

        from roboxim_recorder.bag import BagReader
        from roboxim_runs.episodes.pictures import film

        if self.bag is None:
            raise RecorderError(f"episode {self.result.episode_id} has no bag, so there is no film")
        with readable_run(self.folder, [self.result.bag]) as run:
            rate_hz = BagReader(run / self.result.bag).info.scene.control_rate_hz
            frames = film(run / self.result.bag, every=EVERY)
        if not frames:
            raise RecorderError(f"episode {self.result.episode_id} has no cameras, so there is no film")
        scale = min(1.0, height / frames[0].shape[0])
        size = (round(frames[0].shape[1] * scale), round(frames[0].shape[0] * scale))
        pictures = [Image.fromarray(frame).resize(size) for frame in frames]
        out = io.BytesIO()
        pictures[0].save(
            out, "WEBP", save_all=True, append_images=pictures[1:], loop=0, quality=60,
            duration=round(1000 * EVERY / rate_hz),
        )  # fmt: skip
        return Film(out.getvalue())

    def row(self) -> dict[str, Any]:
        """Return what a table of episodes has of it."""
        found = self.result
        return {
            "policy": self.policy, "episode": found.episode_id, "index": found.index, "skill": found.skill,
            "instruction": found.instruction, "success": found.outcome == "success", "outcome": found.outcome,
            "reason": found.reason, "steps": found.steps, "bag": str(self.bag or ""),
        }  # fmt: skip

    def _repr_html_(self) -> str:
        cells = "".join(
            f"<tr><th>{key}</th><td>{html.escape(str(value))}</td></tr>" for key, value in self.row().items()
        )
        film = self.film()._repr_html_() if self.bag is not None else ""
        return f"<table>{cells}</table>{film}"
