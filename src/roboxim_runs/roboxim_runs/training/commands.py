"""Trainings of an experiment: commands in separate processes, several in parallel.

`train` runs them on this machine: the caller's thread starts, watches and ends all of them. The kernel ends them with
that thread, so that none outlives a killed run. `train_on` hands them to an executor, whose workers run `train`
(`roboxim_runs.training.worker`).
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from roboxim_bringup.process import describe_exit, spawn
from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments import Stage
from roboxim_runs.events import Event, OnEvent, Reporter, StageFinished, StageProgress, StageStarted
from roboxim_runs.executors import Cancellation, Executor, Job, Note, Work, run_required
from roboxim_runs.storage.event_log import VARIABLE

POLL_S = 0.05
"""Period at which trainings are polled [s]."""
REPORT_S = 1.0
"""Period at which the progress of trainings is read [s]."""
END_S = 60.0
"""Longest time for interrupted trainings to save their checkpoints [s]."""
LOG_LINES, LOG_BYTES = 15, 4000
"""Lines of a failed training's log in the message, and the most bytes that are read for them."""
NOTE_LENGTH = 100
"""Longest line of a log that is shown as progress."""
REPORTED = {event.__name__: event for event in (StageStarted, StageProgress, StageFinished)}
"""Events that a worker passes on, by name."""


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A training that has ended well."""

    stage: Stage
    """Its stage."""
    wall_s: float
    """Wall time of this call [s]."""
    at_once: float
    """Mean number of trainings that ran during it, itself included."""
    continued: bool
    """Whether an earlier call had begun it."""
    origin: Mapping[str, Any] | None = None
    """What it ran with on another machine, an `Origin` as plain data; none: it ran here."""


def train(
    stages: Sequence[Stage],
    out: Path,
    *,
    at_once: int,
    on_event: OnEvent,
    on_trained: Callable[[Trained], None],
    cancellation: Cancellation | None = None,
    end_s: float = END_S,
) -> None:
    """Run trainings, at most a number of them side by side; the next one starts when one ends.

    When one fails, or the run is interrupted, all others are interrupted. Each may save a checkpoint first.

    Args:
        stages: The trainings, in the order of their starts.
        out: Folder of the experiment.
        at_once: Largest number of trainings at a time.
        on_event: Receives progress, with the name of the training's stage.
        on_trained: Receives each training when it has ended well.
        cancellation: Ends the run when it is set.
        end_s: Longest time for interrupted trainings to save their checkpoints [s].

    Raises:
        CancelledError: When the run was cancelled; the same call continues.
        ConfigError: When a command cannot be started.
        RoboximError: When a training fails; the message has the end of its log.
    """
    waiting, running = list(stages), list[_Training]()

    def unfinished() -> str:
        return f"interrupted: {', '.join(map(str, running)) or 'no training'}; the same call or command continues"

    reporter = Reporter(on_event, cancellation)
    with reporter.resumable(unfinished):
        try:
            _run(waiting, running, out, at_once, reporter, on_trained)
        finally:
            _end([training.process for training in running], end_s)


def train_on(
    executor: Executor,
    stages: Sequence[Stage],
    out: Path,
    *,
    on_event: OnEvent,
    on_trained: Callable[[Trained], None],
    cancellation: Cancellation | None = None,
) -> None:
    """Run trainings as jobs of an executor, whose machines share the experiment's folder.

    When one fails, or the run is interrupted, all others are interrupted and have some seconds to save a checkpoint. If
    a training's worker is lost, another worker continues it from its last checkpoint.

    Args:
        executor: Runs them; its number of workers is the number of trainings at a time.
        stages: The trainings, in the order of their starts.
        out: Folder of the experiment.
        on_event: Receives progress, with the name of the training's stage.
        on_trained: Receives each training when it has ended well.
        cancellation: Ends the run when it is set.

    Raises:
        CancelledError: When the run was cancelled; the same call continues.
        ConfigError: When a command cannot be started, or a machine does not see the folder.
        RoboximError: When a training fails; the message has the end of its log.
        UnavailableError: When three workers were lost at a training.
    """
    by_name, running, reporter = {stage.name: stage for stage in stages}, _Shared(), Reporter(on_event)

    def on_note(note: Note) -> None:
        if note.text:
            running.end(note.key)
            reporter.notice(note.text)
            return
        running.begin(note.key)
        if event := event_of(note.data):
            on_event(event)

    work = Work(worker="roboxim_runs.training.worker:TrainingWorker", settings={"out": str(out.absolute())})
    jobs = [Job(key=stage.name, data=to_plain(stage)) for stage in stages]

    def unfinished() -> str:
        return f"interrupted: {running or 'no training'}; the same call or command continues"

    outcomes = run_required(
        work, jobs, lost="{}, which the same command continues", executor=executor, on_note=on_note,
        cancellation=cancellation,
    )  # fmt: skip
    with reporter.resumable(unfinished), contextlib.closing(outcomes):  # ends the trainings when one has failed
        for outcome in outcomes:
            at_once = running.end(outcome.key)
            on_trained(Trained(stage=by_name[outcome.key], at_once=at_once, **outcome.value))


def event_of(data: Any) -> Event | None:
    """Return the event that a worker has reported; none: it has only reported that it lives."""
    return REPORTED[data["event"]](**data["fields"]) if data else None


class _Shared:
    """The trainings that run at a time, and how many ran beside each."""

    def __init__(self) -> None:
        self._running: dict[str, list[float]] = {}
        self._counted = time.monotonic()

    def __bool__(self) -> bool:
        return bool(self._running)

    def __str__(self) -> str:
        return ", ".join(f"training {name.removeprefix('train/')}" for name in self._running)

    def begin(self, name: str) -> None:
        """Count a training from now on."""
        self._count()
        self._running.setdefault(name, [0.0, 0.0])

    def end(self, name: str) -> float:
        """Forget a training; return the mean number of trainings that ran during it, itself included."""
        self._count()
        alone_s, shared_s = self._running.pop(name, (0.0, 0.0))
        return max(1.0, shared_s / alone_s) if alone_s else 1.0

    def _count(self) -> None:
        now = time.monotonic()
        for spent in self._running.values():
            spent[0] += now - self._counted
            spent[1] += (now - self._counted) * len(self._running)
        self._counted = now


def _run(
    waiting: list[Stage],
    running: list[_Training],
    out: Path,
    at_once: int,
    reporter: Reporter,
    on_trained: Callable[[Trained], None],
) -> None:
    """Run trainings; `running` has those that have not ended, also when this raises."""
    reported_s, shared = time.monotonic(), _Shared()
    while waiting or running:
        while waiting and len(running) < at_once:
            running.append(_Training(waiting.pop(0), out, reporter.on_event))
            shared.begin(running[-1].stage.name)
        reporter.require_wanted()
        with contextlib.suppress(subprocess.TimeoutExpired):
            running[0].process.wait(POLL_S)
        ended = [training for training in running if training.process.poll() is not None]
        failed = [training for training in ended if training.process.returncode]
        for training in ended:
            if training not in failed and training.go_on():
                running.remove(training)
                on_trained(training.trained(shared.end(training.stage.name)))
        if failed:
            _fail(failed[0], [training for training in running if training not in failed])
        if time.monotonic() - reported_s >= REPORT_S:
            reported_s = time.monotonic()
            for training in running:
                training.report_progress()


def _fail(failed: _Training, others: Sequence[_Training]) -> None:
    """Raise the error of a training that failed.

    Raises:
        RoboximError: Always.
    """
    others_text = f"\nalso interrupted: {', '.join(map(str, others))}" if others else ""
    raise RoboximError(
        f"{failed.stage.name}: {shlex.join(failed.words)} ended with {describe_exit(failed.process.returncode)}; the "
        f"same command continues; the end of {failed.log}:\n{last_lines(failed.log)}{others_text}"
    )


class _Training:
    """A running training: its commands one after the other, one for each checkpoint of a learning curve."""

    def __init__(self, stage: Stage, out: Path, on_event: OnEvent) -> None:
        """Start the first command.

        Raises:
            ConfigError: When there is no such program.
        """
        self.stage, self._on_event = stage, on_event
        self._folder = out / stage.name
        self._folder.parent.mkdir(exist_ok=True)
        self.log = self._folder.with_name(f"{self._folder.name}.log")
        self._reports = TrainerReports(self._folder.with_name(f".{self._folder.name}.events.jsonl"))
        self._continued, self._began = self._folder.exists(), time.monotonic()
        self._done, self._total, self._note = 0, stage.inputs["steps"] or 1, ""
        self._commands = _commands_of(stage, out)
        unit = "steps" if stage.inputs["steps"] else ""
        on_event(StageStarted(title=str(self), total=self._total, unit=unit, name=stage.name))
        self._start()

    def __str__(self) -> str:
        """Return its name for messages, with what is known of its progress."""
        steps = f" after {self._done} of {self._total} steps" if self._done else ""
        return f"training {self.stage.name.removeprefix('train/')}{steps}"

    def _start(self) -> None:
        self.words, self._kept = next(self._commands)
        self._reports.clear()
        with open(self.log, "a") as log:
            self.process = started(self.words, log, self._reports.path)

    def go_on(self) -> bool:
        """Keep the checkpoint of a command that has ended well, and start the next one; return whether it was the last.

        Raises:
            ConfigError: When there is no such program.
        """
        if self._kept is not None:
            draft = self._kept.with_name(f".{self._kept.name}.draft")
            shutil.rmtree(draft, ignore_errors=True)
            shutil.copytree(self._folder, draft)
            draft.rename(self._kept)
            self._start()
            return False
        self._reports.clear()
        self._on_event(StageProgress(done=self._total, total=self._total, note=self._note, name=self.stage.name))
        self._on_event(StageFinished(name=self.stage.name))
        return True

    def report_progress(self) -> None:
        """Report the progress that the trainer has reported; without any, the last line of its log."""
        before = (self._done, self._total, self._note)
        if report := self._reports.last():
            self._done, self._total, self._note = report.done, report.total or self._total, report.note
        elif not self._reports.any:
            self._note = last_lines(self.log, 1)[:NOTE_LENGTH]
        if (self._done, self._total, self._note) != before:
            self._on_event(StageProgress(done=self._done, total=self._total, note=self._note, name=self.stage.name))

    def trained(self, at_once: float) -> Trained:
        """Return facts about the training, which has just ended.

        Args:
            at_once: Mean number of trainings that ran during it.
        """
        wall_s = time.monotonic() - self._began
        return Trained(stage=self.stage, wall_s=wall_s, at_once=at_once, continued=self._continued)


def _commands_of(stage: Stage, out: Path) -> Iterator[tuple[list[str], Path | None]]:
    """Yield the commands of a training as words, and the folder that keeps the checkpoint; the last one keeps none."""
    folder, inputs = out / stage.name, stage.inputs
    known = {"dataset": out / stage.needs[0], "out": folder, "seed": inputs["seed"], "steps": inputs["steps"]}
    for step in inputs["checkpoints"]:
        kept = folder.with_name(f"{folder.name}@{step}")
        if not kept.exists():
            words = shlex.split(f"{inputs['command']} {inputs['until']}")
            yield [word.format(**known, until=step) for word in words], kept
    yield [word.format(**known) for word in shlex.split(inputs["command"])], None


@dataclass(frozen=True, kw_only=True)
class Report:
    """Progress that a trainer has reported."""

    time: str
    """When, ISO 8601; empty: not reported."""
    done: int
    """Steps done; 0 before the training itself."""
    total: int
    """Steps in all; 0: not reported."""
    note: str
    """A short note."""


class TrainerReports:
    """The file of events that a trainer may write; ``$ROBOXIM_EVENTS`` names it. ``roboxim train`` writes it."""

    def __init__(self, path: Path) -> None:
        """Store the file's path; the file need not exist."""
        self.path = path
        self._read, self._title = 0, ""
        self.any = False
        """Whether the trainer has written anything."""

    def clear(self) -> None:
        """Remove the file, before another command or after the last one."""
        self.path.unlink(missing_ok=True)
        self._read, self._title = 0, ""

    def last(self) -> Report | None:
        """Return the newest report since the last call; none: nothing new."""
        reports = self.new()
        return reports[-1] if reports else None

    def new(self) -> list[Report]:
        """Return the reports since the last call. Lines that are none are skipped."""
        try:
            with open(self.path, "rb") as file:
                file.seek(self._read)
                whole, end, _ = file.read().rpartition(b"\n")
        except OSError:
            return []
        self._read += len(whole) + len(end)
        reports = [report for line in whole.splitlines() if (report := self._report(line))]
        self.any = self.any or bool(reports)
        return reports

    def _report(self, line: bytes) -> Report | None:
        try:
            event = json.loads(line)
            kind, done, total = event["event"], int(event.get("done", 0)), int(event.get("total", 0))
            at, note = str(event.get("time", "")), str(event.get("note", ""))
        except (ValueError, TypeError, KeyError, AttributeError):
            return None
        if kind == "stage_started":
            self._title = "" if event.get("unit") == "steps" else str(event.get("title", ""))
        if kind not in ("stage_started", "stage_progress"):
            return None
        if self._title:  # e.g. reading demonstrations
            return Report(time=at, done=0, total=0, note=self._title)
        return Report(time=at, done=done, total=total, note=note)


def started(words: Sequence[str], log: IO[Any], reports: Path | None = None) -> subprocess.Popen[bytes]:
    """Start a training command that dies with this process; ``roboxim`` is the one of this environment.

    It has as many threads as it has when a person starts it.

    Args:
        words: The command.
        log: Destination of its output.
        reports: File of events for it to write; none: as for this process.

    Raises:
        ConfigError: When there is no such program.
    """
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)))
    if shutil.which(words[0], path=path) is None:
        raise ConfigError(f"the training command cannot be started: {shlex.join(words)} (no such program)")
    environment = {"PATH": path} | ({} if reports is None else {VARIABLE: str(reports.absolute())})
    return spawn("roboxim_runs.training.run_command", words, output=log, environment=environment, one_thread=False)


def _end(processes: Sequence[subprocess.Popen[bytes]], end_s: float) -> None:
    """End trainings: each may save a checkpoint first."""
    alive = [process for process in processes if process.poll() is None]
    for process in alive:
        os.killpg(process.pid, signal.SIGINT)
    deadline = time.monotonic() + end_s
    for process in alive:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def last_lines(log: Path, number: int = LOG_LINES) -> str:
    """Return the last lines of a log; a line that a progress bar has written again counts as several."""
    with open(log, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - LOG_BYTES))
        text = file.read().decode(errors="replace")
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    return "\n".join(lines[-number:])
