"""Measures this machine's rates for ``roboxim experiment plan``, by a small run of every stage.

The rates are kept in the user's cache folder. Each measurement replaces the one before.
"""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from roboxim_bringup.executors import Cancellation
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_bringup.runs.events import Event, OnEvent, StageProgress, ignore
from roboxim_bringup.runs.export import ExportConfig, export_rlds
from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_bringup.runs.training import BCConfig, train_bc
from roboxim_core.config import from_json, to_json
from roboxim_core.documents import read_text
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Rates


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """What to measure."""

    mix: Path
    """Task mix to generate and evaluate, a YAML file."""
    size: tuple[int, int] = (128, 128)
    """Image size [px]."""
    episodes: int = 8
    """Demonstrations."""
    rollouts: int = 4
    """Rollouts of the policy that was trained with them."""
    steps: int = 60
    """Training steps; the first ones, which compile, are not counted."""
    workers: int = field(default_factory=lambda: min(2, os.cpu_count() or 1))
    """Processes that run episodes."""


@dataclass
class _Watch:
    """Times of a training's progress, passed on to the caller."""

    on_event: OnEvent
    seen: list[tuple[float, int]] = field(default_factory=list)

    def __call__(self, event: Event) -> None:
        self.on_event(event)
        if isinstance(event, StageProgress) and event.note.startswith("loss"):
            self.seen.append((time.monotonic(), event.done))

    @property
    def steps_per_s(self) -> float:
        """Rate between the first and the last report, which both follow the compilation."""
        (begin, first), (end, last) = self.seen[0], self.seen[-1]
        if last <= first:
            raise ConfigError("the training was too short to measure a rate; calibrate with more steps")
        return (last - first) / (end - begin)


def calibrate(
    config: CalibrationConfig, *, on_event: OnEvent = ignore, cancellation: Cancellation | None = None
) -> Rates:
    """Measure the rates of all stages in a temporary folder.

    Rollouts are those of a policy that can do nothing yet. They last until the limit of actions, so that the rate of
    rollouts is that of the slowest case.

    Args:
        config: What to measure.
        on_event: Receives the events of the stages.
        cancellation: Ends the measurement when it is set.

    Raises:
        CancelledError: When the measurement was cancelled.
        ConfigError: When the configuration is wrong, or the training too short.
        RoboximError: When a stage fails.
    """
    options: dict[str, Any] = {"on_event": on_event, "cancellation": cancellation}
    with tempfile.TemporaryDirectory(prefix="roboxim-calibration-") as name:
        folder = Path(name)
        common: dict[str, Any] = {"task": str(config.mix), "size": config.size, "workers": config.workers}
        demos, generate_s = _timed(
            lambda: generate(GenerationConfig(out=folder / "demos", episodes=config.episodes, **common), **options)
        )
        demos.require_any()
        kept = len(demos.kept)
        export, export_s = _timed(
            lambda: export_rlds(folder / "demos", folder / "rlds", ExportConfig(val_fraction=0.0), **options)
        )
        watch = _Watch(on_event)
        trained = train_bc(
            folder / "rlds", folder / "bc", BCConfig(steps=config.steps), on_event=watch, cancellation=cancellation
        )
        policy = PolicySpec(spec="bc", options={"checkpoint": str(folder / "bc")})
        rollouts = evaluate(
            EvaluationConfig(policies=policy, out=folder / "evaluation", episodes=config.rollouts, **common), **options
        )
        demonstration_s = sum(result.wall_s for result in demos.results) / kept / config.workers
        return Rates(
            machine=f"{platform.machine()}, {os.cpu_count()} cores",
            measured=datetime.now().isoformat(timespec="minutes"),
            source=f"{kept} demonstrations and {config.rollouts} rollouts of {config.mix.stem}, "
            f"{config.size[0]} x {config.size[1]} px, {config.steps} steps of bc",
            workers=config.workers,
            demonstration_s=demonstration_s,
            demonstration_bytes=_size(folder / "demos" / "episodes") / kept,
            dataset_bytes=_size(export.path) / kept,
            export_s=export_s / kept,
            steps_per_s=watch.steps_per_s,
            checkpoint_bytes=_size(trained.checkpoint.parent),
            rollout_s=sum(result.wall_s for result in rollouts.results) / config.rollouts / config.workers,
            rollout_bytes=_size(rollouts.first.folder / "episodes") / config.rollouts,
            start_s=max(1.0, generate_s - demonstration_s * kept),
        )


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = time.monotonic()
    return call(), time.monotonic() - started


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


# ------------------------------------------------------------------ storage


def rates_file() -> Path:
    """Return the file of this machine's rates, in the user's cache folder."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "roboxim" / "rates.json"


def stored_rates() -> Rates | None:
    """Return this machine's last rates; none: never measured, or measured by another version.

    Raises:
        ConfigError: When the file cannot be read.
    """
    path = rates_file()
    if not path.is_file():
        return None
    try:
        return from_json(read_text(path), Rates, source=str(path))
    except ConfigError:
        return None


def store_rates(rates: Rates) -> Path:
    """Store rates as this machine's; return the file."""
    path = rates_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft")
    draft.write_text(to_json(rates) + "\n")
    shutil.move(draft, path)
    return path
