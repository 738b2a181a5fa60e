"""Measures trainings that run side by side, for ``roboxim experiment plan --trainings N``."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from roboxim_bringup.process import describe_exit
from roboxim_core.errors import RoboximError
from roboxim_eval.experiments import SideBySide
from roboxim_eval.experiments.cost import MIN_START_S
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.training.commands import TrainerReports, started

ENDLESS = 10_000_000
"""Steps of a training that is killed when it has been measured."""
REPORTS_S = 0.2
"""Period at which the reports of measured trainings are read [s]."""


def measure_side_by_side(
    dataset: Path,
    folder: Path,
    trainings: int,
    steps: int,
    *,
    source: str,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> SideBySide:
    """Run trainings of bc at the same time until each has made a number of steps in parallel with the others.

    Args:
        dataset: What they train with.
        folder: Folder for their checkpoints and logs.
        trainings: Number of trainings.
        steps: Number of steps.
        source: What the measurement is, for messages.
        on_event: Receives the progress.
        cancellation: Ends the measurement when it is set.

    Raises:
        CancelledError: When the measurement was cancelled.
        RoboximError: When a training fails.
    """
    runs: list[_MeasuredTraining] = []
    with Reporter(on_event, cancellation).stage(f"{trainings} trainings at a time", steps, "steps") as progress:
        try:
            for number in range(trainings):
                runs.append(_MeasuredTraining(dataset, folder / f"bc-{number}", number))
            done = 0
            while done < steps:
                time.sleep(REPORTS_S)
                for run in runs:
                    run.read()
                done = common_steps([run.seen for run in runs])
                progress(min(done, steps))
        finally:
            for run in runs:
                run.kill()
    rate = common_rate([run.seen for run in runs])
    start_s = sum(run.seen[0][0] - run.began - run.seen[0][1] / rate for run in runs) / len(runs)
    return SideBySide(
        trainings=trainings, steps_per_s=rate, start_s=max(MIN_START_S, start_s),
        measured=datetime.now().isoformat(timespec="minutes"), source=source,
    )  # fmt: skip


class _MeasuredTraining:
    """A training of bc that runs until it is killed, and the times at which it reported its steps."""

    def __init__(self, dataset: Path, out: Path, seed: int) -> None:
        self.seen: list[tuple[float, int]] = []
        """Times, seconds since 1970, and steps done."""
        self._reports = TrainerReports(out.with_suffix(".events.jsonl"))
        self._log = out.with_suffix(".log")
        self._words = [
            "roboxim", "train", "bc", str(dataset), "--out", str(out), "--steps", str(ENDLESS), "--seed", str(seed),
        ]  # fmt: skip
        self.began = time.time()
        with open(self._log, "w") as log:
            self._process = started(self._words, log, self._reports.path)

    def read(self) -> None:
        """Read what it has reported.

        Raises:
            RoboximError: When it has ended.
        """
        code = self._process.poll()
        found = [report for report in self._reports.new() if report.done]
        self.seen += [(datetime.fromisoformat(report.time).timestamp(), report.done) for report in found]
        if code is not None:
            raise RoboximError(
                f"{shlex.join(self._words)} ended with {describe_exit(code)}:\n{self._log.read_text().strip()[-2000:]}"
            )

    def kill(self) -> None:
        """End it, without a checkpoint."""
        self._process.kill()
        self._process.wait()


def _common_time(seen: Sequence[Sequence[tuple[float, int]]]) -> tuple[float, float]:
    """Return the time from which all trainings made steps, and until which all did [s since 1970]."""
    return max(one[0][0] for one in seen), min(one[-1][0] for one in seen)


def common_steps(seen: Sequence[Sequence[tuple[float, int]]]) -> int:
    """Return the least number of steps that a training made while all made steps."""
    if not all(seen):
        return 0
    begin, end = _common_time(seen)
    steps = [[step for at, step in one if begin <= at <= end] or [0] for one in seen]
    return min(one[-1] - one[0] for one in steps)


def common_rate(seen: Sequence[Sequence[tuple[float, int]]]) -> float:
    """Return the mean rate of trainings in the time in which all of them made steps [1/s].

    Args:
        seen: Of each training the times [s] and the steps done; each has two at least in the time of all.
    """
    begin, end = _common_time(seen)
    rates = []
    for one in seen:
        (first_s, first), *_, (last_s, last) = [(at, step) for at, step in one if begin <= at <= end]
        rates.append((last - first) / (last_s - first_s))
    return sum(rates) / len(rates)
