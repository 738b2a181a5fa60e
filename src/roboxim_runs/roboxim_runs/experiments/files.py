"""Files of ``config/experiments``, ``config/trainers`` and ``config/benchmark``, checked before anything runs.

The rooms check their own parts: `roboxim_eval` the experiment, `roboxim_tasks` the task mixes that it expands to.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from roboxim_core.config import load_yaml, located, named_config, to_plain
from roboxim_core.config_folders import config_names, is_path
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.merging import merged
from roboxim_core.plain_data.pictures import load_with_textures
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.whole_files import write_whole
from roboxim_eval.benchmark.config import BenchmarkConfig, benchmark_config, experiment_changes
from roboxim_eval.experiments import Design, ExperimentConfig, design_of, experiment_config, mix_of
from roboxim_eval.experiments.config import FULL
from roboxim_eval.experiments.design import require_different
from roboxim_eval.experiments.proving.cells_apart import PARTS, differing, undistinguished
from roboxim_eval.experiments.reductions import reductions
from roboxim_eval.experiments.rotation import rotated
from roboxim_eval.experiments.trainers import TRAINERS, TrainerConfig, trainer_config
from roboxim_runs.episodes_config import MAX_EPISODES
from roboxim_runs.experiments.delivery.demands import demands_in
from roboxim_runs.experiments.trained.exports import require_readable
from roboxim_runs.storage.occupied import require_own
from roboxim_tasks.config import TaskMix, task_mix


def load_experiment(
    name: str, scale: str = "full", *, changes: Mapping[str, Any] | None = None, trainer: str = ""
) -> ExperimentConfig:
    """Load ``config/experiments/<name>.yaml``, or a path to a YAML file, at a scale.

    The last of its deviations says what the scale changes.

    Args:
        name: Name, or path.
        scale: One of the file's scales, or ``full``.
        changes: Keys of the file to replace; none: the file as it stands.
        trainer: Trainer that will be chosen. One that the file lacks is added: a name in ``config/trainers``, or a
            path to a YAML file.

    Raises:
        ConfigError: When a file is missing or invalid, the scale is unknown, or the trainer cannot read a dataset.
    """
    path = named_config("experiments", name)
    data = located(load_with_textures(path), str(path))
    further = [Path(trainer).stem] if is_path(trainer) else []
    whole, config = (
        with_trainer(experiment_config(read, source=str(path), scale=chosen, trainers=further), trainer)
        for read, chosen in ((data, FULL), (merged(data, changes or {}), scale))
    )
    chosen = trainer_name(config, trainer) or next(iter(config.trainers), "")
    require_readable(config, config.trainers.get(chosen, TrainerConfig()))
    return _stating_reductions(config, whole, _scale_words(scale), trainer)


def fitted_experiment(
    name: str, scale: str, config: ExperimentConfig, trainer: str = "", how: str = " in a budget"
) -> ExperimentConfig:
    """Return an experiment whose numbers a budget has chosen, with deviations that state these numbers.

    Args:
        name: Its name or path, see `load_experiment`.
        scale: The scale before the budget chose.
        config: The experiment with the chosen numbers.
        trainer: See `load_experiment`.
        how: What chose the numbers, after the scale's name.
    """
    before = _scale_words(scale)
    config = replace(config, deviations=tuple(one for one in config.deviations if not one.startswith(before)))
    whole = load_experiment(name, trainer=trainer)
    return _stating_reductions(config, whole, f"Scale {scale}{how}: ", trainer)


def _scale_words(scale: str) -> str:
    return f"Scale {scale}: "


def _stating_reductions(
    config: ExperimentConfig, whole: ExperimentConfig, words: str, trainer: str
) -> ExperimentConfig:  # fmt: skip
    """Return an experiment with one more deviation, which states how it differs from the original."""
    reduced = reductions(whole, config, trainer_name(config, trainer))
    return replace(config, deviations=(*config.deviations, f"{words}{reduced}.")) if reduced else config


def with_trainer(config: ExperimentConfig, name: str) -> ExperimentConfig:
    """Return an experiment that has a trainer, added from its own file if the experiment lacks it.

    A trainer's file that does not say how many steps it trains takes those of the experiment's first trainer: the
    experiment knows how long its trainings are, at each scale.

    Args:
        config: The experiment at its scale.
        name: Name of one of its trainers or of a file in ``config/trainers``, or a path to a YAML file; empty: no
            trainer is added.

    Raises:
        ConfigError: When there is no such trainer, or its file is invalid.
    """
    if not name or name in config.trainers or not config.datasets:
        return config
    key = trainer_name(config, name)
    if key in config.trainers:
        raise ConfigError(f"{name}: the experiment has another trainer '{key}'; give the file another name")
    if key == name and name not in config_names(TRAINERS):
        known = [*config.trainers, *config_names(TRAINERS)]
        raise ConfigError(
            f"no trainer '{name}' in the experiment or in config/{TRAINERS}; {one_of(known, name)}, or name a YAML file"
        )
    path = named_config(TRAINERS, name)
    trainer = trainer_config(load_yaml(path), source=str(path))
    if not trainer.steps and config.trainers:
        trainer = replace(trainer, steps=next(iter(config.trainers.values())).steps)
    return replace(config, trainers={**config.trainers, key: trainer})


def trainer_name(config: ExperimentConfig, trainer: str) -> str:
    """Return the name that an experiment, its designs and its cards know a trainer by: of a file, that of the file.

    Args:
        config: The experiment.
        trainer: Name, or path to a YAML file; empty: the experiment's first one.
    """
    return Path(trainer).stem if is_path(trainer) and trainer not in config.trainers else trainer


def known_as(name: str) -> str:
    """Return the name of an experiment for its page and for the rates of this machine; cards keep that of the file.

    Args:
        name: Its name or path, see `load_experiment`: the name of the file, of an ``experiment.yaml`` that of its
            folder, since the files of published experiments are all called so.
    """
    path = Path(name)
    folder = path.parent.name if is_path(name) and path.stem == "experiment" else ""
    return path.stem if folder in ("", "..") else folder


def write_experiment(config: ExperimentConfig, path: Path) -> None:
    """Write an experiment at its scale as a file that `load_experiment` reads; the file has no other scales.

    Args:
        config: The experiment, e.g. with numbers that a budget chose.
        path: The YAML file.

    Raises:
        ConfigError: When the file exists, or its name does not end like that of a YAML file.
    """
    if path.suffix not in (".yaml", ".yml"):  # `load_experiment` would take it for the name of an experiment
        raise ConfigError(
            f"an experiment's file must end in .yaml, got {path}; e.g. {path.with_name(path.name + '.yaml')}"
        )
    _require_free(path)
    content = json.loads(json.dumps({**to_plain(config), "scales": {}}))
    write_whole(path, yaml.safe_dump(content, sort_keys=False))


def _require_free(path: Path) -> None:
    if path.exists():
        raise ConfigError(f"{path} exists; choose another file")


def run_words(file: Path, config: ExperimentConfig, trainer: str, command: str = "experiment run") -> str:
    """Return the command that runs a file that `write_experiment` or `write_rotated` wrote.

    Args:
        file: The file.
        config: The experiment, or a part of it.
        trainer: The trainer that it was written for, see `load_experiment`; the file has it.
        command: Command of ``roboxim``.
    """
    name = trainer_name(config, trainer)
    words = ["roboxim", *command.split(), str(file), *(["--trainer", name] if name else []), "--out", "OUT"]
    return shell_line(*words)


def write_rotated(
    name: str, scale: str, trainer: str, sets: int, held_out: int, replicates: int, folder: Path
) -> list[Path]:
    """Write the parts of a rotated design as a folder of configuration, see `roboxim_eval.experiments.rotation`.

    Args:
        name: The experiment, see `load_experiment`.
        scale: Its scale.
        trainer: See `load_experiment`.
        sets: Number of held-out sets.
        held_out: Number of cells of a set.
        replicates: Trainings of each condition in a part.
        folder: Folder to write to, for ``ROBOXIM_CONFIG_PATH``.

    Returns:
        A file for each part, and last the benchmark of all of them.

    Raises:
        ConfigError: When no such sets exist, a file exists, or the folder is none of configuration.
    """
    config, stem = load_experiment(name, scale, trainer=trainer), f"{Path(name).stem}_rotated"
    parts = {
        f"{stem}_{number}": fitted_experiment(name, scale, part, trainer, ", rotated")
        for number, part in enumerate(rotated(config, sets, held_out, replicates))
    }
    require_own(folder, "experiment rotate")
    paths = [folder / "experiments" / f"{part}.yaml" for part in parts]
    paths.append(folder / "benchmark" / f"{stem}.yaml")
    for path in paths:
        _require_free(path)
    for key, part in parts.items():
        checked_design(key, part, trainer)
    for key, path in zip(parts, paths, strict=False):  # the last is the benchmark's
        write_experiment(parts[key], path)
    benchmark = {"about": f"{config.about} Held-out sets rotate.", "experiments": list(parts)}
    write_whole(paths[-1], yaml.safe_dump(benchmark, sort_keys=False))
    return paths


def load_benchmark(name: str) -> BenchmarkConfig:
    """Load ``config/benchmark/<name>.yaml``, or a path to a YAML file.

    Raises:
        ConfigError: When the file is missing or invalid.
    """
    path = named_config("benchmark", name)
    return benchmark_config(located(load_with_textures(path), str(path)), source=str(path))


def benchmark_experiments(config: BenchmarkConfig, scale: str, trainer: str = "") -> dict[str, ExperimentConfig]:
    """Return the experiments of a benchmark at a scale.

    Args:
        config: The benchmark.
        scale: One of its scales.
        trainer: Trainer that will be chosen, see `load_experiment`.

    Raises:
        ConfigError: When a file is missing or invalid, or has no such scale.
    """
    changes = experiment_changes(config, scale)
    return {name: load_experiment(name, scale, changes=changes, trainer=trainer) for name in config.experiments}


def checked_design(name: str, config: ExperimentConfig, trainer: str = "") -> Design:
    """Expand an experiment and check every task mix that it consists of.

    Args:
        name: Name of the experiment, for messages.
        config: The experiment at its scale.
        trainer: One of its trainers as it was given to `load_experiment`; empty: the first one.

    Raises:
        ConfigError: When the experiment or one of its task mixes is invalid, no proof could tell a held-out cell from a
            cell of a dataset, or two conditions would be trained alike.
    """
    design = design_of(config, trainer_name(config, trainer))
    _require_few_episodes(name, design)
    require_different(design)
    once = {cell.key: 1 for cell in design.cells}  # all mixes consist of these cells, with other counts
    mix = task_mix(mix_of(config, once), source=f"experiment '{name}'")
    changes = [condition.set for condition in config.conditions.values()]
    for number, change in enumerate(changes):
        if change and change not in changes[:number]:
            task_mix(mix_of(config, once, change), source=f"experiment '{name}'")
    _require_distinguishable(name, design, mix)
    return design


def _require_few_episodes(name: str, design: Design) -> None:
    """Refuse an experiment of which a stage would refuse its number of episodes.

    Raises:
        ConfigError: Naming the episodes, and the largest number.
    """
    stages = {"demonstrations": design.demonstrations}
    stages |= {f"rollouts of '{one.condition}'": one.counts for one in design.evaluations}
    for what, counts in stages.items():
        if (number := sum(counts.values())) > MAX_EPISODES:
            raise ConfigError(
                f"experiment '{name}' has {number} {what}, at most {MAX_EPISODES} are allowed; take fewer"
            )


def _require_distinguishable(name: str, design: Design, mix: TaskMix) -> None:
    """Refuse an experiment whose demonstrations cannot be distinguished from those of a held-out cell.

    Args:
        name: Name of the experiment.
        design: Its design.
        mix: The mix of its cells.

    Raises:
        ConfigError: Naming the first two such cells, and the properties that distinguish cells.
    """
    unseen = [cell.key for cell in design.cells if cell.unseen]
    held_out = {data: [cell for cell in unseen if cell not in counts] for data, counts in design.datasets.items()}
    if not any(held_out.values()):
        return
    demands = demands_in(mix)
    for data, cells in held_out.items():
        for cell, other in undistinguished(demands, cells, design.datasets[data]):
            parts = " and ".join(differing(demands[cell], demands[other]))
            shared = f"differ in {parts}, but may share values there" if parts else "differ in nothing that bags show"
            raise ConfigError(
                f"experiment '{name}': the held-out cell '{cell}' and the cell '{other}' of dataset '{data}' {shared}, "
                "so the proof of the training data would take demonstrations of the one for the other; expected values "
                f"that exclude each other in at least one of {', '.join(PARTS)}. Give both cells such values in "
                "factors, or hold both of them out or none in unseen"
            )


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
