"""The report of an audit: ``audit.json`` for programs, ``report.html`` for people, self-contained and offline."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_core.errors import counted
from roboxim_core.whole_files import write_json, write_whole
from roboxim_datasets.audit.values import AuditResult, CheckResult, Finding

SHOWN_FINDINGS = 20
"""Findings of a check that the page lists; the JSON file has all."""
PICTURE_PX = 320
"""Longest side of a picture."""
CHART = (640.0, 120.0)
"""Width and height of a chart, in its own units."""
STATUS = {
    "faults": "faults",
    "warnings": "warnings",
    "clean": "clean",
    "unchecked": "cannot be checked",
}
"""Status of a check to its words in the report."""

RGBImage = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """An image that shows a finding."""

    camera: str
    """The camera."""
    tick: int
    """The tick."""
    data: str
    """The image as a data URI."""

    @staticmethod
    def of(camera: str, tick: int, image: RGBImage) -> Picture:
        """Encode an RGB image, uint8, shape (height, width, 3)."""
        small = Image.fromarray(image)
        small.thumbnail((PICTURE_PX, PICTURE_PX))
        buffer = io.BytesIO()
        small.save(buffer, "WEBP", quality=80)
        return Picture(
            camera=camera,
            tick=tick,
            data="data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode(),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class AuditReport:
    """Content of a report."""

    title: str
    """Headline."""
    result: AuditResult
    """The audit."""
    pictures: Mapping[tuple[str, int], Sequence[Picture]] = field(default_factory=dict)
    """Check and number of its finding to the pictures that show it."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Episode to where it is found."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """What was audited, and how."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Package to version."""
    command: str = ""
    """Command that repeats the audit."""


def summary_line(result: AuditResult) -> str:
    """Say the outcome in a sentence."""
    faulty = {name for check in result.checks for name in check.faulty_episodes}
    counts = result.counts
    parts = [f"{counted(counts['faults'], 'check')} of {len(result.checks)} found faults"]
    if len(faulty) > result.episodes:  # those that bags have and the dataset lacks count, too
        parts[0] += f", in {counted(len(faulty), 'episode')} with the missing ones (the dataset has {result.episodes})"
    elif faulty:
        parts[0] += f", in {len(faulty)} of {counted(result.episodes, 'episode')}"
    else:
        parts[0] += f" in {counted(result.episodes, 'episode')}"
    if counts["warnings"]:
        parts.append(f"{counts['warnings']} only warn{'s' if counts['warnings'] == 1 else ''}")
    if counts["unchecked"]:
        parts.append(f"{counts['unchecked']} could not be made")
    if result.unreadable:
        parts.append(f"{counted(len(result.unreadable), 'episode')} could not be read")
    return "; ".join(parts)


def as_plain(report: AuditReport) -> dict[str, Any]:
    """Return the report as plain data, the content of ``audit.json``."""
    result = report.result
    return {
        "title": report.title,
        "clean": result.clean,
        "summary": summary_line(result),
        "episodes": result.episodes,
        "steps": result.steps,
        "checks": [_plain_check(check, report) for check in result.checks],
        "unreadable": dict(result.unreadable),
        "facts": dict(report.facts),
        "versions": dict(report.versions),
        "command": report.command,
    }


def _plain_check(check: CheckResult, report: AuditReport) -> dict[str, Any]:
    return {
        "name": check.name,
        "title": check.title,
        "status": check.status,
        "checked": check.checked,
        "unchecked": dict(check.unchecked),
        "faulty": len(check.faulty_episodes),
        "rate": check.rate,
        "threshold": check.threshold,
        "reason": check.reason,
        "findings": [
            {
                "severity": finding.severity.value,
                "text": finding.text,
                "episodes": list(finding.episodes),
                "sources": [report.sources[name] for name in finding.episodes if report.sources.get(name)],
                "ticks": list(finding.ticks),
                "cameras": list(finding.cameras),
            }
            for finding in check.findings
        ],
    }


def write_audit(report: AuditReport, folder: Path) -> Path:
    """Write ``report.html`` and ``audit.json``.

    Args:
        report: Content of the report.
        folder: Existing folder.

    Returns:
        The HTML file.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("roboxim_datasets.audit", "templates"), autoescape=True, undefined=StrictUndefined
    )
    checks = [_check_view(check, report) for check in report.result.checks]
    page = environment.get_template("audit.html").render(
        report=report, summary=summary_line(report.result), checks=checks, words=STATUS
    )
    write_json(folder / "audit.json", as_plain(report))
    path = folder / "report.html"
    write_whole(path, page)
    return path


def _check_view(check: CheckResult, report: AuditReport) -> dict[str, Any]:
    """Return what the page shows of a check; findings with pictures come first."""
    numbered = list(enumerate(check.findings))
    numbered.sort(key=lambda item: (item[1] not in check.faults, (check.name, item[0]) not in report.pictures))
    return {
        "check": check,
        "findings": [
            {
                "finding": finding,
                "pictures": report.pictures.get((check.name, number), ()),
                "chart": chart(finding) if place < 3 else None,
                "sources": [report.sources[name] for name in finding.episodes if report.sources.get(name)],
            }
            for place, (number, finding) in enumerate(numbered[:SHOWN_FINDINGS])
        ],
        "more": max(0, len(check.findings) - SHOWN_FINDINGS),
    }


def chart(finding: Finding) -> dict[str, Any] | None:
    """Return a finding's curves as points of an SVG polyline, with its ticks; none: it has no curve."""
    curves = {name: np.array(values, float) for name, values in finding.series.items() if len(values) > 1}
    if not curves:
        return None
    width, height = CHART
    finite = np.concatenate([values[np.isfinite(values)] for values in curves.values()])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    span = high - low or 1.0
    longest = max(len(values) for values in curves.values())

    def x_of(tick: float) -> float:
        return round(width * tick / (longest - 1), 1)

    def y_of(value: float) -> float:
        return round(height * (1 - (min(max(value, low), high) - low) / span), 1)

    return {
        "curves": {
            name: " ".join(f"{x_of(i)},{y_of(value)}" for i, value in enumerate(values) if np.isfinite(value))
            for name, values in curves.items()
        },
        "low": f"{low:.3g}",
        "high": f"{high:.3g}",
        "last": longest - 1,
        "marks": [x_of(tick) for tick in finding.ticks if tick < longest],
    }
