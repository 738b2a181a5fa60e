"""What a job, a worker and an executor are.

A job and its result are plain data (dicts, lists, strings, numbers, booleans, none), so that they can travel to another
process or machine as JSON. A result depends on the work and the job alone: never on the worker that ran it, on their
number, or on the order.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from roboxim_core.errors import ErrorCode, RoboximError


class Cancellation(Protocol):
    """Tells whether a run is to end early; a `threading.Event` is one."""

    def is_set(self) -> bool:
        """Tell whether the run is to end."""
        ...


class CancelledError(RoboximError):
    """A run was cancelled; the same call goes on with what is missing."""

    code = ErrorCode.CANCELLED


class WorkerBrokenError(Exception):
    """Raised by a worker that can do no further job; a fresh worker repeats the job."""


class Worker(Protocol):
    """Does jobs, one after the other, in the thread that made it."""

    def run(self, job: Any, note: Callable[[Any], None]) -> Any:
        """Do a job.

        Args:
            job: The job's data.
            note: Reports progress, plain data; call it at least every few minutes.

        Returns:
            The result, plain data.

        Raises:
            RoboximError: A fault that a fresh worker does not cure; it ends the whole run.
            WorkerBrokenError: A fault of the worker itself; a fresh one repeats the job.
        """
        ...

    def close(self) -> None:
        """Free everything."""
        ...


@dataclass(frozen=True, kw_only=True)
class Work:
    """What workers do, as plain data."""

    worker: str
    """``module:name`` of a callable ``(settings, number) -> Worker``; every worker that starts gets a new number."""
    settings: Any = None
    """What is the same for all jobs, plain data."""
    environment: dict[str, str] = field(default_factory=dict)
    """Environment variables of the worker's process, beside those of this one."""
    python_path: tuple[str, ...] = ()
    """Folders to import the worker's module from, before the installed ones."""

    def make_worker(self, number: int) -> Worker:
        """Make a worker in this process and thread.

        Args:
            number: Its number, never given to another worker of the run.

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
    """Names the job; unique in its run."""
    data: Any = None
    """What the worker is given, plain data."""


@dataclass(frozen=True, kw_only=True)
class Note:
    """What a worker is doing."""

    worker: int
    """Which of the workers that run side by side, from 0."""
    key: str
    """Its job."""
    data: Any = None
    """Progress that the worker reported, plain data; none with a text."""
    text: str = ""
    """Something that the user should know, e.g. that a worker is started again."""


@dataclass(frozen=True, kw_only=True)
class Done:
    """A finished job."""

    key: str
    """The job."""
    value: Any
    """Its result, plain data."""


@dataclass(frozen=True, kw_only=True)
class Lost:
    """A job that cost all its workers."""

    key: str
    """The job."""
    message: str
    """How the last worker died, with the end of its log."""


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
    ) -> Iterator[Done | Lost]:
        """Run jobs; yield each result as soon as it is there, in whatever order they finish.

        Leaving the iteration early, by an exception or Ctrl-C, ends the workers: running jobs are lost.

        Args:
            work: What workers do.
            jobs: The jobs.
            on_note: Called with what workers report, in the thread that iterates.
            before_retry: Called with the key of a job whose worker died, before another worker repeats it, possibly in
                another thread: to remove what the dead one left.
            cancellation: Ends the run when it is set.

        Raises:
            CancelledError: When the run was cancelled.
            RoboximError: When a job has a fault that a fresh worker does not cure.
        """
        ...


def as_json(value: Any) -> Any:
    """Return plain data as it is after a journey as JSON, so that no executor passes on more than another.

    Raises:
        TypeError: When the value is not plain data.
    """
    return json.loads(json.dumps(value))
