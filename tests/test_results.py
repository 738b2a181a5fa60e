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


@pytest.mark.parametrize("file", CARDS, ids=lambda file: file.parent.name)
def test_pairs_of_published_cards_agree_with_their_counts(file: Path) -> None:
    """A scene that a proof excludes from one arm is missing from the pairs, and from nothing else."""
    data = json.loads(file.read_text())
    for card in data["experiments"].values() if is_benchmark_card(data) else (data,):
        config = check_card(card).experiment.config
        counts = {
            (row["condition"], row["replicate"]): row["by_cell"] for row in card["evaluations"] if not row["checkpoint"]
        }
        for number, rows in card["pairs"].items():
            compare = config.compare[int(number)]
            for replicate, (both, first, second, neither) in enumerate(rows):
                one, two = counts[compare.first, replicate], counts[compare.second, replicate]
                common = [cell for cell in one if cell in two]
                missing = [sum(arm[c][1] for c in common) - (both + first + second + neither) for arm in (one, two)]
                if compare.where != "all":
                    continue  # pairs are those of some cells
                for arm, solved, gone in zip((one, two), (both + first, both + second), missing, strict=True):
                    successes = sum(arm[cell][0] for cell in common)
                    assert 0 <= successes - solved <= gone <= 1, (number, replicate)
