"""The page that shows models side by side."""

from __future__ import annotations

from collections.abc import Mapping

from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.models import Models
from roboxim_eval.report.charts.forest import RATES, ForestRow, difference_scale
from roboxim_eval.report.episodes import any_of, links_into
from roboxim_eval.report.page import render
from roboxim_eval.report.scores import score_rows


def models_page(models: Models, cards: Mapping[str, Card], pages: Mapping[str, str] | None = None) -> str:
    """Return the page as HTML.

    Args:
        models: The comparison.
        cards: Model to its card, for its own scores.
        pages: Model to the address of its own page, which has its episodes; none: no links.
    """
    links = {name: links_into((pages or {}).get(name, "")) for name in cards}
    met = {"arm": models.condition, "cell": any_of(models.cells)}
    rates = [
        ForestRow(
            label=name, value=model.rate.value, low=model.rate.low, high=model.rate.high, kind="cell",
            number=f"{model.successes} of {model.episodes}", link=links[name](**met),
        )
        for name, model in models.models.items()
    ]  # fmt: skip
    apart = [
        ForestRow(
            label=f"{pair.first} - {pair.second}", value=pair.difference.value, low=pair.difference.low,
            high=pair.difference.high, number=f"p {pair.p:.2g}, {pair.test}",
        )
        for pair in models.pairs
    ]  # fmt: skip
    experiments = sorted({card.experiment.name for card in cards.values()})
    return render(
        "models.html",
        title=f"{len(cards)} models on {' and '.join(experiments)}",
        models=models,
        rates=rates,
        rate_scale=RATES,
        apart=apart,
        apart_scale=difference_scale(apart),
        scores={name: list(score_rows(card, links[name])) for name, card in cards.items()},
        links={name: (link(**met), link(**met, outcome="error")) for name, link in links.items()},
        pages=pages or {},
    )
