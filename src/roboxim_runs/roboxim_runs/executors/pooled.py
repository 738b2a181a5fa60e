"""Base class of executors whose workers run in their own processes."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager

from roboxim_runs.executors.pool import Place, Pool
from roboxim_runs.executors.protocol import Cancellation, Done, Job, Lost, Note, Prepare, Work, unchanged

PlaceFor = Callable[[Work, int, threading.Event], Place]
"""Makes the worker of a work and a number; the event ends its waits."""


class PooledExecutor(ABC):
    """Runs jobs on several workers at a time; a `roboxim_runs.executors.protocol.Executor`."""

    def __init__(self, workers: int) -> None:
        """Make the executor. `run` starts the workers.

        Args:
            workers: Largest number of workers, >= 1; never more than jobs.
        """
        self.workers = workers
        self.pool: Pool | None = None
        """Workers of the latest run."""

    @abstractmethod
    def places(self) -> AbstractContextManager[PlaceFor]:
        """Prepare the resources that all workers of a run share; yields the function that makes a worker."""

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
        """Run jobs; see `Executor.run`.

        Raises:
            ConfigError: When the workers' machines have different software from this one.
            UnavailableError: When a worker cannot start, with the end of its log.
        """
        with self.places() as place_for:
            self.pool = Pool(
                lambda number, closing: place_for(prepare(work, number, closing), number, closing),
                jobs, self.workers, before_retry,
            )  # fmt: skip
            yield from self.pool.run(on_note, cancellation)
