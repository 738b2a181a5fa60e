"""Configuration shared by all runs of episodes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from roboxim_core.config import load_yaml, named_config
from roboxim_core.episode import RunConfig
from roboxim_core.errors import ConfigError
from roboxim_core.shards import Shard
from roboxim_core.user_folders import expanded
from roboxim_runs.episodes.task_choice import DEFAULT_TASK, mix_of, shares_text, task_text
from roboxim_runs.events import Notice, OnEvent
from roboxim_runs.storage.folder import checked_path
from roboxim_runs.storage.store import Store
from roboxim_sim.rendering import RENDERERS

SIZE_PX = (16, 4096)
"""Smallest and largest side of an image."""


MAX_EPISODES = 10**7
"""Largest number of episodes of a run, whose indices are kept in memory."""


@dataclass(frozen=True, kw_only=True)
class EpisodesConfig:
    """Configuration shared by all runs of episodes."""

    out: Path | str
    """The run's folder."""
    episodes: int = 0
    """Number of episodes; 0: those of a mix, else `usual`."""
    task: str = ""
    """Task of ``config/tasks``, or a YAML file; empty: that of the skill, or ``pick_cube``."""
    skill: str = ""
    """A skill instead of a task; or several, separated by commas, which share the episodes."""
    suite: str = ""
    """A suite of ``config/suites`` instead of a task, e.g. ``core``."""
    objects: Sequence[str] = ()
    """``[ROLE=]MODEL[,MODEL]``: object models of the target, or of another role."""
    distractors: str = ""
    """Number or range of distractors, e.g. ``1-3``; empty: as configured."""
    colors: str = ""
    """Comma-separated colours of the target; empty: as configured."""
    cameras: Sequence[str] = ()
    """``NAME[=VIEW]``: the cameras, and the files of ``config/cameras`` for their poses; empty: as configured."""
    lights: Sequence[str] = ()
    """Names in ``config/lights``, drawn for each episode; empty: as configured."""
    textures: Sequence[str] = ()
    """``SURFACE=NAME`` for table, floor or wall; empty: as configured."""
    look: str = ""
    """Set of looks in ``config/looks``, e.g. ``varied``, drawn for each episode; empty: as configured."""
    robot: str = ""
    """Arm in ``config/robots``, e.g. ``xarm7``; empty: the scene's."""
    seed: int = 0
    """Seed of the run."""
    workers: int = field(default_factory=lambda: min(2, os.cpu_count() or 1))
    """Processes, each with its own graph."""
    size: int | tuple[int, int] = 0
    """Image size [px]: the side of a square, or width and height; 0: as configured."""
    rate: float = 0.0
    """Control rate [Hz]; 0: the policy's, or the task's if the policy acts at any rate."""
    renderer: str = "raster"
    """``raster`` (needs EGL), ``tiny`` (PyBullet's own), or ``photo`` (Blender; slow)."""
    depth: bool = False
    """Whether the cameras also give depth."""
    segmentation: bool = False
    """Whether the cameras also give segmentation."""
    repair: bool = False
    """Whether to repeat the episodes whose bag or result is lost or damaged, instead of refusing to continue."""
    shard: str = ""
    """``I/N``: run only the I-th of N parts of the episodes, for `roboxim_runs.storage.merging`; empty: all."""
    store: str = ""
    """URL for bags and results, e.g. ``s3://bucket/demos``, see `roboxim_runs.storage.store`; empty: ``out``."""

    usual: ClassVar[int] = 1
    """Number of episodes of a task of one skill."""

    def __post_init__(self) -> None:
        """Check the values that need no other file.

        Raises:
            ConfigError: On a number out of range, an unknown renderer, a wrong shard, or a folder's name that is too
                long.
        """
        checked_path(self.out)
        if str(self.out).startswith("~"):
            object.__setattr__(self, "out", expanded(self.out))
        for name in ("objects", "cameras", "lights", "textures"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))
        for name, minimum in (("episodes", 0), ("workers", 1), ("seed", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool):
                raise ConfigError(f"{name} must be a whole number, got {value!r}")
            if value < minimum:
                raise ConfigError(f"{name} must be >= {minimum}, got {value}")
        sides = self.image_size
        if len(sides) != 2 or not all(isinstance(side, int) for side in sides):
            raise ConfigError(f"size must be a whole number or two (width, height), got {self.size!r}")
        for side in sides:
            if side and not SIZE_PX[0] <= side <= SIZE_PX[1]:
                raise ConfigError(f"size must be {SIZE_PX[0]} to {SIZE_PX[1]} px, or 0: as configured; got {side}")
        RENDERERS[self.renderer]
        if self.store:
            with Store.opened(self.store):
                pass
        if self.episodes > MAX_EPISODES:
            raise ConfigError(f"episodes must be at most {MAX_EPISODES}, got {self.episodes}; begin several runs")
        if self.episodes and not self.indices:
            raise ConfigError(f"shard {self.shard} of {self.episodes} episodes has none; take fewer shards")

    @property
    def indices(self) -> range:
        """Indices of the episodes to run."""
        return Shard.parse(self.shard).indices(self.episodes)

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]; 0: as configured."""
        return (self.size, self.size) if isinstance(self.size, int) else self.size

    @property
    def task_name(self) -> str:
        """The task's name, for reports."""
        if self.suite:
            version = load_yaml(named_config("suites", self.suite)).get("version", 0)
            return f"suite {Path(self.suite).stem}, version {version}"
        skills = [word.strip().rpartition("/")[2] for word in self.skill.split(",")]
        return Path(self.task).stem or ", ".join(skills) or DEFAULT_TASK

    def task_text(self) -> str:
        """Return the task configuration as YAML text.

        Raises:
            ConfigError: When there is no such task or skill, or the result is not valid.
        """
        return task_text(
            self.task, skill=self.skill, suite=self.suite, objects=self.objects, distractors=self.distractors,
            colors=self.colors,
            cameras=self.cameras, lights=self.lights, textures=self.textures, look=self.look, robot=self.robot,
        )  # fmt: skip

    def sized(self, task_config: str, on_event: OnEvent) -> Self:
        """Return the configuration with a number of episodes, and report how the cells of a mix share them.

        Args:
            task_config: As `task_text` returns it.
            on_event: Receives the counts.

        Raises:
            ConfigError: When the shard has no episode.
        """
        mix = mix_of(task_config)
        episodes = self.episodes or (sum(mix.counts) if mix else self.usual)
        if mix:
            on_event(Notice(text=shares_text(mix, episodes)))
        return replace(self, episodes=episodes)

    def run_config(self, task_config: str, **more: Any) -> RunConfig:
        """Return the episode loop's configuration.

        Args:
            task_config: As `task_text` returns it.
            **more: Further fields.
        """
        width, height = self.image_size
        common = {
            "run_seed": self.seed, "task_config": task_config, "image_width": width, "image_height": height,
            "rate_hz": self.rate, "depth": self.depth, "segmentation": self.segmentation,
            "output_dir": str(checked_path(self.out)),
        }  # fmt: skip
        return RunConfig(**{**common, **more})
