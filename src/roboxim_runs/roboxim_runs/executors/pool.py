"""Hands the jobs of a run to several workers on any machines, and replaces workers that die.

Each worker has a thread here, which makes it, gives it jobs, and lives as long as the worker.

Non-obvious: a replaced worker gets a *new* number, from which its graph's namespace is named. The services of a dead
graph stay visible until their lease runs out, and requests to them are never answered.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from roboxim_core.errors import UnavailableError
from roboxim_runs.executors.protocol import MAX_TRIES, Cancellation, CancelledError, Done, Job, Lost, Note


class WorkerDiedError(Exception):
    """The worker has ended or is unusable."""


class ClosingError(Exception):
    """The run is over."""


class Place(Protocol):
    """One worker, in a process here or on another machine. Used by one thread."""

    log: str
    """Path of its output."""

    def start(self) -> None:
        """Start the worker; returns when it is ready.

        Raises:
            ClosingError: When the run is over.
            RoboximError: On a fault that a new worker does not recover from.
            WorkerDiedError: When the worker ended.
        """
        ...

    def run(self, job: Any, on_note: Callable[[Any], None]) -> Any:
        """Run a job and return its result, plain data.

        Args:
            job: The job's data.
            on_note: Receives the worker's reports.

        Raises:
            ClosingError: When the run is over.
            RoboximError: On a fault that a new worker does not recover from.
            WorkerDiedError: When the worker ended or is unusable.
        """
        ...

    def end(self) -> bool:
        """End the worker and free everything.

        Returns:
            Whether the worker had been ended from outside before: by a signal or a lost machine.
        """
        ...


MakePlace = Callable[[int, threading.Event], Place]
"""Makes the worker of a number; the event ends its waits."""
_Event = Done | Lost | Note | BaseException


class Pool:
    """The workers of one run."""

    def __init__(
        self, make_place: MakePlace, jobs: Sequence[Job], workers: int, before_retry: Callable[[str], None]
    ) -> None:
        """Prepare the run.

        Args:
            make_place: Makes a worker.
            jobs: The jobs.
            workers: Largest number of workers; never more than jobs.
            before_retry: See `Executor.run`.
        """
        self.make_place, self.before_retry = make_place, before_retry
        self.jobs = deque((job, 0) for job in jobs)
        self.events: queue.Queue[_Event] = queue.Queue()
        self.closing = threading.Event()
        self.numbers = itertools.count()
        self._pending = len(jobs)
        self._slots = [_Slot(self, slot) for slot in range(min(workers, len(jobs)))]

    def run(self, on_note: Callable[[Note], None], cancellation: Cancellation | None) -> Iterator[Done | Lost]:
        """Run the jobs; see `Executor.run`."""
        try:
            for thread in self._slots:
                thread.start()
            while self._pending:
                event = self._next_event(cancellation)
                if isinstance(event, BaseException):
                    raise event
                if isinstance(event, Note):
                    on_note(event)
                else:
                    self._pending -= 1
                    yield event
        finally:
            self.closing.set()
            for thread in self._slots:
                if thread.ident is not None:
                    thread.join()

    def places(self) -> list[Place]:
        """Return the current workers."""
        return [slot.place for slot in self._slots if slot.place is not None]

    def _next_event(self, cancellation: Cancellation | None) -> _Event:
        while True:
            if cancellation is not None and cancellation.is_set():
                raise CancelledError("the run was cancelled")
            try:
                return self.events.get(timeout=None if cancellation is None else 0.1)
            except queue.Empty:
                continue


class _Slot(threading.Thread):
    """The thread of one worker: makes it, gives it jobs, replaces it when it dies."""

    def __init__(self, pool: Pool, slot: int) -> None:
        super().__init__(name=f"worker-{slot}", daemon=True)
        self.pool, self.slot = pool, slot
        self.place: Place | None = None

    def run(self) -> None:
        try:
            while self.pool.jobs:
                place = self.place or self._start()
                if (task := self._next()) is not None:
                    self._do(place, *task)
        except ClosingError:
            pass
        except BaseException as error:  # raised in the thread that iterates over the results
            self.pool.events.put(error)
        finally:
            self._end()

    def _next(self) -> tuple[Job, int] | None:
        """Return the next job and the number of workers that have died while running it."""
        if self.pool.closing.is_set():
            raise ClosingError
        try:
            return self.pool.jobs.popleft()
        except IndexError:
            return None

    def _do(self, place: Place, job: Job, deaths: int) -> None:
        """Run a job; when the worker dies, give the job back, since another worker may be ready before a new one is."""
        try:
            value = place.run(
                job.data,
                lambda data: self.pool.events.put(Note(worker=self.slot, key=job.key, data=data)),
            )
            self.pool.events.put(Done(key=job.key, value=value))
        except WorkerDiedError as death:
            deaths += 1
            message = f"{MAX_TRIES} workers died at it; the last one (its log: {place.log}): {death}"
            self._end()
            again = "starting it again" if deaths < MAX_TRIES else "giving the job up"
            text = f"worker {self.slot} died at {job.key} ({death}); {again}"
            self.pool.events.put(Note(worker=self.slot, key=job.key, text=text))
            self.pool.before_retry(job.key)
            if deaths < MAX_TRIES:
                self.pool.jobs.appendleft((job, deaths))
            else:
                self.pool.events.put(Lost(key=job.key, message=message))

    def _start(self) -> Place:
        """Start a worker. Retry if it is ended from outside, but not if it reports an error."""
        for attempt in range(1, MAX_TRIES + 1):
            self.place = self.pool.make_place(next(self.pool.numbers), self.pool.closing)
            try:
                self.place.start()
                return self.place
            except WorkerDiedError as death:
                if not self._end() or attempt == MAX_TRIES:
                    raise UnavailableError(f"a worker could not start: {death}") from None
        raise AssertionError("unreachable")

    def _end(self) -> bool:
        place, self.place = self.place, None
        return place.end() if place is not None else False
