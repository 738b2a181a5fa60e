"""Checkpoints that RoboXim's own trainings of an experiment begin with, and whether they had met held-out cells.

A condition names one in the arguments of its trainings, e.g. ``arguments: {act: --from runs/broad/broad.npz}``. What
the card states about it is read from the trained checkpoint, which names its start and the content of the pre-training.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Design, mix_of
from roboxim_eval.experiments.card import Attestation
from roboxim_eval.experiments.config import TASK
from roboxim_policies.learning.checkpoint_file import checkpoint_file, read_description
from roboxim_runs.training.pretraining import TARGET, handled_in
from roboxim_tasks.config import task_mix

FROM = "--from"
"""Option of ``roboxim train`` that names the checkpoint to begin with."""


def start_of(design: Design, arguments: str) -> Path | None:
    """Return the checkpoint that a training begins with; none: random weights, or the trainer is not RoboXim's own.

    Args:
        design: The experiment.
        arguments: What its condition adds to the trainer's command.

    Raises:
        ConfigError: When ``--from`` names none.
    """
    if not design.trainer.is_own:
        return None
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument(FROM, dest="start")
    try:
        found = parser.parse_known_args(shlex.split(f"{design.trainer.command} {arguments}"))[0].start
    except (argparse.ArgumentError, ValueError) as error:
        raise ConfigError(f"arguments of a training: {error} in '{arguments}'") from None
    return Path(found) if found else None


def start_digests(design: Design) -> dict[str, str]:
    """Return the hash of the weights that each training begins with; those that begin at random are left out.

    Returns:
        ``CONDITION.R`` to the hash; empty: its checkpoint is not there.

    Raises:
        ConfigError: When a file is there and is no checkpoint.
    """
    starts = {f"{t.condition}.{t.replicate}": start_of(design, t.arguments) for t in design.trainings}
    digests = {
        path: str(read_description(path)["digest"]) if checkpoint_file(path).is_file() else ""
        for path in set(starts.values()) if path is not None
    }  # fmt: skip
    return {name: digests[path] for name, path in starts.items() if path is not None}


def require_start(design: Design, name: str) -> None:
    """Check that the checkpoint that a training begins with is there.

    Args:
        design: The experiment.
        name: ``CONDITION.R``.

    Raises:
        ConfigError: When it is missing.
    """
    training = next(t for t in design.trainings if f"{t.condition}.{t.replicate}" == name)
    path = start_of(design, training.arguments)
    if path is not None and not checkpoint_file(path).is_file():
        raise ConfigError(
            f"conditions.{training.condition}: its trainings begin with {path}, which is not there; make it first, "
            f"e.g. with 'roboxim pretrain FAMILY --out {path.parent}', or name another checkpoint"
        )


def with_start(attest: Attestation, design: Design, folder: Path) -> Attestation:
    """Return what is attested about a training, with the start that its checkpoint names if the trainer is RoboXim's.

    Args:
        attest: What is attested; it holds where there is no checkpoint.
        design: The experiment.
        folder: Folder of the training.
    """
    if not design.trainer.is_own or not checkpoint_file(folder).is_file():
        return attest
    start: Mapping[str, Any] = read_description(folder).get("started_from", {})
    if not start:
        return replace(attest, pretraining="none", exposure="no")
    before: Mapping[str, Any] = start.get("pretraining", {})
    name = f"{before['name']}, weights {start['digest']}" if before else f"weights {start['digest']}"
    return replace(attest, pretraining=name, exposure=_exposure(design, before.get("exposure", {})))


def _exposure(design: Design, content: Mapping[str, Any]) -> str:
    """Return whether demonstrations contained held-out cells.

    A cell whose skill and object never occurred together was not there. One whose pair occurred was there if cells
    differ in nothing else.

    Args:
        design: The experiment.
        content: What was demonstrated, see `roboxim_runs.training.pretraining.exposure_of`; empty: unknown.
    """
    unseen = {cell.key: 1 for cell in design.cells if cell.unseen}
    if not unseen:
        return "no"
    if content.get("pairs_of") != TARGET:  # unknown content, or counts of an earlier version
        return "unknown"
    tasks = task_mix(mix_of(design.config, unseen)).cells
    held_out = {
        f"{task.skill} {model}" for task in tasks for one in handled_in(task.objects) for model in one.models.values
    }  # fmt: skip
    steps = {step for skill in content["skills"] if "+" in skill for step in skill.split("+")}
    in_steps = {f"{step} {model}" for step in steps for model in content["objects"]}
    if held_out & set(content["pairs"]):
        pairs = set(design.config.factors) <= {TASK, *(role for task in tasks for role in task.objects)}
        return "yes" if pairs else "unknown"
    return "unknown" if held_out & in_steps else "no"
