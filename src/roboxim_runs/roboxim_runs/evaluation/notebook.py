"""Results of an evaluation in a notebook: a table, films, and rows for pandas."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import RecorderError
from roboxim_runs.storage.store import readable_run

FILMS = 4
"""Films that an evaluation shows of each policy."""
FILM_PX = 160
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
    """An episode of an evaluation."""

    policy: str
    """Name of the policy."""
    result: EpisodeResult
    """How it ended."""
    folder: Path
    """Folder of the policy's run."""

    @cached_property
    def bag(self) -> Path | None:
        """The bag; none: it has none."""
        return self.folder / self.result.bag if self.result.bag else None

    def film(self, height: int = 2 * FILM_PX) -> Film:
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


def evaluation_html(policies: Mapping[str, Any], comparison: str, report: Path | None) -> str:
    """Return an evaluation for a notebook: a line for each policy, films, and where the report is.

    Args:
        policies: Name to `roboxim_runs.evaluation.results.PolicyResult`.
        comparison: Comparison of the policies in words.
        report: The report.
    """
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(policy.summary)}</td></tr>"
        for name, policy in policies.items()
    )
    link = f'<p>report: <a href="{html.escape(str(report))}">{html.escape(str(report))}</a></p>' if report else ""
    films = "".join(f"<h4>{html.escape(name)}</h4>{''.join(_films(policy))}" for name, policy in policies.items())
    return f"<table>{rows}</table><p>{html.escape(comparison)}</p>{films}{link}"


def _films(policy: Any) -> Iterator[str]:
    """Yield films of a policy's failures and successes, as many of each where there are."""
    filmed = [episode for episode in policy.episodes if episode.bag is not None and episode.bag.exists()]
    failed = [episode for episode in filmed if episode.result.outcome != "success"]
    solved = [episode for episode in filmed if episode.result.outcome == "success"]
    for episode in (*failed[: max(FILMS // 2, FILMS - len(solved))], *solved)[:FILMS]:
        caption = html.escape(f"{episode.result.instruction}: {episode.result.outcome}")
        try:
            film = episode.film(FILM_PX)._repr_html_()
        except RecorderError as error:
            film = html.escape(str(error))
        yield f'<figure style="display:inline-block;margin:4px">{film}<figcaption>{caption}</figcaption></figure>'
