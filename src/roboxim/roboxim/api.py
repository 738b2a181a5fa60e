"""The runs as functions, with their configurations' fields as keyword arguments."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from roboxim_core.errors import ConfigError, one_of
from roboxim_runs.datasets import export
from roboxim_runs.datasets.export import ExportConfig, ExportReport, Hdf5Config, LeRobotConfig
from roboxim_runs.episodes import generation, rerendering
from roboxim_runs.episodes.generation import GenerationConfig, GenerationResult
from roboxim_runs.episodes.rerendering import RerenderConfig, Rerendered, find_bags
from roboxim_runs.evaluation import run as evaluation
from roboxim_runs.evaluation.results import EvaluationResult
from roboxim_runs.evaluation.run import EvaluationConfig
from roboxim_runs.events import OnEvent, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.training import run as training
from roboxim_runs.training.run import BCConfig, TrainingResult

C = TypeVar("C")
F = TypeVar("F", bound=Callable[..., Any])


def _configured(cls: type[C], config: C | None, fields: dict[str, Any]) -> C:
    """Return a configuration made from keyword arguments, or a given configuration with fields replaced.

    Raises:
        ConfigError: On an unknown field, or without a required one.
    """
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for name in fields:
        if name not in names:
            raise ConfigError(f"{cls.__name__} has no field '{name}'; {one_of(names, name)}")
    if config is not None:
        return dataclasses.replace(config, **fields)  # type: ignore[type-var]
    required = [
        field.name
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    ]
    missing = [name for name in required if name not in fields]
    if missing:
        raise ConfigError(f"{cls.__name__} needs {' and '.join(missing)}")
    return cls(**fields)


def _with_fields_of(cls: type[Any]) -> Callable[[F], F]:
    """Return a decorator that adds a configuration's fields to a function's signature, for help and completion."""

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        fields = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for parameter in inspect.signature(cls).parameters.values()
        ]
        function.__signature__ = signature.replace(parameters=[*own, *fields])  # type: ignore[attr-defined]
        return function

    return decorate


@_with_fields_of(GenerationConfig)
def generate(
    config: GenerationConfig | None = None,
    /,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    **fields: Any,
) -> GenerationResult:
    """Generate demonstrations of a task with the expert; see `roboxim_runs.episodes.generation.generate`.

    The same call continues where it stopped.

    Args:
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        on_event: Receives the run's events, e.g. ``roboxim.EventPrinter()``.
        cancellation: Ends the run when it is set, e.g. a `threading.Event`.
        executor: Runs the episodes; none: processes of this machine.
        **fields: Fields of `GenerationConfig`.

    Raises:
        RoboximError: As the run raises it.
    """
    return generation.generate(
        _configured(GenerationConfig, config, fields), on_event=on_event, cancellation=cancellation, executor=executor
    )


@_with_fields_of(ExportConfig)
def export_rlds(
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: ExportConfig | None = None,
    /,
    *,
    overwrite: bool = False,
    gate: int = 0,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    **fields: Any,
) -> ExportReport:
    """Export the bags of runs as RLDS; see `roboxim_runs.datasets.export.export_dataset`.

    Args:
        source: A run's folder, a folder of bags, or one bag; or several of them.
        target: Data directory to write ``<name>/<version>`` into.
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        overwrite: Replace an existing dataset.
        gate: Number of episodes to execute again before the dataset gets its place; 0: none.
        workers: Processes that execute them.
        on_event: Receives the run's events.
        cancellation: Ends the export when it is set.
        **fields: Fields of `ExportConfig`.

    Raises:
        RoboximError: As the run raises it.
    """
    return export.export_dataset(
        "rlds", source, target, _configured(ExportConfig, config, fields), overwrite=overwrite, gate=gate,
        workers=workers, on_event=on_event, cancellation=cancellation,
    )  # fmt: skip


@_with_fields_of(LeRobotConfig)
def export_lerobot(
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: LeRobotConfig | None = None,
    /,
    *,
    overwrite: bool = False,
    gate: int = 0,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    **fields: Any,
) -> ExportReport:
    """Export the bags of runs as a LeRobot dataset; see `roboxim_runs.datasets.export.export_dataset`.

    Args:
        source: A run's folder, a folder of bags, or one bag; or several of them.
        target: Folder of the dataset.
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        overwrite: Replace an existing dataset.
        gate: Number of episodes to execute again before the dataset gets its place; 0: none.
        workers: Processes that execute them.
        on_event: Receives the run's events.
        cancellation: Ends the export when it is set.
        **fields: Fields of `LeRobotConfig`, e.g. ``version``.

    Raises:
        RoboximError: As the run raises it.
    """
    return export.export_dataset(
        "lerobot", source, target, _configured(LeRobotConfig, config, fields), overwrite=overwrite, gate=gate,
        workers=workers, on_event=on_event, cancellation=cancellation,
    )  # fmt: skip


@_with_fields_of(Hdf5Config)
def export_hdf5(
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: Hdf5Config | None = None,
    /,
    *,
    overwrite: bool = False,
    gate: int = 0,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    **fields: Any,
) -> ExportReport:
    """Export the bags of runs as HDF5 in robomimic's layout; see `roboxim_runs.datasets.export.export_dataset`.

    Args:
        source: A run's folder, a folder of bags, or one bag; or several of them.
        target: Folder of the dataset.
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        overwrite: Replace an existing dataset.
        gate: Number of episodes to execute again before the dataset gets its place; 0: none.
        workers: Processes that execute them.
        on_event: Receives the run's events.
        cancellation: Ends the export when it is set.
        **fields: Fields of `Hdf5Config`.

    Raises:
        RoboximError: As the run raises it.
    """
    return export.export_dataset(
        "hdf5", source, target, _configured(Hdf5Config, config, fields), overwrite=overwrite, gate=gate,
        workers=workers, on_event=on_event, cancellation=cancellation,
    )  # fmt: skip


@_with_fields_of(BCConfig)
def train_bc(
    dataset: Path | str,
    /,
    out: Path | str = "runs/bc",
    config: BCConfig | None = None,
    *,
    limit: int = 0,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    **fields: Any,
) -> TrainingResult:
    """Train a small behaviour-cloning policy; see `roboxim_runs.training.run.train_bc`.

    Args:
        dataset: An RLDS export's folder.
        out: Folder of the checkpoint.
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        limit: Largest number of episodes to use; 0: all.
        on_event: Receives the run's events.
        cancellation: Ends the training when it is set; a checkpoint is saved.
        **fields: Fields of `BCConfig`, e.g. ``steps``.

    Raises:
        RoboximError: As the run raises it.
    """
    return training.train_bc(
        dataset, out, _configured(BCConfig, config, fields), limit=limit, on_event=on_event, cancellation=cancellation
    )


@_with_fields_of(EvaluationConfig)
def evaluate(
    config: EvaluationConfig | None = None,
    /,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    servers: Sequence[Executor] = (),
    **fields: Any,
) -> EvaluationResult:
    """Run policies in fresh scenes and write a report; see `roboxim_runs.evaluation.run.evaluate`.

    Args:
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Runs the episodes; none: processes of this machine.
        servers: Run one process each that serves a policy to all workers; none: each worker has the policy itself.
        **fields: Fields of `EvaluationConfig`, above all ``policies``.

    Raises:
        RoboximError: As the run raises it.
    """
    return evaluation.evaluate(
        _configured(EvaluationConfig, config, fields), on_event=on_event, cancellation=cancellation, executor=executor,
        servers=servers,
    )  # fmt: skip


@_with_fields_of(RerenderConfig)
def rerender(
    sources: Path | str | Sequence[Path | str],
    out: Path | str,
    config: RerenderConfig | None = None,
    /,
    *,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    **fields: Any,
) -> Rerendered:
    """Render recorded episodes again; see `roboxim_runs.episodes.rerendering.rerender`.

    Args:
        sources: Bags, folders of bags or runs.
        out: Folder of the new run.
        config: Base configuration, whose fields the keyword arguments replace; none: the defaults.
        workers: Processes, each with a renderer; 1: this process.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Renders the bags; none: processes of this machine.
        **fields: Fields of `RerenderConfig`.

    Raises:
        RoboximError: As the run raises it.
    """
    named = [sources] if isinstance(sources, Path | str) else sources
    bags = find_bags(map(Path, named))
    return rerendering.rerender(
        bags, out, _configured(RerenderConfig, config, fields), workers=workers, on_event=on_event,
        cancellation=cancellation, executor=executor,
    )  # fmt: skip
