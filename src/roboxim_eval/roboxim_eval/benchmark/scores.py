"""Scores of a benchmark by dimension, from the analyses of its experiments (section 6.3 of the thesis)."""

from __future__ import annotations

from collections.abc import Mapping

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Analysis, ExperimentConfig
from roboxim_eval.statistics.scores import DimensionScore, ExperimentScore, dimension_scores


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
