"""The runs as functions, with their configurations' fields as keyword arguments."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from roboxim_core.errors import ConfigError, one_of
from roboxim_runs.datasets.export import ExportConfig, Hdf5Config, LeRobotConfig, export_dataset
from roboxim_runs.episodes import generation, rerendering
from roboxim_runs.evaluation import run as evaluation
from roboxim_runs.training import run as training

C = TypeVar("C")
R = TypeVar("R")


def _configured(cls: type[C], config: C | None, fields: dict[str, Any]) -> C:
    """Return a configuration made from keyword arguments, or a given configuration with fields replaced.

    Raises:
        ConfigError: On an unknown field, without a required one, or on a configuration of another class.
    """
    known = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in fields:
        if name not in known:
            raise ConfigError(f"{cls.__name__} has no field '{name}'; {one_of(known, name)}")
    if config is not None:
        if not isinstance(config, cls):
            raise ConfigError(f"config must be of {cls.__name__}, got {type(config).__name__}")
        return dataclasses.replace(config, **fields)  # type: ignore[type-var]
    unset = dataclasses.MISSING
    required = [name for name, field in known.items() if field.default is unset and field.default_factory is unset]
    missing = [name for name in required if name not in fields]
    if missing:
        raise ConfigError(f"{cls.__name__} needs {' and '.join(missing)}")
    return cls(**fields)


def _by_fields(name: str, run: Callable[..., R], cls: type[Any], *first: str) -> Callable[..., R]:
    """Return a run as a function that also takes the fields of its configuration, as keyword arguments.

    Args:
        name: Name of the function.
        run: The run; its parameter ``config`` takes the configuration.
        cls: Class of the configuration.
        *first: Values of the run's first parameters, which the function does not have.
    """
    whole = inspect.signature(run)
    own = list(whole.parameters.values())[len(first) :]
    own = [parameter.replace(default=None) if parameter.name == "config" else parameter for parameter in own]
    signature = whole.replace(parameters=own)
    keyword = inspect.Parameter.KEYWORD_ONLY
    fields = [parameter.replace(kind=keyword) for parameter in inspect.signature(cls).parameters.values()]

    def function(*arguments: Any, **named: Any) -> R:
        given = {key: named.pop(key) for key in list(named) if key not in signature.parameters}
        bound = signature.bind_partial(*arguments, **named)
        bound.arguments["config"] = _configured(cls, bound.arguments.get("config"), given)
        if "on_event" in signature.parameters and "on_event" not in bound.arguments and "ipykernel" in sys.modules:
            from roboxim_cli.printer import EventPrinter

            bound.arguments["on_event"] = EventPrinter()  # a notebook shows the progress at once
        return run(*first, *bound.args, **bound.kwargs)

    call = f"{run.__module__}.{run.__name__}" + (f"({', '.join(map(repr, first))}, ...)" if first else "")
    function.__name__ = function.__qualname__ = name
    function.__module__ = __name__
    function.__doc__ = (
        f"Call `{call}` with fields of `{cls.__name__}` as keyword arguments.\n\n"
        f"They replace the fields of ``config``; without it, the defaults.\n\n{inspect.getdoc(run)}"
    )
    function.__signature__ = signature.replace(parameters=[*own, *fields])  # type: ignore[attr-defined]
    return function


generate = _by_fields("generate", generation.generate, generation.GenerationConfig)
export_rlds = _by_fields("export_rlds", export_dataset, ExportConfig, "rlds")
export_lerobot = _by_fields("export_lerobot", export_dataset, LeRobotConfig, "lerobot")
export_hdf5 = _by_fields("export_hdf5", export_dataset, Hdf5Config, "hdf5")
train_bc = _by_fields("train_bc", training.train_policy, training.BCConfig)
train_rt1s = _by_fields("train_rt1s", training.train_policy, training.RT1SConfig)
train_act = _by_fields("train_act", training.train_policy, training.ACTConfig)
evaluate = _by_fields("evaluate", evaluation.evaluate, evaluation.EvaluationConfig)
rerender = _by_fields("rerender", rerendering.rerender, rerendering.RerenderConfig)
