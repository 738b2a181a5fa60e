"""RoboXim from a script or a notebook: generate, export, train, evaluate.

    import roboxim

    roboxim.generate(out="runs/demos", episodes=100, size=128)
    roboxim.export_rlds("runs/demos", "runs/demos-rlds")
    policy = roboxim.train_bc("runs/demos-rlds", out="runs/bc").policy
    evaluation = roboxim.evaluate(policies=[policy, "random"], out="runs/evaluation", size=128)
    print(evaluation.success_rate, evaluation.interval, evaluation.report)

The import starts nothing and loads nothing: each name is imported on first use. The functions print nothing;
``on_event=roboxim.EventPrinter()`` shows their progress as the command line does. Workers are separate programs, so a
script needs no ``if __name__ == "__main__"``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from roboxim._registration import register_with_gymnasium

if TYPE_CHECKING:
    from roboxim.api import evaluate, export_hdf5, export_lerobot, export_rlds, generate, rerender, train_bc
    from roboxim_bringup.executors import CancelledError, Executor, InlineExecutor, LocalExecutor
    from roboxim_bringup.printer import EventPrinter
    from roboxim_bringup.runs import events
    from roboxim_bringup.runs.evaluation import EvaluationConfig
    from roboxim_bringup.runs.evaluation_results import EvaluationResult, PolicyResult
    from roboxim_bringup.runs.export import ExportConfig, ExportReport, Hdf5Config, LeRobotConfig
    from roboxim_bringup.runs.generation import GenerationConfig, GenerationResult
    from roboxim_bringup.runs.policies import PolicySpec
    from roboxim_bringup.runs.rerendering import RerenderConfig
    from roboxim_bringup.runs.training import BCConfig, TrainingResult
    from roboxim_core.episode import EpisodeResult
    from roboxim_core.errors import ConfigError, RoboximError

__all__ = [
    "BCConfig",
    "CancelledError",
    "ConfigError",
    "EpisodeResult",
    "EvaluationConfig",
    "EvaluationResult",
    "EventPrinter",
    "Executor",
    "ExportConfig",
    "ExportReport",
    "GenerationConfig",
    "GenerationResult",
    "Hdf5Config",
    "InlineExecutor",
    "LeRobotConfig",
    "LocalExecutor",
    "PolicyResult",
    "PolicySpec",
    "RerenderConfig",
    "RoboximError",
    "TrainingResult",
    "evaluate",
    "events",
    "export_hdf5",
    "export_lerobot",
    "export_rlds",
    "generate",
    "rerender",
    "train_bc",
]

_HOMES = {
    "roboxim.api": ("evaluate", "export_hdf5", "export_lerobot", "export_rlds", "generate", "rerender", "train_bc"),
    "roboxim_bringup.executors": ("CancelledError", "Executor", "InlineExecutor", "LocalExecutor"),
    "roboxim_bringup.printer": ("EventPrinter",),
    "roboxim_bringup.runs": ("events",),
    "roboxim_bringup.runs.evaluation": ("EvaluationConfig",),
    "roboxim_bringup.runs.evaluation_results": ("EvaluationResult", "PolicyResult"),
    "roboxim_bringup.runs.export": ("ExportConfig", "ExportReport", "Hdf5Config", "LeRobotConfig"),
    "roboxim_bringup.runs.generation": ("GenerationConfig", "GenerationResult"),
    "roboxim_bringup.runs.policies": ("PolicySpec",),
    "roboxim_bringup.runs.rerendering": ("RerenderConfig",),
    "roboxim_bringup.runs.training": ("BCConfig", "TrainingResult"),
    "roboxim_core.episode": ("EpisodeResult",),
    "roboxim_core.errors": ("ConfigError", "RoboximError"),
}
"""Module to its public names."""


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            if module != "roboxim_core.errors":
                from roboxim_bringup.process import clean_environment

                clean_environment()  # before anything imports an rclpy that a sourced ROS brings
            home = importlib.import_module(module)
            value = getattr(home, name, None) or importlib.import_module(f"{module}.{name}")
            globals()[name] = value
            return value
    raise AttributeError(f"module 'roboxim' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__


register_with_gymnasium()
