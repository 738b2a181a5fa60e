"""Files of ``config/experiments`` and ``config/benchmark``, checked as a whole before anything runs.

The rooms check their own parts: `roboxim_eval` the experiment, `roboxim_tasks` the task mixes that it expands to.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from roboxim_core.config import load_yaml, located, named_config
from roboxim_core.merging import merged
from roboxim_eval.benchmark import BenchmarkConfig, benchmark_config, experiment_changes
from roboxim_eval.experiments import Design, ExperimentConfig, design_of, experiment_config, mix_of
from roboxim_tasks.config import task_mix


def load_experiment(name: str, scale: str = "full", *, changes: Mapping[str, Any] | None = None) -> ExperimentConfig:
    """Load ``config/experiments/<name>.yaml``, or a path to a YAML file, at a scale.

    Args:
        name: Name, or path.
        scale: One of the file's scales, or ``full``.
        changes: Keys of the file to replace; none: the file as it stands.

    Raises:
        ConfigError: When the file is missing or invalid, or its scale is unknown.
    """
    path = named_config("experiments", name)
    data = located(load_yaml(path), str(path))
    return experiment_config(merged(data, changes or {}), source=str(path), scale=scale)


def load_benchmark(name: str) -> BenchmarkConfig:
    """Load ``config/benchmark/<name>.yaml``, or a path to a YAML file.

    Raises:
        ConfigError: When the file is missing or invalid.
    """
    path = named_config("benchmark", name)
    return benchmark_config(located(load_yaml(path), str(path)), source=str(path))


def benchmark_experiments(config: BenchmarkConfig, scale: str) -> dict[str, ExperimentConfig]:
    """Return the experiments of a benchmark at a scale.

    Raises:
        ConfigError: When a file is missing or invalid, or has no such scale.
    """
    changes = experiment_changes(config, scale)
    return {name: load_experiment(name, scale, changes=changes) for name in config.experiments}


def checked_design(name: str, config: ExperimentConfig, trainer: str = "") -> Design:
    """Expand an experiment and check every task mix that it consists of.

    Args:
        name: Name of the experiment, for messages.
        config: The experiment at its scale.
        trainer: Name of a trainer of the file; empty: the first one.

    Raises:
        ConfigError: When the experiment or one of its task mixes is invalid.
    """
    design = design_of(config, trainer)
    once = {cell.key: 1 for cell in design.cells}
    changes = [condition.set for condition in config.conditions.values()]
    for number, change in enumerate(changes):
        if change not in changes[:number]:  # all mixes consist of these cells, with other counts
            task_mix(mix_of(config, once, change), source=f"experiment '{name}'")
    return design


def mixes(design: Design) -> dict[str, Any]:
    """Return the task mixes of an experiment by name, as plain data: of the demonstrations and of each condition."""
    config = design.config
    found = {"demonstrations": mix_of(config, design.demonstrations)} if design.demonstrations else {}
    for evaluation in design.evaluations:
        if not evaluation.checkpoint and not evaluation.replicate:
            changes = config.conditions[evaluation.condition].set
            found[f"evaluate_{evaluation.condition}"] = mix_of(config, evaluation.counts, changes)
    for name, counts in design.datasets.items():
        found[f"dataset_{name}"] = mix_of(config, counts)
    return found


def write_mixes(design: Design, folder: Path) -> list[Path]:
    """Write the task mixes of an experiment as YAML files that ``generate`` and ``evaluate`` accept by ``--task``."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, mix in mixes(design).items():
        paths.append(folder / f"{name}.yaml")
        paths[-1].write_text(yaml.safe_dump(json.loads(json.dumps(mix)), sort_keys=False))
    return paths
