"""Worker processes that outlive their run, so that the next run of the same kind need not start its own.

The start of an episode worker imports the graph and a policy's libraries and compiles the policy: several seconds of
processor time, more than a short evaluation's episodes. A kept process closes its worker after a run and makes another
one for the next.

Non-obvious:
- Only a work that declares `Work.leaves_nothing` shares processes: a user's policy could keep a model in a module's
  variable, and the next policy would use it.
- A child dies with the thread that started it, so all are started by one thread of this class.
"""

from __future__ import annotations

import subprocess
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from roboxim_bringup.process import stop
from roboxim_core.closing import Closing

Spawned = tuple[subprocess.Popen[bytes], "Connection[Any, Any]"]
"""A worker's process, and the connection to it."""
MAX_WORKS = 8
"""Number of runs that a process serves before it ends; memory that libraries keep of each work, e.g. compiled policies,
adds up."""


class KeptProcesses(Closing):
    """Idle worker processes. A context manager that ends them on exit; used by several threads."""

    def __init__(self) -> None:
        """Start without processes."""
        self._starter = ThreadPoolExecutor(max_workers=1, thread_name_prefix="kept-workers")
        self._lock = threading.Lock()
        self._idle: list[Spawned] = []
        self._all: list[subprocess.Popen[bytes]] = []
        self._works: Counter[int] = Counter()

    def spawned(self, make: Callable[[], Spawned]) -> Spawned:
        """Start a process that may outlive the calling thread.

        Args:
            make: Starts it.
        """
        found = self._starter.submit(make).result()
        with self._lock:
            self._all = [process for process in self._all if process.poll() is None]
            self._all.append(found[0])
            self._works[found[0].pid] = 1
        return found

    def take(self) -> Spawned | None:
        """Return an idle process, which then belongs to the caller; None: no process is idle."""
        with self._lock:
            while self._idle:
                process, connection = self._idle.pop()
                if process.poll() is None:
                    self._works[process.pid] += 1
                    return process, connection
                connection.close()
        return None

    def give(self, process: subprocess.Popen[bytes], connection: Connection[Any, Any]) -> None:
        """Keep a process whose worker is closed, unless it has served `MAX_WORKS`."""
        with self._lock:
            if self._works[process.pid] >= MAX_WORKS:
                connection.close()  # the process ends on this
                return
            self._idle.append((process, connection))

    def pids(self) -> list[int]:
        """Return the process ids of all processes that run, idle or not."""
        with self._lock:
            return [process.pid for process in self._all if process.poll() is None]

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            for _, connection in self._idle:
                connection.close()
            self._idle.clear()
        stop(self._all)
        self._starter.shutdown()
