"""The datasets that an experiment's trainer reads: their format, and the options of their export.

An experiment decides which episodes a dataset has. Its trainer, and the dataset itself (``export``), say how they are
written: format, images, state, actions, rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.conventions import load_convention
from roboxim_core.errors import ConfigError, InvalidRequestError, one_of
from roboxim_datasets.dataset import CONVENTION_FILE
from roboxim_eval.experiments import ExperimentConfig
from roboxim_eval.experiments.trainers import TrainerConfig
from roboxim_recorder.export import EXPORTERS, Selection

OURS = (
    "val_fraction", "split", "only_successful", "keep_recovered", "where", "per_cell", "cell_counts", "uneven",
    "shard", "skip_missing",
)  # fmt: skip
"""Options of an export that the experiment decides."""


def export_config(form: str, options: Mapping[str, Any], *, source: str = "dataset", **fixed: Any) -> Selection:
    """Return the configuration of a dataset's export.

    Args:
        form: Registered format, e.g. ``rlds``.
        options: Options of the trainer and of the dataset, by the names of the format's configuration.
        source: What the options belong to, for messages.
        **fixed: Those that the experiment decides, ``where`` and ``per_cell``; none: only to check the options.

    Raises:
        ConfigError: When there is no such format, option or convention, or a value is wrong.
    """
    if form not in EXPORTERS:
        raise ConfigError(f"{source}: no format '{form}'; {one_of(EXPORTERS, form)}")
    kind = EXPORTERS[form]().config
    for name in options:
        if name in OURS:
            raise ConfigError(f"{source}: the experiment decides about '{name}', which episodes a dataset has")
    try:
        config: Selection = from_plain({**options, "val_fraction": 0.0, **fixed}, kind, source=source)
    except InvalidRequestError as error:
        raise ConfigError(f"{source}: {error}") from None
    if config.convention:
        load_convention(config.convention)
    return config


def convention_file(form: str, options: Mapping[str, Any], folder: Path) -> Path:
    """Return the convention file beside a dataset: the requests to a policy that was trained with it.

    Args:
        form: Format of the dataset.
        options: Options of its export.
        folder: Folder that it is exported to.
    """
    path: Path = EXPORTERS[form]().path(folder, export_config(form, options))
    return path / CONVENTION_FILE


def require_readable(config: ExperimentConfig, trainer: TrainerConfig) -> None:
    """Check the formats and options of all trainers, and what the chosen one is to learn from.

    Args:
        config: The experiment.
        trainer: The chosen trainer.

    Raises:
        ConfigError: Naming the key.
    """
    for name, one in config.trainers.items():
        export_config(one.format, one.export, source=f"trainers.{name}.dataset")
    for name, dataset in config.datasets.items():
        source = f"datasets.{name}.export"
        options = {**trainer.export, **dataset.export}
        export_config(trainer.format, options, source=source)
        trained = any(condition.train == name for condition in config.conditions.values())
        convention = trainer.options.get("convention", "{convention}")
        if trained and dataset.export and convention not in ("{convention}", options.get("convention")):
            raise ConfigError(
                f"{source}: the trainer's policy uses convention '{convention}', regardless of its training; write "
                "options: {convention: '{convention}'} in the trainer, or choose another one (--trainer)"
            )
        if trained and trainer.is_own and options.get("convention"):
            raise ConfigError(
                f"{source}: '{trainer.command.split(' --')[0]}' cannot learn from convention "
                f"'{options['convention']}', since it learns motions in RoboXim's own units and axes; choose another "
                "trainer (--trainer external, or a file of yours), or say the meaning by actions, e.g. {actions: tool}"
            )
