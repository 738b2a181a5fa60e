"""Benchmarks: several experiments and a score for each dimension that they vary. Plain values, no ROS."""

from roboxim_eval.benchmark.card import (
    BenchmarkCard,
    CardDimension,
    check_benchmark_card,
    concluded_benchmark,
    dimension_sentence,
    is_benchmark_card,
    percent_text,
    points_text,
    rate_text,
)
from roboxim_eval.benchmark.config import BenchmarkConfig, Reference, benchmark_config, experiment_changes
from roboxim_eval.benchmark.scores import benchmark_scores

__all__ = [
    "BenchmarkCard",
    "BenchmarkConfig",
    "CardDimension",
    "Reference",
    "benchmark_config",
    "benchmark_scores",
    "check_benchmark_card",
    "concluded_benchmark",
    "dimension_sentence",
    "experiment_changes",
    "is_benchmark_card",
    "percent_text",
    "points_text",
    "rate_text",
]
