"""Measures this machine's rates for ``roboxim experiment plan`` by a small run of every stage.

Each measurement replaces the stored one, see the module `rates`; so do the rates that a real run teaches, see
`learned`.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from roboxim_bringup.process import keep_freed_memory
from roboxim_core.config import parse_yaml
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.documents import read_text
from roboxim_eval.experiments import Rates, SideBySide
from roboxim_eval.experiments.cost import MIN_START_S
from roboxim_runs.datasets.export import ExportConfig, ExportReport, export_dataset
from roboxim_runs.episodes.generation import GenerationConfig, GenerationResult, generate
from roboxim_runs.evaluation.report import report_of
from roboxim_runs.evaluation.results import EvaluationResult
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import Event, OnEvent, StageProgress, StageStarted, ignore
from roboxim_runs.executors import Cancellation, KeptProcesses, LocalExecutor
from roboxim_runs.experiments.calibration.trainings import measure_side_by_side
from roboxim_runs.experiments.delivery.demands import demands_of
from roboxim_runs.experiments.delivery.proving import Reading
from roboxim_runs.experiments.delivery.reader import DeliveryReader
from roboxim_runs.experiments.delivery.worker import BagJob
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.training.commands import started
from roboxim_runs.training.run import BCConfig, train_policy


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
    trainings: int = 1
    """Trainings at a time, to be measured besides a training alone; 1: no more than one."""
    kind: str = "calibration"
    """What it is, for messages: ``calibration`` or ``probe``."""

    @staticmethod
    def probe(mix: Path, size: tuple[int, int], workers: int | None = None, *, trainings: int = 1) -> CalibrationConfig:
        """Return a measurement that takes about a minute on two free cores.

        Args:
            mix: Task mix, a YAML file.
            size: Image size [px].
            workers: Processes that run episodes; none: 2 or fewer.
            trainings: Trainings at a time, to be measured besides a training alone.
        """
        more = {} if workers is None else {"workers": workers}
        return CalibrationConfig(
            mix=mix, size=size, episodes=6, rollouts=2, steps=40, trainings=trainings, kind="probe", **more
        )

    @property
    def episode_options(self) -> dict[str, Any]:
        """Options that generation and evaluation share."""
        return {"task": str(self.mix), "size": self.size, "workers": self.workers}


@dataclass
class _Watch:
    """Times of a training's progress, passed on to the caller."""

    on_event: OnEvent
    seen: list[tuple[float, int]] = field(default_factory=list)

    began: float = 0.0
    """Time when the training itself began, after the reading [s]."""

    def __call__(self, event: Event) -> None:
        self.on_event(event)
        if isinstance(event, StageStarted):
            self.began = time.monotonic()
        if isinstance(event, StageProgress) and event.note.startswith("loss"):
            self.seen.append((time.monotonic(), event.done))

    @property
    def steps_per_s(self) -> float:
        """Rate between the first and the last report, which both follow the compilation."""
        (begin, first), (end, last) = self.seen[0], self.seen[-1]
        if last <= first:
            raise ConfigError("the training was too short to measure a rate; calibrate with more steps")
        return (last - first) / (end - begin)

    @property
    def compilation_s(self) -> float:
        """Time before the first steps [s]."""
        end, steps = self.seen[0]
        return max(0.0, end - self.began - steps / self.steps_per_s)


def calibrate(
    config: CalibrationConfig, *, on_event: OnEvent = ignore, cancellation: Cancellation | None = None
) -> Rates:
    """Measure the rates of all stages in a temporary folder.

    The rollouts use a policy that cannot solve anything yet. They last until the limit of actions, as failures do.
    Successes are taken to be as much shorter as the demonstrations have fewer actions.

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
    load = _load_before()
    with tempfile.TemporaryDirectory(prefix="roboxim-calibration-") as name, KeptProcesses() as processes:
        folder = Path(name)

        def episodes(run: str) -> LocalExecutor:
            return LocalExecutor(config.workers, log_dir=folder / f"{run}-logs", kept=processes)

        demos, generate_s = _timed(lambda: _demonstrations(config, folder, episodes("demos"), options))
        kept = len(demos.kept)
        export, export_s = _timed(lambda: _export(folder, options))
        watch = _Watch(on_event)
        keep_freed_memory()  # as the command of a training does
        trained = train_policy(
            folder / "rlds", folder / "bc", BCConfig(steps=config.steps), on_event=watch, cancellation=cancellation
        )
        policy = PolicySpec(spec="bc", options={"checkpoint": str(folder / "bc")})

        def evaluation(run: str, number: int) -> EvaluationResult:
            wanted = EvaluationConfig(
                policies=policy, out=folder / run, episodes=number, page=False, **config.episode_options
            )
            return evaluate(wanted, executor=episodes(run), **options)

        first, first_s = _timed(lambda: evaluation("first", config.workers))  # loads the policy's libraries
        rollouts, evaluate_s = _timed(lambda: evaluation("evaluation", config.rollouts))
        _, page_s = _timed(lambda: report_of(folder / "evaluation"))
        bags = [str(folder / "demos" / result.bag) for result in demos.kept]
        proof_s, proof_start_s = _proof_times(bags, config, folder / "logs", options)
        demonstration_s = episode_s(demos.results, config.workers) * len(demos.results) / kept
        rollout_s = _rollouts_s(rollouts.results, config.workers) / config.rollouts
        success_s, failure_s = rollout_times(demos.kept, rollouts.results, config.workers)
        evaluate_start_s = max(MIN_START_S, evaluate_s - rollout_s * config.rollouts)
        return Rates(
            experiment=config.mix.stem,
            machine=f"{platform.machine()}, {os.cpu_count()} cores",
            measured=datetime.now().isoformat(timespec="minutes"),
            source=f"{config.kind} of {kept} demonstrations and {config.rollouts} rollouts of {config.mix.stem}, "
            f"{config.size[0]} x {config.size[1]} px, {config.steps} steps of bc, {load}",
            size=f"{config.size[0]}x{config.size[1]}",
            workers=config.workers,
            demonstration_s=demonstration_s,
            demonstration_bytes=_size(folder / "demos" / "episodes") / kept,
            dataset_bytes=_size(export.path) / kept,
            export_s=export_s / kept,
            steps_per_s=watch.steps_per_s,
            checkpoint_bytes=_size(trained.checkpoint.parent),
            success_s=success_s,
            failure_s=failure_s,
            rollout_bytes=_size(rollouts.first.folder / "episodes") / config.rollouts,
            proof_s=proof_s,
            start_s=max(MIN_START_S, generate_s - demonstration_s * kept),
            train_start_s=_training_start_s(folder, config.steps) + watch.compilation_s,
            first_evaluate_s=max(MIN_START_S, first_s - evaluate_start_s - _rollouts_s(first.results, config.workers)),
            evaluate_start_s=evaluate_start_s,
            proof_start_s=proof_start_s,
            film_s=page_s / config.rollouts,
            side_by_side=(_side_by_side(config, folder, load, options),) if config.trainings > 1 else (),
        )


def calibrate_trainings(
    config: CalibrationConfig, *, on_event: OnEvent = ignore, cancellation: Cancellation | None = None
) -> SideBySide:
    """Measure the rate of trainings side by side alone, in a temporary folder.

    Args:
        config: What to measure.
        on_event: Receives the events of the stages.
        cancellation: Ends the measurement when it is set.

    Raises:
        CancelledError: When the measurement was cancelled.
        ConfigError: When the configuration is wrong.
        RoboximError: When a stage fails.
    """
    options: dict[str, Any] = {"on_event": on_event, "cancellation": cancellation}
    load = _load_before()
    with tempfile.TemporaryDirectory(prefix="roboxim-calibration-") as name:
        folder = Path(name)
        _demonstrations(config, folder, LocalExecutor(config.workers, log_dir=folder / "demos-logs"), options)
        _export(folder, options)
        return _side_by_side(config, folder, load, options)


def _demonstrations(
    config: CalibrationConfig, folder: Path, executor: LocalExecutor, options: Mapping[str, Any]
) -> GenerationResult:
    """Generate the demonstrations of a measurement.

    Raises:
        RoboximError: When all of them fail.
    """
    wanted = GenerationConfig(out=folder / "demos", episodes=config.episodes, **config.episode_options)
    demos = generate(wanted, executor=executor, **options)
    demos.require_any()
    return demos


def _export(folder: Path, options: Mapping[str, Any]) -> ExportReport:
    selection = ExportConfig(val_fraction=0.0, uneven=True)
    return export_dataset("rlds", folder / "demos", folder / "rlds", selection, **options)


def _side_by_side(config: CalibrationConfig, folder: Path, load: str, options: Mapping[str, Any]) -> SideBySide:
    size = f"{config.size[0]} x {config.size[1]} px"
    return measure_side_by_side(
        folder / "rlds", folder, config.trainings, config.steps, **options,
        source=f"{config.kind} of {config.steps} steps of bc, {size}, {load}",
    )  # fmt: skip


def _load_before() -> str:
    """Return how busy the machine is with other jobs, which explains low rates."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores when it began"


def episode_s(results: Sequence[EpisodeResult], workers: int) -> float:
    """Return the wall time of an episode with all workers busy [s].

    The first episode of each worker is not counted, since it loads the models; its excess is part of the start.

    Args:
        results: Results in the order of the episodes.
        workers: Number of workers.
    """
    warm = results[workers:] or results
    return sum(result.wall_s for result in warm) / len(warm) / workers


def rollout_times(
    demonstrations: Sequence[EpisodeResult], rollouts: Sequence[EpisodeResult], workers: int
) -> tuple[float, float]:
    """Return the wall times of a successful and of a failed rollout with all workers busy [s].

    Args:
        demonstrations: Results of demonstrations of the same tasks; a success has as many actions as they have.
        rollouts: Results of rollouts of which at least one failed at the limit of actions; a failure has its actions.
        workers: Number of workers.
    """
    step_s = _rollouts_s(rollouts, workers) / max(1, sum(result.steps for result in rollouts))
    limit = max(result.steps for result in rollouts)
    mean = sum(result.steps for result in demonstrations) / len(demonstrations)
    return step_s * max(1.0, min(mean, limit)), step_s * max(1, limit)


def _rollouts_s(results: Sequence[EpisodeResult], workers: int) -> float:
    return sum(result.wall_s for result in results) / workers


def _training_start_s(folder: Path, steps: int) -> float:
    """Return the wall time of a training's command on a finished training: it starts, reads, and has no step to do.

    Raises:
        RoboximError: When the command fails.
    """
    words = ["roboxim", "train", "bc", str(folder / "rlds"), "--out", str(folder / "bc"), "--steps", str(steps)]
    with open(folder / "training.log", "w+") as log:
        code, seconds = _timed(lambda: started(words, log).wait())
        if code:
            log.seek(0)
            raise RoboximError(f"{shlex.join(words)} ended with code {code}:\n{log.read().strip()[-2000:]}")
    return seconds


def _proof_times(
    bags: list[str], config: CalibrationConfig, logs: Path, options: Mapping[str, Any]
) -> tuple[float, float]:
    """Return the wall time of the proof of a bag with all workers busy, and of the start of a proof [s]."""
    mix = read_text(config.mix)
    demands = demands_of(mix_json := json.dumps(parse_yaml(mix)))
    reader = DeliveryReader(ModelLibrary())
    try:
        reader.read(Path(bags[0]), demands.get)  # makes the renderer
        _, one_s = _timed(lambda: [reader.read(Path(bag), demands.get) for bag in bags])
    finally:
        reader.close()
    reading = Reading(workers=config.workers, logs=logs, **options)
    jobs = [BagJob(bag=bag, mix="all") for bag in bags]
    _, all_s = _timed(lambda: list(reading.read("proving", jobs, {"all": mix_json})))
    proof_s = one_s / len(bags) / config.workers
    return proof_s, max(MIN_START_S, all_s - proof_s * len(jobs))


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = time.monotonic()
    return call(), time.monotonic() - started


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
