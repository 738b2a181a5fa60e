"""RoboXim as a benchmark of vla-eval: ``benchmark: "roboxim.vla_eval:RoboXimBenchmark"``; needs the extra vla-eval."""

from __future__ import annotations

from roboxim_core.plain_data.extras import explained

try:
    from roboxim_runs.environments.vla_eval_benchmark import RoboXimBenchmark
except ModuleNotFoundError as error:
    raise explained(error) or error from None

__all__ = ["RoboXimBenchmark"]
