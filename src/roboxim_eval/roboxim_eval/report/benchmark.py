"""The report of a benchmark: scores of its dimensions and experiments, with published ones beside them."""

from __future__ import annotations

from typing import Any

from roboxim_eval.benchmark import BenchmarkCard, dimension_sentence
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.report.charts.heat_map import rate_map
from roboxim_eval.report.experiment import primary_forest, provenance_of, score_rows
from roboxim_eval.report.page import render
from roboxim_eval.statistics.tables import Arm


def benchmark_page(card: BenchmarkCard, *, command: str = "") -> str:
    """Return the page as HTML.

    Args:
        card: The card.
        command: Command that runs the benchmark again; empty: unknown.
    """
    reference = card.reference
    return render(
        "benchmark.html",
        title=f"Benchmark {card.name}, scale {card.scale}",
        card=card,
        dimensions=[
            (name, score, dimension_sentence(name, score), reference.dimensions.get(name) if reference else None)
            for name, score in card.dimensions.items()
        ],
        experiments=[_experiment(name, one, card) for name, one in card.experiments.items()],
        command=command,
    )


def _experiment(name: str, card: Card, benchmark: BenchmarkCard) -> dict[str, Any]:
    design = design_of_card(card)
    arms = {key: Arm(replicates=tuple(rows)) for key, rows in outcomes_of_card(card).counts.items()}
    return {
        "name": name,
        "about": card.experiment.config.about,
        "card": card,
        "varies": ", ".join(card.experiment.config.dimensions.values()),
        "scores": list(score_rows(card)),
        "reference": benchmark.reference.experiments.get(name) if benchmark.reference else None,
        "heat": [rate_map(key, design.cells, arm.by_cell, lambda _: f"#{name}") for key, arm in arms.items()],
        "forest": primary_forest(card, design, arms),
        "provenance": provenance_of(card),
    }
