"""This machine's rates, learned from a finished run of an experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import Any

from roboxim_core.episode import EpisodeResult
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_eval.experiments import Design, Rates, SideBySide
from roboxim_eval.experiments.cost import MIN_LEARNING_STEPS, MIN_START_S
from roboxim_runs.experiments.calibration.measuring import episode_s, rollout_times
from roboxim_runs.storage.folder import RunFolder

MIN_EPISODES, MIN_STEPS = 20, MIN_LEARNING_STEPS
"""Fewest demonstrations and rollouts, and fewest training steps, of a run whose rates are stored."""
NEARLY = 0.05
"""Largest part by which the mean number of trainings at a time may differ from the number whose rate it shows."""
PLAUSIBLE = 0.8
"""Least steps a second of trainings side by side, in all and relative to one alone, for their rate to be stored. If
they were slower, something else disturbed them: running them in parallel has no advantage."""
ALONE = "; trainings alone: "
"""What separates the source of a training's rate from that of the other rates."""


def rates_of_run(name: str, scale: str, out: Path, design: Design, workers: int, before: Rates) -> Rates | None:
    """Return the rates that a finished run of an experiment shows; none: it was too small, or a stage was interrupted.

    What a run does not show, e.g. the start of its trainings, is taken from earlier rates.

    Args:
        name: Name of the experiment.
        scale: Its scale, for messages.
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
    small = design.episodes < MIN_EPISODES or design.rollouts < MIN_EPISODES or design.steps < MIN_STEPS
    if small or not all(of.values()) or any(entry.get("continued") for entry in entries):
        return None
    demos = [result for stage in of["generate"] for result in RunFolder(out / stage).results()]
    rollouts = [
        result
        for stage in of["evaluate"]
        for result in RunFolder(out / stage / stage.removeprefix("evaluate/").rpartition(".")[0]).results()
    ]
    demonstration_s = episode_s(demos, workers)
    rollout_s = _mean_s(rollouts, workers)
    successes = [result for result in rollouts if result.outcome == "success"]
    failures = [result for result in rollouts if result.outcome != "success"]
    expected = rollout_times(demos, rollouts, workers)  # for the outcome that no rollout had
    evaluating_s = sum(wall[stage] for stage in of["evaluate"]) - before.first_evaluate_s
    if not demonstration_s > 0 or not rollout_s > 0:
        return None
    measured, run = datetime.now().isoformat(timespec="minutes"), f"run of {name} {scale}"
    trained = {rate.trainings: rate for rate in _training_rates(entries, design, before, run, measured)}
    alone = trained.pop(1, None)
    steps = f"{alone.source.removeprefix(f'{run}: ')}, " if alone else ""
    source = f"{run}: {len(demos)} demonstrations, {steps}{len(rollouts)} rollouts"
    proofs = sum(seconds for stage, seconds in wall.items() if stage.startswith(("prove/evaluation", "prove/curve")))
    starts = sum(stage.startswith(("prove/evaluation", "prove/curve")) for stage in wall)
    proof_s = (proofs - starts * before.proof_start_s) / len(rollouts)
    return replace(
        before,
        experiment=name,
        measured=measured,
        source=source if alone else f"{source}{ALONE}{before.source.rpartition(ALONE)[2]}",
        workers=workers,
        demonstration_s=demonstration_s,
        start_s=max(MIN_START_S, sum(wall[s] for s in of["generate"]) / len(of["generate"])
                    - demonstration_s * len(demos) / len(of["generate"])),
        steps_per_s=alone.steps_per_s if alone else before.steps_per_s,
        success_s=_mean_s(successes, workers) or expected[0],
        failure_s=_mean_s(failures, workers) or expected[1],
        succeeded=len(successes) / len(rollouts),
        evaluate_start_s=max(MIN_START_S, (evaluating_s - rollout_s * len(rollouts)) / len(of["evaluate"])),
        proof_s=proof_s if proof_s > 0 else before.proof_s,
    ).learned(*trained.values())  # fmt: skip


def _mean_s(results: Sequence[EpisodeResult], workers: int) -> float:
    """Return the mean wall time of an episode with all workers busy [s]; 0 without episodes."""
    return sum(result.wall_s for result in results) / len(results) / workers if results else 0.0


def _training_rates(
    entries: Sequence[Mapping[str, Any]], design: Design, before: Rates, run: str, measured: str
) -> Iterator[SideBySide]:
    """Yield the rate of each number of trainings at a time that a run shows with enough steps.

    A training shows it if that number ran during nearly all its time: the last training of an odd number of them shows
    the rate of one alone, and one that was alone for half its time shows none. The median of the trainings counts: of
    three or more, one that was disturbed changes little.

    Args:
        entries: The log of stages.
        design: The experiment.
        before: Earlier rates of this machine.
        run: Name of the run, for messages.
        measured: Date, ISO 8601.
    """
    trainings = {f"train/{training.condition}.{training.replicate}": training for training in design.trainings}
    shown: dict[int, list[tuple[float, int, int]]] = {}
    for entry in entries:
        at_once = float(entry.get("at_once", 1.0))
        number = round(at_once)
        training = trainings.get(entry["stage"])
        if training is not None and training.steps and abs(at_once - number) <= NEARLY * number:
            starts = 1 + len(training.checkpoints)
            shown.setdefault(number, []).append((float(entry["wall_s"]), training.steps, starts))
    alone = before.steps_per_s
    for number, ones in sorted(shown.items()):
        rate = before.at_once(number)
        start_s = rate.start_s if rate else before.train_start_s  # no better one is known
        steps = sum(steps for _, steps, _ in ones)
        took = [(wall_s - starts * start_s) / steps for wall_s, steps, starts in ones if wall_s > starts * start_s]
        if steps < MIN_STEPS or not took:
            continue
        steps_per_s = 1 / median(took)
        alone = steps_per_s if number == 1 else alone
        if number == 1 or number * steps_per_s >= PLAUSIBLE * alone:
            yield SideBySide(
                trainings=number, steps_per_s=steps_per_s, start_s=start_s, measured=measured,
                source=f"{run}: {steps:,} steps",
            )  # fmt: skip
