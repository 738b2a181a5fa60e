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
    from roboxim.api import (
        evaluate,
        export_hdf5,
        export_lerobot,
        export_rlds,
        generate,
        rerender,
        train_act,
        train_bc,
        train_rt1s,
    )
    from roboxim_cli.printer import EventPrinter
    from roboxim_core.actions import ActionSemantics
    from roboxim_core.episode import EpisodeResult
    from roboxim_core.errors import ConfigError, RoboximError
    from roboxim_core.policies import CameraRequirement
    from roboxim_policies import BasePolicy
    from roboxim_runs import events
    from roboxim_runs.datasets.export import ExportConfig, ExportReport, Hdf5Config, LeRobotConfig
    from roboxim_runs.episodes.generation import GenerationConfig, GenerationResult
    from roboxim_runs.episodes.rerendering import RerenderConfig
    from roboxim_runs.evaluation.beside_training import Evaluator
    from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
    from roboxim_runs.evaluation.run import EvaluationConfig
    from roboxim_runs.executors import CancelledError, Executor, InlineExecutor, LocalExecutor
    from roboxim_runs.policies.specs import PolicySpec
    from roboxim_runs.training.run import BCConfig, TrainingResult
    from roboxim_studio.notebook import view

__all__ = [
    "ActionSemantics",
    "BCConfig",
    "BasePolicy",
    "CameraRequirement",
    "CancelledError",
    "ConfigError",
    "EpisodeResult",
    "EvaluationConfig",
    "EvaluationResult",
    "Evaluator",
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
    "train_act",
    "train_bc",
    "train_rt1s",
    "view",
]

_HOMES = {
    "roboxim.api": (
        "evaluate",
        "export_hdf5",
        "export_lerobot",
        "export_rlds",
        "generate",
        "rerender",
        "train_act",
        "train_bc",
        "train_rt1s",
    ),  # fmt: skip
    "roboxim_runs.executors": ("CancelledError", "Executor", "InlineExecutor", "LocalExecutor"),
    "roboxim_cli.printer": ("EventPrinter",),
    "roboxim_runs": ("events",),
    "roboxim_runs.evaluation.run": ("EvaluationConfig",),
    "roboxim_runs.evaluation.beside_training": ("Evaluator",),
    "roboxim_runs.evaluation.results": ("EvaluationResult", "PolicyResult"),
    "roboxim_runs.datasets.export": ("ExportConfig", "ExportReport", "Hdf5Config", "LeRobotConfig"),
    "roboxim_runs.episodes.generation": ("GenerationConfig", "GenerationResult"),
    "roboxim_runs.policies.specs": ("PolicySpec",),
    "roboxim_runs.episodes.rerendering": ("RerenderConfig",),
    "roboxim_runs.training.run": ("BCConfig", "TrainingResult"),
    "roboxim_core.actions": ("ActionSemantics",),
    "roboxim_core.episode": ("EpisodeResult",),
    "roboxim_core.policies": ("CameraRequirement",),
    "roboxim_policies": ("BasePolicy",),
    "roboxim_studio.notebook": ("view",),
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
