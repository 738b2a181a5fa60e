"""Trains a policy on an exported dataset."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.config import from_plain, load_yaml, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.user_folders import expanded
from roboxim_core.whole_files import write_json, write_whole
from roboxim_datasets.dataset import EXPORT_FILE
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.view import encoded
from roboxim_policies.act.config import ACTConfig
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.checkpoint_file import family_in, read_description
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.families import config_class
from roboxim_policies.rt1s.config import RT1SConfig
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.policies.specs import CHECKPOINT, PolicySpec
from roboxim_runs.storage.folder import checked_path, locked, make_folder
from roboxim_runs.storage.occupied import require_own

FIRST_BATCH = "first_batch.png"
"""File in a training's folder that shows its first samples."""
SHOWN = 10
"""Samples in that picture."""
TRAINED_ON = "trained_on.json"
"""File in a training's folder that names the export which the trainer read: its identity and cells."""

__all__ = [
    "TRAINED_ON", "ACTConfig", "BCConfig", "RT1SConfig", "TrainingResult", "read_config", "train_policy",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """Result of a training."""

    family: str
    """Family of the policy."""
    checkpoint: Path
    """The checkpoint."""
    steps: int
    """Optimiser steps of the checkpoint, over all calls."""
    chosen: str
    """How the policy's weights were chosen; empty: they are the last step's."""
    steps_now: int
    """Steps of this call; 0: it was trained already."""
    wall_s: float
    """Duration of this call [s]."""

    @property
    def policy(self) -> PolicySpec:
        """Policy spec of the trained policy, for `evaluate`."""
        return PolicySpec(spec=self.family, options={CHECKPOINT: str(self.checkpoint)})


def train_policy(
    dataset: Path | str,
    out: Path | str = "",
    config: LearningConfig | None = None,
    *,
    start: Path | str = "",
    limit: int = 0,
    until: int = 0,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> TrainingResult:
    """Train a policy of any family on a dataset.

    Ctrl-C or a cancellation saves a checkpoint. The same call continues from it and ends with the same weights.

    Args:
        dataset: A dataset of any registered format.
        out: Folder of the checkpoint; empty: the family's folder in ``runs``.
        config: Configuration of a family's network and training; none: that of ``start``, else bc's defaults.
        start: Checkpoint to begin with (fine-tuning), of the same family and shape; empty: weights are drawn.
        limit: Largest number of episodes to use; 0: all.
        until: Step after which to end for now, with a checkpoint that the same call continues; 0: the last one.
        on_event: Receives the run's events.
        cancellation: Ends the training when it is set.

    Raises:
        CancelledError: When the training was cancelled.
        ConfigError: When the folder is not a dataset, ``out`` holds something else than this training, or ``start`` is
            a checkpoint of another family or shape.
        UnavailableError: When the family needs ``roboxim[pretrained]``, which is not installed.
    """
    settings = config or (read_config("", None, start=Path(start)) if start else BCConfig())
    folder = checked_path(out or f"runs/{settings.FAMILY}")
    checked_path(dataset)
    dataset = expanded(dataset)
    if folder.is_file():
        make_folder(folder)  # says so
    require_own(folder, "train")
    from roboxim_policies.learning.checkpoint import load_checkpoint  # importing JAX takes a second
    from roboxim_policies.learning.data import read_demonstrations
    from roboxim_policies.learning.train import Trainer, TrainProgress

    started = time.monotonic()
    reporter = Reporter(on_event, cancellation)
    began_with = load_checkpoint(Path(start)) if start else None
    with reporter.stage("reading demonstrations") as reading:
        read = read_demonstrations(
            Path(dataset), image_sizes=settings.image_sizes, side_of=settings.side_of, limit=limit, progress=reading
        )
        data, held_out = read.split(settings.held_out, settings.seed)
        del read  # its images are copies
    make_folder(folder)
    with locked(folder):  # two trainings would write one checkpoint in turns
        for left in folder.glob(".*.partial"):  # by a killed training, see `whole_files`
            left.unlink(missing_ok=True)
        with reporter.stage("encoding pictures") if settings.ENCODER else nullcontext(_ignore_progress) as encoding:
            trainer = Trainer(data, settings, folder, encoding=encoding, held_out=held_out, start=began_with)
        name_dataset(Path(dataset), folder)
        before = trainer.step

        def unfinished() -> str:
            return (
                f"checkpoint after {trainer.step} of {settings.steps} steps: {trainer.path}; the same call or command "
                "continues from it"
            )

        def training(progress: TrainProgress) -> None:
            report(progress.step, note=f"loss {progress.loss:.3f}, {progress.steps_per_s:.1f} steps/s")

        if before == 0:
            write_first_batch(trainer.first_batch(SHOWN), folder / FIRST_BATCH)
            reporter.notice(
                f"a picture of its first samples, recorded and as the network sees them: {folder / FIRST_BATCH}"
            )
        if not trainer.done:
            reporter.notice(f"continuing from step {before}" if before else "")
            with reporter.resumable(unfinished), reporter.stage("training", settings.steps, "steps", before) as report:
                trainer.run(training, until=until)
        return TrainingResult(
            family=settings.FAMILY,
            checkpoint=trainer.path,
            steps=trainer.step,
            steps_now=trainer.step - before,
            chosen=f"step {trainer.chosen.step}: {trainer.chosen}" if trainer.chosen else "",
            wall_s=time.monotonic() - started,
        )


def _ignore_progress(done: int, total: int) -> None:
    """Ignore progress."""


def write_first_batch(samples: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]], file: Path) -> None:
    """Write a picture of samples: for each camera a row of what was recorded, below it a row of what a network sees.

    Args:
        samples: By camera, the recorded and the seen pictures, each of shape (N, side, side, 3) in 0..1.
        file: The PNG file.
    """
    rows = [np.concatenate(np.asarray(pictures), axis=1) for each in samples.values() for pictures in each]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1.0) for row in rows]
    picture = (255 * np.concatenate(padded).clip(0, 1)).round().astype(np.uint8)
    write_whole(file, encoded(picture.repeat(2, axis=0).repeat(2, axis=1), "PNG"))


def name_dataset(dataset: Path, training: Path) -> None:
    """Write which export a training reads; experiments prove by it what a checkpoint was trained on.

    Args:
        dataset: The dataset.
        training: Folder of the training.

    Raises:
        ConfigError: When the folder is not a dataset.
    """
    folder = open_dataset(dataset).folder
    file = folder / EXPORT_FILE
    facts = read_json_object(file) if file.is_file() else {}
    named = {"identity": facts.get("identity", ""), "cells": facts.get("cells", {})}
    write_json(training / TRAINED_ON, named)


def read_config(
    family: str, file: Path | None, changes: Mapping[str, Any] | None = None, *, start: Path | None = None
) -> LearningConfig:
    """Return a training's configuration.

    Args:
        family: Family of the policy; empty: that of ``start``.
        file: YAML file with fields of its configuration; none: the defaults.
        changes: Fields that replace those of the file.
        start: Checkpoint whose configuration has what neither gives; none: the defaults.

    Raises:
        ConfigError: When the file is missing or empty, a field is unknown or wrong, or the checkpoint is of another
            family.
    """
    base: dict[str, Any] = {}
    if start is not None:
        description = read_description(start)
        found = family_in(description)
        if family not in ("", found):
            raise ConfigError(f"{start} is a checkpoint of '{found}', not of '{family}': roboxim train {found}")
        family, base = found, description["config"]
    cls = config_class(family)
    content = {} if file is None else load_yaml(file)
    if content is None:
        raise ConfigError(f"{file} is empty; expected fields such as 'steps: 500', or omit --config")
    if base and isinstance(content, Mapping):
        content = {**base, **content}
    read = from_plain(content, cls, source=str(file or start))
    return from_plain({**to_plain(read), **changes}, cls, source="--set") if changes else read
