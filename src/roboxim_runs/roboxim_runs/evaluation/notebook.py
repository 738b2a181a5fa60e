"""Results of an evaluation in a notebook: a table, and films."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from roboxim_core.errors import RecorderError

FILMS = 4
"""Films that an evaluation shows of each policy."""
FILM_PX = 160
"""Height of such a film [px]."""


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
