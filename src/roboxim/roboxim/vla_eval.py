"""RoboXim as a benchmark of vla-eval: ``benchmark: "roboxim.vla_eval:RoboXimBenchmark"``; needs the extra vla-eval."""

from __future__ import annotations

from roboxim_runs.environments.vla_eval_benchmark import RoboXimBenchmark

__all__ = ["RoboXimBenchmark"]
