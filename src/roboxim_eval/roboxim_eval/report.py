"""A self-contained HTML report of an evaluation: rates with intervals, films of episodes, and how to reproduce it.

The input is plain values: results, and frames that the caller has read from bags.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from roboxim_core.episode import EpisodeResult
from roboxim_core.seeds import CELL_NUMBER
from roboxim_eval.grouping import grouped
from roboxim_eval.statistics import (
    SuccessRate,
    error_line,
    error_reasons,
    failure_reasons,
    is_measured,
    rate_of,
    rates_by,
)

Frames = Sequence[npt.NDArray[np.uint8]]
FILM_FRAMES = 24
FILM_MS = 150


@dataclass(frozen=True, kw_only=True, eq=False)
class PolicyRun:
    """One policy's episodes."""

    policy: str
    """Name of the policy."""
    results: Sequence[EpisodeResult]
    """Results of the policy's episodes."""
    films: Mapping[str, Frames] = field(default_factory=dict)
    """Episode id to RGB frames, uint8, each of shape (height, width, 3), cameras side by side."""
    drawn: dict[str, dict[str, str]] = field(default_factory=dict)
    """Episode id to the named draws of its reset components, e.g. ``{"interaction_area": "left"}``."""

    @property
    def rates_by_dimension(self) -> dict[str, dict[str, SuccessRate]]:
        """Success rates by instruction, and by each recorded choice that differs between episodes.

        Numbers of ranges are in three groups of equal size, see `roboxim_eval.grouping`.
        """
        found = {"instruction": rates_by(self.results, lambda result: result.instruction)}
        for dimension in sorted({name for names in self.drawn.values() for name in names} - {CELL_NUMBER}):
            names = {episode: drawn[dimension] for episode, drawn in self.drawn.items() if dimension in drawn}
            groups = grouped(names)
            if len(set(groups.values())) > 1:
                found[dimension] = _rates_by_name(self.results, groups)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Content of a report."""

    title: str
    """Headline."""
    runs: Sequence[PolicyRun]
    """Runs of the policies, the one under test first."""
    facts: dict[str, str]
    """Facts that reproduce the evaluation: seed, task, renderer, dataset, ..."""
    versions: dict[str, str]
    """Package to version."""
    command: str
    """Command that reproduces the evaluation."""


def _rates_by_name(results: Sequence[EpisodeResult], names: dict[str, str]) -> dict[str, SuccessRate]:
    having = [result for result in results if result.episode_id in names]
    return rates_by(having, lambda result: names[result.episode_id])


def webp_film(frames: Frames) -> str:
    """Encode at most `FILM_FRAMES` frames, evenly chosen, as an animated WebP data URI; the last frame is held."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(FILM_FRAMES, len(frames))).round().astype(int))
    images = [Image.fromarray(frames[i]) for i in chosen]
    buffer = io.BytesIO()
    durations = [FILM_MS] * (len(images) - 1) + [1200]
    images[0].save(
        buffer, "WEBP", save_all=True, append_images=images[1:], duration=durations, loop=0, quality=70, method=2
    )
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def verdict_line(runs: Sequence[PolicyRun]) -> str:
    """Compare the interval of the first policy with that of each other policy, in one sentence each."""
    if len(runs) < 2:
        return ""
    sentences = [
        f"{run.policy} is not compared: most of its episodes ended in errors."
        for run in runs
        if not is_measured(run.results)
    ]
    first = rate_of(runs[0].results)
    for other in runs[1:] if is_measured(runs[0].results) else ():
        if not is_measured(other.results):
            continue
        rate = rate_of(other.results)
        if first.low > rate.high:
            relation = "lies above"
        elif first.high < rate.low:
            relation = "lies below"
        else:
            relation = "overlaps"
        sentences.append(
            f"The interval of {runs[0].policy} ({100 * first.low:.0f} to {100 * first.high:.0f} %) {relation} "
            f"that of {other.policy} ({100 * rate.low:.0f} to {100 * rate.high:.0f} %)."
        )
    return " ".join(sentences)


def summary(report: Report) -> dict[str, Any]:
    """Return the report's numbers as plain data, the content of ``summary.json``."""
    return {
        "title": report.title,
        "policies": {run.policy: _numbers(run) for run in report.runs},
        "comparison": verdict_line(report.runs),
        "facts": report.facts,
        "versions": report.versions,
        "command": report.command,
    }


def _numbers(run: PolicyRun) -> dict[str, Any]:
    """Return a policy's numbers; if most episodes ended in errors, the rate and its interval are None."""
    rate = rate_of(run.results)
    measured = is_measured(run.results)
    numbers: dict[str, Any] = {**asdict(rate), "rate": rate.rate, "measured": measured}
    if measured:
        for dimension, rates in run.rates_by_dimension.items():
            numbers[f"by_{dimension}"] = {name: asdict(rate) for name, rate in rates.items()}
    else:
        numbers |= {"rate": None, "low": None, "high": None}
    return numbers | {"failure_reasons": failure_reasons(run.results), "errors": error_reasons(run.results)}


def write_report(report: Report, folder: Path) -> Path:
    """Write ``report.html`` (self-contained) and ``summary.json``.

    Args:
        report: Content of the report.
        folder: Existing folder.

    Returns:
        The HTML file.
    """
    environment = Environment(
        loader=PackageLoader("roboxim_eval", "templates"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["percent"] = lambda value: f"{100 * value:.0f} %"
    page = environment.get_template("report.html").render(
        report=report,
        comparison=verdict_line(report.runs),
        runs=[_run_view(run) for run in report.runs],
    )
    (folder / "summary.json").write_text(json.dumps(summary(report), indent=2) + "\n")
    path = folder / "report.html"
    path.write_text(page)
    return path


def _run_view(run: PolicyRun) -> dict[str, Any]:
    rate: SuccessRate = rate_of(run.results)
    steps = [result.steps for result in run.results if result.outcome == "success"]
    inference = [1000 * result.inference_s / result.steps for result in run.results if result.steps]
    shown = [result for result in run.results if run.films.get(result.episode_id)]
    films = {result.episode_id: webp_film(run.films[result.episode_id]) for result in shown}
    return {
        "policy": run.policy,
        "rate": rate if is_measured(run.results) else None,
        "errors": error_line(run.results),
        "dimensions": run.rates_by_dimension if is_measured(run.results) else {},
        "reasons": failure_reasons(run.results),
        "median_steps": int(np.median(steps)) if steps else None,
        "inference_ms": float(np.median(inference)) if inference else None,
        "failures": [(result, films[result.episode_id]) for result in shown if result.outcome != "success"],
        "successes": [(result, films[result.episode_id]) for result in shown if result.outcome == "success"],
    }
