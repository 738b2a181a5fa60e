"""Measures this machine's rates for ``roboxim experiment plan``: by a small run of every stage, or from a real run.

Each measurement replaces the stored one; see `roboxim_bringup.runs.rates`.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from roboxim_bringup.executors import Cancellation, KeptProcesses, LocalExecutor
from roboxim_bringup.runs.delivery_demands import demands_of
from roboxim_bringup.runs.delivery_reader import DeliveryReader
from roboxim_bringup.runs.delivery_worker import BagJob
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_bringup.runs.evaluation_report import report_of
from roboxim_bringup.runs.evaluation_results import EvaluationResult
from roboxim_bringup.runs.events import Event, OnEvent, StageProgress, StageStarted, ignore
from roboxim_bringup.runs.experiment_stages import started
from roboxim_bringup.runs.export import ExportConfig, export_rlds
from roboxim_bringup.runs.folder import RunFolder
from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_bringup.runs.proving import Reading
from roboxim_bringup.runs.results_log import ResultsLog
from roboxim_bringup.runs.training import BCConfig, train_bc
from roboxim_core.config import parse_yaml
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_eval.experiments import Design, Rates

LEAST_START_S = 0.5
"""Least time of a start, where a measurement is too short to show one [s]."""
LEAST_EPISODES, LEAST_STEPS = 20, 1000
"""Fewest demonstrations and rollouts, and fewest training steps, of a run whose rates are stored."""


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
    kind: str = "calibration"
    """What it is, for messages: ``calibration`` or ``probe``."""

    @staticmethod
    def probe(mix: Path, size: tuple[int, int], workers: int | None = None) -> CalibrationConfig:
        """Return a measurement that takes about a minute on two free cores.

        Args:
            mix: Task mix, a YAML file.
            size: Image size [px].
            workers: Processes that run episodes; none: 2 or fewer.
        """
        more = {} if workers is None else {"workers": workers}
        return CalibrationConfig(mix=mix, size=size, episodes=6, rollouts=2, steps=40, kind="probe", **more)


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
    with tempfile.TemporaryDirectory(prefix="roboxim-calibration-") as name, KeptProcesses() as processes:
        folder = Path(name)
        common: dict[str, Any] = {"task": str(config.mix), "size": config.size, "workers": config.workers}

        def episodes(run: str) -> LocalExecutor:
            return LocalExecutor(config.workers, log_dir=folder / f"{run}-logs", kept=processes)

        demos, generate_s = _timed(
            lambda: generate(
                GenerationConfig(out=folder / "demos", episodes=config.episodes, **common),
                executor=episodes("demos"), **options,
            )
        )  # fmt: skip
        demos.require_any()
        kept = len(demos.kept)
        export, export_s = _timed(
            lambda: export_rlds(
                folder / "demos", folder / "rlds", ExportConfig(val_fraction=0.0, uneven=True), **options
            )
        )
        watch = _Watch(on_event)
        trained = train_bc(
            folder / "rlds", folder / "bc", BCConfig(steps=config.steps), on_event=watch, cancellation=cancellation
        )
        policy = PolicySpec(spec="bc", options={"checkpoint": str(folder / "bc")})

        def evaluation(run: str, number: int) -> EvaluationResult:
            wanted = EvaluationConfig(policies=policy, out=folder / run, episodes=number, page=False, **common)
            return evaluate(wanted, executor=episodes(run), **options)

        first, first_s = _timed(lambda: evaluation("first", config.workers))  # loads the policy's libraries
        rollouts, evaluate_s = _timed(lambda: evaluation("evaluation", config.rollouts))
        _, page_s = _timed(lambda: report_of(folder / "evaluation"))
        bags = [str(folder / "demos" / result.bag) for result in demos.kept]
        proof_s, proof_start_s = _proof_times(bags, config, folder / "logs", options)
        demonstration_s = _episode_s(demos.results, config.workers) * len(demos.results) / kept
        rollout_s = sum(result.wall_s for result in rollouts.results) / config.rollouts / config.workers
        evaluate_start_s = max(LEAST_START_S, evaluate_s - rollout_s * config.rollouts)
        return Rates(
            machine=f"{platform.machine()}, {os.cpu_count()} cores",
            measured=datetime.now().isoformat(timespec="minutes"),
            source=f"{config.kind} of {kept} demonstrations and {config.rollouts} rollouts of {config.mix.stem}, "
            f"{config.size[0]} x {config.size[1]} px, {config.steps} steps of bc",
            size=f"{config.size[0]}x{config.size[1]}",
            workers=config.workers,
            demonstration_s=demonstration_s,
            demonstration_bytes=_size(folder / "demos" / "episodes") / kept,
            dataset_bytes=_size(export.path) / kept,
            export_s=export_s / kept,
            steps_per_s=watch.steps_per_s,
            checkpoint_bytes=_size(trained.checkpoint.parent),
            rollout_s=rollout_s,
            rollout_bytes=_size(rollouts.first.folder / "episodes") / config.rollouts,
            proof_s=proof_s,
            start_s=max(LEAST_START_S, generate_s - demonstration_s * kept),
            train_start_s=_training_start_s(folder, config.steps) + watch.compilation_s,
            first_evaluate_s=max(
                LEAST_START_S, first_s - evaluate_start_s - _rollouts_s(first.results, config.workers)
            ),
            evaluate_start_s=evaluate_start_s,
            proof_start_s=proof_start_s,
            film_s=page_s / config.rollouts,
        )


def _episode_s(results: Sequence[EpisodeResult], workers: int) -> float:
    """Return the wall time of an episode with all workers busy [s].

    The first episode of each worker is not counted, since it loads the models; its excess is part of the start.
    """
    warm = results[workers:] or results
    return sum(result.wall_s for result in warm) / len(warm) / workers


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
    mix = config.mix.read_text()
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
    return proof_s, max(LEAST_START_S, all_s - proof_s * len(jobs))


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = time.monotonic()
    return call(), time.monotonic() - started


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def rates_of_run(name: str, out: Path, design: Design, workers: int, before: Rates) -> Rates | None:
    """Return the rates that a finished run of an experiment shows; none: it was too small, or a stage was interrupted.

    What a run does not show, e.g. the start of its trainings, is taken from earlier rates.

    Args:
        name: Name and scale of the experiment, for messages.
        out: Its folder.
        design: The experiment.
        workers: Processes that ran episodes.
        before: Earlier rates of this machine.

    Raises:
        ConfigError: When a file of the folder is damaged.
    """
    entries = [entry.data for entry in ResultsLog(out / "stages.jsonl").read()]
    wall = {entry["stage"]: float(entry["wall_s"]) for entry in entries}
    of = {kind: [stage for stage in wall if stage.startswith(f"{kind}/")] for kind in ("generate", "train", "evaluate")}
    small = design.episodes < LEAST_EPISODES or design.rollouts < LEAST_EPISODES or design.steps < LEAST_STEPS
    if small or not all(of.values()) or any(entry.get("continued") for entry in entries):
        return None
    demos = [result for stage in of["generate"] for result in RunFolder(out / stage).results()]
    rollouts = [
        result
        for stage in of["evaluate"]
        for result in RunFolder(out / stage / stage.removeprefix("evaluate/").rpartition(".")[0]).results()
    ]
    demonstration_s = _episode_s(demos, workers)
    rollout_s = sum(result.wall_s for result in rollouts) / len(rollouts) / workers
    training_s = sum(wall[stage] for stage in of["train"]) - design.training_starts * before.train_start_s
    evaluating_s = sum(wall[stage] for stage in of["evaluate"]) - before.first_evaluate_s
    if not demonstration_s > 0 or not rollout_s > 0 or not training_s > 0:
        return None
    proofs = sum(seconds for stage, seconds in wall.items() if stage.startswith("prove/evaluation"))
    proof_s = (proofs - design.config.replicates.count * before.proof_start_s) / len(rollouts)
    return replace(
        before,
        measured=datetime.now().isoformat(timespec="minutes"),
        source=f"run of {name}: {len(demos)} demonstrations, {design.steps:,} steps, {len(rollouts)} rollouts",
        workers=workers,
        demonstration_s=demonstration_s,
        start_s=max(LEAST_START_S, sum(wall[s] for s in of["generate"]) / len(of["generate"])
                    - demonstration_s * len(demos) / len(of["generate"])),
        steps_per_s=design.steps / training_s,
        rollout_s=rollout_s,
        evaluate_start_s=max(LEAST_START_S, (evaluating_s - rollout_s * len(rollouts)) / len(of["evaluate"])),
        proof_s=proof_s if proof_s > 0 else before.proof_s,
    )  # fmt: skip
