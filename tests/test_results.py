"""Published results: every card in ``docs/results`` follows from its counts, and its tables are the card's."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from roboxim_eval.benchmark.card import check_benchmark_card, is_benchmark_card
from roboxim_eval.experiments.card_checks import check_card
from roboxim_eval.report.markdown import benchmark_markdown, experiment_markdown
from roboxim_runs.experiments.benchmark import benchmark_warnings
from roboxim_runs.experiments.report import card_warnings

CARDS = sorted((Path(__file__).parents[1] / "docs/results").glob("*/card.json"))


@pytest.mark.parametrize("file", CARDS, ids=lambda file: file.parent.name)
def test_published_results_follow_from_their_counts(file: Path) -> None:
    data = json.loads(file.read_text())
    if is_benchmark_card(data):
        benchmark = check_benchmark_card(data)
        text = benchmark_markdown(benchmark, warnings=benchmark_warnings(benchmark))
    else:
        card = check_card(data)
        text = experiment_markdown(card, warnings=card_warnings(card))
    assert file.with_name("results.md").read_text() == text, "renew it: report --from card.json --markdown"
