"""Builds an experiment from plain data, at a scale, and checks that names refer to what the file defines."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any

from roboxim_core.config import from_plain, place
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.merging import merged
from roboxim_eval.experiments.combinations import expanded, names_of
from roboxim_eval.experiments.config import FULL, TASK, ExperimentConfig, Match
from roboxim_eval.experiments.drawing import with_draws
from roboxim_eval.experiments.trainers import TRAINERS


def experiment_config(
    data: Any, *, source: str = "experiment", scale: str = FULL, trainers: Collection[str] = ()
) -> ExperimentConfig:  # fmt: skip
    """Build an experiment from plain data, at a scale.

    Args:
        data: As returned by `roboxim_core.config.parse_yaml`.
        source: Name of the data's source, for messages.
        scale: Name of one of the file's scales; ``full`` is the file without replaced keys unless the file redefines
            it.
        trainers: Further trainers that ``arguments`` may name, besides those of the file and of ``config/trainers``.

    Raises:
        ConfigError: When keys are wrong; names each with its path, its line and the allowed values.
    """
    config: ExperimentConfig = from_plain(with_draws(data, source), ExperimentConfig, source=source)
    _check(config, data, source, trainers)
    names = scale_names(config)
    if scale not in names:
        raise ConfigError(f"{source} has no scale '{scale}'; {one_of(names, scale)}")
    if scale not in config.scales:
        return expanded(config)
    scaled = merged(data, {**config.scales[scale], "scales": None})
    where = f"{source}, scale '{scale}'"
    small: ExperimentConfig = from_plain(with_draws(scaled, where), ExperimentConfig, source=where)
    _check(small, scaled, where, trainers)
    return replace(expanded(small), scales=config.scales)


def scale_names(config: ExperimentConfig) -> tuple[str, ...]:
    """Return the names of an experiment's scales, ``full`` last."""
    return (*(name for name in config.scales if name != FULL), FULL)


def _check(config: ExperimentConfig, data: Any, source: str, trainers: Collection[str]) -> None:
    """Check that names refer to what the file defines.

    Raises:
        ConfigError: On the first one that does not; names its place.
    """

    def require(name: str, known: Iterable[str], *path: str | int) -> None:
        names = tuple(known)
        if name not in names:
            raise ConfigError(f"{_at(source, data, path)}: unknown name '{name}'; {one_of(names, name)}")

    for factor, levels in config.factors.items():
        if not isinstance(levels, list | tuple | Mapping) or not levels:
            raise ConfigError(
                f"{_at(source, data, ('factors', factor))}: needs a list or a mapping of levels, not empty"
            )
        if not isinstance(levels, Mapping) and len(set(levels)) != len(levels):
            raise ConfigError(f"{_at(source, data, ('factors', factor))}: a level appears twice")
    if TASK not in config.factors:
        raise ConfigError(f"{_at(source, data, ('factors',))}: needs the factor 'task', got {list(config.factors)}")
    for key in ("unseen", "cells"):
        for number, match in enumerate(getattr(config, key)):
            _check_match(require, config, match, key, number)
    for factor in config.dimensions:
        require(factor, config.factors, "dimensions", factor)
    for name, dataset in config.datasets.items():
        for number, match in enumerate(dataset.only):
            _check_match(require, config, match, "datasets", name, "only", number)
    made = names_of(config.combinations)
    if not config.conditions and not made:
        raise ConfigError(f"{_at(source, data, ('conditions',))}: needs at least one condition, or combinations")
    for name, condition in config.conditions.items():
        if condition.train:
            require(condition.train, (*config.datasets, *made), "conditions", name, "train")
        for trainer in condition.arguments:
            known = dict.fromkeys((*config.trainers, *config_names(TRAINERS), *trainers))
            require(trainer, known, "conditions", name, "arguments", trainer)
        if condition.checkpoint_of:
            trained = [*made, *(other for other, c in config.conditions.items() if not c.checkpoint_of)]
            require(condition.checkpoint_of, trained, "conditions", name, "checkpoint_of")
    for name in config.evaluate.cells:
        require(name, (*config.conditions, *made), "evaluate", "cells", name)
    for number, compare in enumerate(config.compare):
        require(compare.first, (*config.conditions, *made), "compare", number, "first")
        require(compare.second, (*config.conditions, *made), "compare", number, "second")
    if (made or any(condition.train for condition in config.conditions.values())) and not config.trainers:
        raise ConfigError(f"{_at(source, data, ('conditions',))}: conditions are trained, but there are no trainers")
    for name, changes in config.scales.items():
        for key in changes:
            require(
                key, ExperimentConfig.__dataclass_fields__.keys() - {"scales", "about", "thesis"}, "scales", name, key
            )


def _check_match(require: Any, config: ExperimentConfig, match: Match, *path: str | int) -> None:
    for factor, level in match.items():
        require(factor, config.factors, *path, factor)
        require(level, tuple(config.factors[factor]), *path, factor)


def _at(source: str, data: Any, path: tuple[str | int, ...]) -> str:
    return f"{source} is not valid: {place(data, path)}"
