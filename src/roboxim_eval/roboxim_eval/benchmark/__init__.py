"""Benchmarks: several experiments and a score for each dimension that they vary. Plain values, no ROS."""

from roboxim_eval.benchmark.config import BenchmarkConfig, benchmark_config, experiment_changes
from roboxim_eval.benchmark.scores import benchmark_scores

__all__ = ["BenchmarkConfig", "benchmark_config", "benchmark_scores", "experiment_changes"]
