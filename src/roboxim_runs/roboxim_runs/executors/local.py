"""Runs jobs on worker processes of this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from roboxim_runs.executors.kept import KeptProcesses
from roboxim_runs.executors.pooled import PlaceFor, PooledExecutor
from roboxim_runs.executors.worker_process import STALL_S, WorkerProcess


class LocalExecutor(PooledExecutor):
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
        super().__init__(workers)
        self.stall_s = stall_s
        self._log_dir = Path(log_dir) if log_dir else None
        self._kept = kept

    @contextmanager
    def places(self) -> Iterator[PlaceFor]:
        """Make the folder of the logs; see `PooledExecutor.places`."""
        log_dir = self._log_dir or Path(tempfile.mkdtemp(prefix="roboxim-workers-"))
        log_dir.mkdir(parents=True, exist_ok=True)
        yield partial(WorkerProcess, log_dir=log_dir, stall_s=self.stall_s, kept=self._kept)

    def pids(self) -> list[int]:
        """Return the process ids of the running workers."""
        places = self.pool.places() if self.pool is not None else []
        return [place.process.pid for place in places if isinstance(place, WorkerProcess) and place.process is not None]
