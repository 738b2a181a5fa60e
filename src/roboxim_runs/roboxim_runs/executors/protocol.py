"""Jobs, workers and executors: the protocol between them.

A job and its result are plain data (dicts, lists, strings, numbers, booleans, none), so that they can travel to another
process or machine as JSON. A result depends on the work and the job alone: never on the worker, the number of workers,
or the order.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from roboxim_core.errors import ErrorCode, RoboximError

MAX_TRIES = 3
"""Number of workers that may die at one job."""


class Cancellation(Protocol):
    """A request to end a run early, e.g. a `threading.Event`."""

    def is_set(self) -> bool:
        """Return whether the run must end."""
        ...


class CancelledError(RoboximError):
    """A run was cancelled; the same call continues with the missing parts."""

    code = ErrorCode.CANCELLED


class WorkerBrokenError(Exception):
    """A worker cannot do further jobs; a new worker repeats the job."""


class Worker(Protocol):
    """Runs jobs one after the other, in the thread that made it."""

    def run(self, job: Any, note: Callable[[Any], None]) -> Any:
        """Run a job.

        Args:
            job: The job's data.
            note: Reports progress as plain data; call it at least every few minutes.

        Returns:
            The result, as plain data.

        Raises:
            RoboximError: On a fault that a new worker does not recover from; it ends the whole run.
            WorkerBrokenError: On a fault of the worker itself; a new worker repeats the job.
        """
        ...

    def close(self) -> None:
        """Free everything."""
        ...


@dataclass(frozen=True, kw_only=True)
class Work:
    """Task of a run's workers, as plain data."""

    worker: str
    """``module:name`` of a callable ``(settings, number) -> Worker``; every started worker gets a new number."""
    settings: Any = None
    """Settings that all jobs share, as plain data."""
    environment: dict[str, str] = field(default_factory=dict)
    """Environment variables of the worker's process, in addition to this process's."""
    python_path: tuple[str, ...] = ()
    """Folders searched for the worker's module before the installed packages."""
    leaves_nothing: bool = False
    """Whether a closed worker leaves nothing in its process that could change another work's results. Such a process
    may serve another such work; see `roboxim_runs.executors.kept`."""

    def make_worker(self, number: int) -> Worker:
        """Make a worker in this process and thread.

        Args:
            number: Number of the worker, unique in the run.

        Raises:
            RoboximError: When the settings are wrong.
        """
        sys.path[:0] = [path for path in self.python_path if path not in sys.path]
        module, _, name = self.worker.partition(":")
        worker: Worker = getattr(importlib.import_module(module), name)(as_json(self.settings), number)
        return worker


@dataclass(frozen=True, kw_only=True)
class Job:
    """One piece of work."""

    key: str
    """Name of the job, unique in its run."""
    data: Any = None
    """Input of the worker, as plain data."""


@dataclass(frozen=True, kw_only=True)
class Note:
    """A message from a worker."""

    worker: int
    """Index of the parallel worker, from 0."""
    key: str
    """Its job."""
    data: Any = None
    """Reported progress, as plain data; none with a text."""
    text: str = ""
    """Message for the user, e.g. that a worker is restarted."""


@dataclass(frozen=True, kw_only=True)
class Done:
    """A finished job."""

    key: str
    """The job."""
    value: Any
    """Result of the job, as plain data."""


@dataclass(frozen=True, kw_only=True)
class Lost:
    """A job whose workers all died."""

    key: str
    """The job."""
    message: str
    """Cause of the last worker's death, with the end of its log."""


Prepare = Callable[[Work, int, threading.Event], Work]
"""Returns the work for the worker with a number, updated with changes since the run began, e.g. a server's address.
It may wait, in the worker's thread; when the event is set it raises `roboxim_runs.executors.pool.ClosingError`."""


def unchanged(work: Work, number: int, closing: threading.Event) -> Work:
    """Return the work unchanged; a `Prepare`."""
    return work


class Executor(Protocol):
    """Runs jobs."""

    def run(
        self,
        work: Work,
        jobs: Sequence[Job],
        *,
        on_note: Callable[[Note], None] = lambda _: None,
        before_retry: Callable[[str], None] = lambda _: None,
        cancellation: Cancellation | None = None,
        prepare: Prepare = unchanged,
    ) -> Iterator[Done | Lost]:
        """Run jobs, and yield each result as soon as it is available, in any order.

        Leaving the iteration early, by an exception or Ctrl-C, ends the workers and loses running jobs.

        Args:
            work: The workers' work.
            jobs: The jobs.
            on_note: Called with the workers' messages, in the thread that iterates.
            before_retry: Called with the key of a job whose worker died, before another worker repeats it, possibly in
                another thread. It removes the dead worker's files.
            cancellation: Ends the run when it is set.
            prepare: Called before each worker starts; returns its work.

        Raises:
            CancelledError: When the run was cancelled.
            RoboximError: When a job has a fault that a new worker does not recover from.
        """
        ...


def as_json(value: Any) -> Any:
    """Return plain data after a round trip through JSON, so that all executors pass on the same values.

    Raises:
        TypeError: When the value is not plain data.
    """
    return json.loads(json.dumps(value))
