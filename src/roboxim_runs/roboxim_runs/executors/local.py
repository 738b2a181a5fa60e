"""Runs jobs on worker processes of this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from roboxim_runs.executors.kept import KeptProcesses
from roboxim_runs.executors.pool import Pool
from roboxim_runs.executors.protocol import Cancellation, Done, Job, Lost, Note, Prepare, Work, unchanged
from roboxim_runs.executors.worker_process import STALL_S, WorkerProcess


class LocalExecutor:
    """Runs jobs on processes of this machine."""

    def __init__(
        self,
        workers: int = 1,
        *,
        log_dir: Path | str | None = None,
        stall_s: float = STALL_S,
        kept: KeptProcesses | None = None,
    ) -> None:
        """Make the executor. `run` starts the workers.

        Args:
            workers: Largest number of processes, >= 1; never more than jobs.
            log_dir: Folder of the workers' output, ``worker-<n>.log``; none: a temporary folder.
            stall_s: A worker that is silent for this time counts as dead [s].
            kept: Processes that outlive a run; none: each run starts its own.
        """
        self.workers = workers
        self.stall_s = stall_s
        self._log_dir = Path(log_dir) if log_dir else None
        self._kept = kept
        self._pool: Pool | None = None

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
            UnavailableError: When a worker cannot start, with the end of its log.
        """
        log_dir = self._log_dir or Path(tempfile.mkdtemp(prefix="roboxim-workers-"))
        log_dir.mkdir(parents=True, exist_ok=True)
        self._pool = Pool(
            lambda number, closing: WorkerProcess(
                prepare(work, number, closing), number, log_dir, closing=closing, stall_s=self.stall_s,
                kept=self._kept,
            ),
            jobs, self.workers, before_retry,
        )  # fmt: skip
        yield from self._pool.run(on_note, cancellation)

    def pids(self) -> list[int]:
        """Return the process ids of the running workers."""
        places = self._pool.places() if self._pool is not None else []
        return [place.process.pid for place in places if isinstance(place, WorkerProcess) and place.process is not None]
