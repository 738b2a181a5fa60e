"""Configuration of the runs of experiments and benchmarks."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.shards import Shard
from roboxim_runs.policies.specs import PolicySpec

SHARDED = ("generate", "evaluate")
"""Parts that consist of episodes, so that several machines can share each of their stages."""
KINDS = ("generate", "export", "train", "evaluate")
"""Parts of an experiment that may run alone; the proofs of training data are part of the export, those of rollouts of
the evaluation."""
RENDERER = "raster"
"""Renderer unless one is named."""


@dataclass(frozen=True, kw_only=True)
class SharedRunConfig:
    """What the runs of an experiment and of a benchmark have in common."""

    scale: str = "full"
    """One of the scales of the file, or of a benchmark's experiments."""
    trainer: str = ""
    """Trainer: a name in the file or in ``config/trainers``, or a YAML file; empty: the file's first one."""
    only: tuple[str, ...] = KINDS
    """Kinds of stages to run."""
    workers: int = field(default_factory=lambda: min(2, os.cpu_count() or 1))
    """Processes that run episodes."""
    trainings: int = 1
    """Trainings of an experiment at a time. Results do not depend on it."""
    renderer: str = RENDERER
    """Renderer of the images, the same for demonstrations and rollouts."""
    fresh: bool = False
    """Whether to evaluate in fresh scenes: the folder's seed of fresh scenes, drawn now unless it has one. A
    benchmark's experiments share it."""
    scene_seed: int = 0
    """Seed of the scenes, e.g. that of a published run in fresh scenes; 0: the folder's, or the public one."""


@dataclass(frozen=True, kw_only=True)
class ExperimentRunConfig(SharedRunConfig):
    """Configuration of an experiment's run."""

    experiment: str
    """Name in ``config/experiments``, or a YAML file."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the file to replace, e.g. a benchmark's own scales."""
    benchmark: str = ""
    """Benchmark that it is a part of, for the command that runs it again; empty: none."""
    out: Path | str = "runs/experiment"
    """The run's folder."""
    policies: Mapping[str, PolicySpec] = field(default_factory=dict)
    """Policies that exist: ``CONDITION.REPLICATE``, or ``CONDITION`` for all replicates, to the policy."""
    shard: str = ""
    """``I/N``: run only the I-th of N parts of the episodes of each generation and evaluation; empty: everything."""
    trained: Path | str = ""
    """Folder of the whole experiment, whose trainings a shard evaluates; with ``fresh``, of a finished run in the
    public scenes, whose trainings are evaluated again; empty: ``out``."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            ConfigError: When a kind of stage is unknown, or a shard is to run stages that have no episodes.
        """
        for kind in self.only:
            if kind not in KINDS:
                raise ConfigError(f"only: no stages of kind '{kind}'; {one_of(KINDS, kind)}")
        if self.trainings < 1:
            raise ConfigError(f"trainings: expected at least 1 at a time, got {self.trainings}")
        Shard.parse(self.shard)
        if self.shard and not set(self.only) <= set(SHARDED):
            raise ConfigError(
                "a shard runs episodes, and the other stages need all of them: run --only generate in shards and "
                "merge them, run --only generate,export,train on the whole, then --only evaluate in shards with "
                "--trained WHOLE"
            )
        if self.trained and not self.shard and not self.fresh:
            raise ConfigError(
                "--trained is for --shard and --fresh: without them the experiment's folder has the trainings"
            )
        if self.fresh and self.shard:
            raise ConfigError(
                "--fresh draws a seed for the whole experiment: leave it out of a shard, which takes the seed of the "
                "folder that --trained names; 'roboxim experiment attest --out WHOLE' draws it"
            )
        if self.fresh and self.scene_seed:
            raise ConfigError("--fresh draws a seed; leave out --scene-seed")
