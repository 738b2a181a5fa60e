"""The report of a benchmark: scores of its dimensions and experiments, with published ones beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from roboxim_eval.benchmark.card import (
    BenchmarkCard,
    Bounds,
    OpenBounds,
    dimension_sentence,
    percent_text,
    points_text,
    rate_text,
)
from roboxim_eval.benchmark.config import Reference, ReferenceScore
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.report.charts.forest import RATES, ForestRow, ratio_scale
from roboxim_eval.report.episodes import links_into
from roboxim_eval.report.experiment import (
    by_level,
    heat_maps,
    primary_forest,
    provenance_of,
)
from roboxim_eval.report.page import render
from roboxim_eval.report.scores import behind_scores, score_rows


@dataclass(frozen=True, kw_only=True)
class BenchmarkRow:
    """Scores of a dimension or of an experiment."""

    name: str
    """Its name."""
    dimension: bool
    """Whether it is a dimension."""
    absolute: Bounds
    """Success rate in held-out cells."""
    baseline: Bounds
    """That of the baseline there."""
    gap: OpenBounds
    """The baseline's success rate minus the absolute score."""
    relative: Bounds | None
    """Ratio to the baseline; none: refused."""
    published: ReferenceScore | None = None
    """Published scores; none: not published."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Score to the address of its episodes; empty: no other page lists them."""

    @property
    def absolute_text(self) -> str:
        """The success rate with its interval."""
        return rate_text(self.absolute)

    @property
    def baseline_text(self) -> str:
        """The baseline's success rate with its interval."""
        return rate_text(self.baseline)

    @property
    def gap_text(self) -> str:
        """The gap with its interval."""
        return points_text(self.gap)

    @property
    def relative_text(self) -> str:
        """The ratio with its interval."""
        return "refused" if self.relative is None else percent_text(self.relative)

    @property
    def published_texts(self) -> tuple[str, str]:
        """The published scores."""
        if self.published is None:
            return "-", "-"
        relative = self.published.relative
        return f"{self.published.absolute:.2f}", "-" if relative is None else f"{100 * relative:.0f} %"


def benchmark_rows(card: BenchmarkCard, pages: Mapping[str, str] | None = None) -> Iterator[BenchmarkRow]:
    """Yield the scores of each dimension, then those of each experiment.

    Args:
        card: The card.
        pages: Experiment to the address of its own page; none: numbers have no links.
    """
    reference, own = card.reference or Reference(name=""), pages or {}
    for name, score in card.dimensions.items():
        yield BenchmarkRow(
            name=name, dimension=True, absolute=score.absolute,
            baseline=score.baseline, gap=score.gap, relative=score.relative, published=reference.dimensions.get(name),
        )  # fmt: skip
    for name, one in card.experiments.items():
        assert one.scores is not None, "a benchmark's card has no dimensions otherwise"
        relative, link = one.scores["relative"], links_into(own.get(name, ""))
        yield BenchmarkRow(
            name=name, dimension=False, absolute=tuple(one.scores["absolute"]),
            baseline=tuple(one.scores["baseline"]), gap=tuple(one.scores["gap"]),
            relative=None if relative is None else tuple(relative), published=reference.experiments.get(name),
            links={score: link(**behind) for score, behind in behind_scores(one).items()},
        )  # fmt: skip


def benchmark_page(
    card: BenchmarkCard, *, command: str = "", pages: Mapping[str, str] | None = None,
    warnings: Mapping[str, Sequence[str]] | None = None,
) -> str:  # fmt: skip
    """Return the page as HTML.

    Args:
        card: The card.
        command: Command that runs the benchmark again; empty: unknown.
        pages: Experiment to the address of its own page, to whose episodes its numbers link; none: no links.
        warnings: Experiment to further limitations of its results, besides its card's warnings.
    """
    rows, own, limitations = list(benchmark_rows(card, pages)), pages or {}, warnings or {}
    return render(
        "benchmark.html",
        title=f"Benchmark {card.name}, scale {card.scale}",
        card=card,
        sentences=[dimension_sentence(name, score) for name, score in card.dimensions.items()],
        rows=rows,
        charts=list(_charts(rows)),
        experiments=[
            _experiment(name, one, own.get(name, ""), limitations.get(name, ()))
            for name, one in card.experiments.items()
        ],
        command=command,
    )


def _charts(rows: Iterable[BenchmarkRow]) -> Iterator[dict[str, Any]]:
    """Yield the picture of the absolute scores, and of the relative ones that are not refused."""
    absolute = _chart(rows, lambda row: row.absolute, lambda published: published.absolute)
    yield {"heading": "Absolute: success in held-out cells, %", "rows": absolute, "scale": RATES}
    relative = _chart(rows, lambda row: row.relative, lambda published: published.relative)
    if relative:
        heading = "Relative: share of the baseline's success, %"
        yield {"heading": heading, "rows": relative, "scale": ratio_scale(relative)}


def _chart(
    rows: Iterable[BenchmarkRow],
    found: Callable[[BenchmarkRow], Bounds | None],
    published: Callable[[ReferenceScore], float | None],
) -> list[ForestRow]:
    return [
        ForestRow(
            label=row.name,
            value=bounds[0],
            low=bounds[1],
            high=bounds[2],
            kind="total" if row.dimension else "cell",
            number=f"{100 * bounds[0]:.0f} ({100 * bounds[1]:.0f} to {100 * bounds[2]:.0f})",
            link=f"#dimension-{row.name}" if row.dimension else f"#{row.name}",
            published=published(row.published) if row.published else None,
        )
        for row in rows
        if (bounds := found(row)) is not None
    ]


def _experiment(name: str, card: Card, page: str, warnings: Sequence[str]) -> dict[str, Any]:
    design = design_of_card(card)
    arms = outcomes_of_card(card).arms
    link = links_into(page)
    return {
        "name": name,
        "page": page,
        "warnings": (*card.warnings, *warnings),
        "about": card.experiment.config.about,
        "card": card,
        "scores": list(score_rows(card, link)),
        "heat": heat_maps(card, design, arms, link),
        "by_level": by_level(design, arms, link),
        "forest": primary_forest(card, design, arms, link),
        "provenance": provenance_of(card),
    }
