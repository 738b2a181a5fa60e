"""The card of a benchmark: the cards of its experiments, and the score of each dimension that follows from them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError, listed
from roboxim_eval.benchmark.config import Reference
from roboxim_eval.experiments import Analysis, ExperimentConfig
from roboxim_eval.experiments.card import Card, sha256_of
from roboxim_eval.experiments.card_checks import analysis_of, check_card
from roboxim_eval.statistics.replicates import Interval
from roboxim_eval.statistics.scores import DimensionScore, ExperimentScore, dimension_scores

SCHEMA = "benchmark-3"
"""Version of the card's form; differs from that of an experiment's card."""

Bounds = tuple[float, float, float]
"""An estimate, and the lower and upper bound of its 95 % interval."""
OpenBounds = tuple[float, float | None, float | None]
"""A difference with its interval; null: unbounded, because each condition has one training."""


@dataclass(frozen=True, kw_only=True)
class CardDimension:
    """Score of a dimension."""

    absolute: Bounds
    """Mean success rate in held-out cells, over the experiments that vary the dimension."""
    baseline: Bounds
    """Mean success rate of the baselines in the same cells."""
    gap: OpenBounds
    """Mean of what holding out costs: the baseline's success rate minus the absolute score."""
    relative: Bounds | None
    """Mean ratio to the baseline; null: refused in an experiment."""
    experiments: tuple[str, ...]
    """The experiments that vary it."""
    refused: tuple[str, ...] = ()
    """Experiments whose ratio was refused."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkCard:
    """Results of a benchmark."""

    schema: str = SCHEMA
    """Version of this form."""
    name: str
    """Name of the benchmark's file."""
    scale: str
    """Scale at which it ran."""
    about: str = ""
    """The question."""
    thesis: str = ""
    """Section of the thesis that the shipped experiments follow (see the glossary); empty: none."""
    reference: Reference | None = None
    """Published results to stand beside these; null: none."""
    experiments: dict[str, Card]
    """Name to card."""
    dimensions: dict[str, CardDimension] = field(default_factory=dict)
    """Dimension to its score."""
    sha256: str = ""
    """Hash of all other keys, with the experiments' hashes in place of their cards."""

    @property
    def plain(self) -> dict[str, Any]:
        """The card as plain data."""
        data: dict[str, Any] = json.loads(json.dumps(to_plain(self)))
        return data

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each dimension, then the primary one of each experiment."""
        return (
            *(dimension_sentence(name, score) for name, score in self.dimensions.items()),
            *(f"{name}: {card.verdicts[0].sentence}" for name, card in self.experiments.items() if card.verdicts),
        )


def dimension_sentence(name: str, score: CardDimension) -> str:
    """Return the score of a dimension in words."""
    if score.relative is None:
        ratio = f"no relative score, since the ratio of {listed(score.refused)} is refused"
    else:
        ratio = f"{percent_text(score.relative)} of the baseline"
    baseline = f"the baseline has {rate_text(score.baseline)}, a gap of {points_text(score.gap)}"
    among = f"mean of {listed(score.experiments)}"
    return f"{name}: {rate_text(score.absolute)} absolute, {ratio}; {baseline}; {among}."


def rate_text(bounds: Bounds) -> str:
    """Format an estimate with its interval, e.g. ``0.69 (0.58 to 0.80)``."""
    value, low, high = bounds
    return str(Interval(value=value, low=low, high=high))


def percent_text(bounds: Bounds) -> str:
    """Format an estimate with its interval, e.g. ``86 % (72 to 104 %)``."""
    value, low, high = (f"{100 * x:.0f}" for x in bounds)
    return f"{value} % ({low} to {high} %)"


def points_text(bounds: OpenBounds) -> str:
    """Format a difference with its interval, e.g. ``+10 points (-2 to +22)``."""
    value, low, high = (None if x is None else f"{round(100 * x) + 0:+d}" for x in bounds)
    unbounded = low is None or high is None
    return f"{value} points ({'no interval from one training' if unbounded else f'{low} to {high}'})"


def concluded_benchmark(card: BenchmarkCard) -> BenchmarkCard:
    """Return a card with the dimensions and hash that follow from its experiments.

    Raises:
        ConfigError: When an experiment has no scores.
    """
    analyses = {name: (one.experiment.config, analysis_of(one)) for name, one in card.experiments.items()}
    dimensions = {
        name: CardDimension(
            absolute=_bounds(score.absolute), baseline=_bounds(score.baseline), gap=_open_bounds(score.gap),
            relative=None if score.relative is None else _bounds(score.relative), experiments=score.experiments,
            refused=score.refused,
        )
        for name, score in benchmark_scores(analyses).items()
    }  # fmt: skip
    found = replace(card, dimensions=dimensions, sha256="")
    hashes = {name: one.sha256 for name, one in card.experiments.items()}
    return replace(found, sha256=sha256_of({**found.plain, "experiments": hashes}))


def _bounds(interval: Interval) -> Bounds:
    return round(interval.value, 6), round(interval.low, 6), round(interval.high, 6)


def _open_bounds(interval: Interval) -> OpenBounds:
    value, low, high = _bounds(interval)
    return value, low if math.isfinite(low) else None, high if math.isfinite(high) else None


def is_benchmark_card(data: Any) -> bool:
    """Return whether plain data states that it is a benchmark's card."""
    return isinstance(data, Mapping) and data.get("schema") == SCHEMA


def check_benchmark_card(data: Any, *, source: str = "card") -> BenchmarkCard:
    """Recompute a benchmark's scores from the counts of its experiments, and refuse a card with other scores.

    Raises:
        ConfigError: When the data is no such card, or it or the card of an experiment was changed.
    """
    if not is_benchmark_card(data):
        raise ConfigError(f"{source} is no benchmark's card of schema {SCHEMA}")
    card: BenchmarkCard = from_plain(data, BenchmarkCard, source=source)
    for name, one in data["experiments"].items():
        check_card(one, source=f"{source}, experiment {name}")
    again = concluded_benchmark(card).plain
    for part in ("dimensions", "sha256"):
        if again[part] != data.get(part):
            raise ConfigError(f"{source}: its {part} do not follow from its experiments; it was changed")
    return card


def benchmark_scores(experiments: Mapping[str, tuple[ExperimentConfig, Analysis]]) -> dict[str, DimensionScore]:
    """Return the score of each dimension: the mean over the experiments that vary it.

    Args:
        experiments: Name to the experiment and its analysis.

    Raises:
        ConfigError: When an experiment has no scores, since it holds nothing out or has no baseline.
    """
    found = {}
    for name, (config, analysis) in experiments.items():
        if analysis.scores is None:
            raise ConfigError(f"experiment '{name}' has no scores: it needs held-out cells and a baseline")
        own = analysis.scores
        found[name] = ExperimentScore(
            dimensions=tuple(config.dimensions.values()), absolute=own.absolute, baseline=own.baseline,
            gap=own.gap.interval(), relative=own.relative.ratio,
        )  # fmt: skip
    return dimension_scores(found)
