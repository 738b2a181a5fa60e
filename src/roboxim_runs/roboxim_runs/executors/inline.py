"""Runs jobs one after the other in the calling process: for tests, and for a worker that starts quickly."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator, Sequence

from roboxim_runs.executors.protocol import (
    MAX_TRIES,
    Cancellation,
    CancelledError,
    Done,
    Job,
    Lost,
    Note,
    Prepare,
    Work,
    Worker,
    WorkerBrokenError,
    as_json,
    unchanged,
)


class InlineExecutor:
    """Runs jobs in the thread that iterates. A worker that kills its process kills the caller too."""

    def __init__(self) -> None:
        """Make the executor."""
        self._numbers = itertools.count()

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
        """Run jobs; see `Executor.run`."""

        def made() -> Worker:
            number = next(self._numbers)
            return prepare(work, number, threading.Event()).make_worker(number)

        worker = made()
        try:
            for job in jobs:
                for attempt in range(1, MAX_TRIES + 1):

                    def note(data: object, key: str = job.key) -> None:
                        if cancellation is not None and cancellation.is_set():
                            raise CancelledError("the run was cancelled")
                        on_note(Note(worker=0, key=key, data=as_json(data)))

                    try:
                        note(None)
                        outcome: Done | Lost = Done(key=job.key, value=as_json(worker.run(as_json(job.data), note)))
                        break
                    except WorkerBrokenError as broken:
                        outcome = Lost(key=job.key, message=str(broken))
                        on_note(Note(worker=0, key=job.key, text=f"the worker failed at {job.key} ({broken})"))
                        worker.close()
                        before_retry(job.key)
                        if attempt < MAX_TRIES or job is not jobs[-1]:
                            worker = made()
                yield outcome
        finally:
            worker.close()
