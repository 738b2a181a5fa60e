"""The thread that simulates, plans and draws: physics, kinematics and GL belong to one thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from roboxim_core.closing import Closing

T = TypeVar("T")


class Bench(Closing):
    """A thread with a queue of jobs. A context manager."""

    def __init__(self) -> None:
        """Start the thread."""
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._newest: dict[str, Future[Any]] = {}
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="bench", daemon=True)
        self._thread.start()
        self.stopping = threading.Event()
        """Set when the bench closes; long jobs look at it."""

    def do(self, job: Callable[[], T], *, newest_of: str = "") -> Future[T]:
        """Queue a job.

        Args:
            job: The job.
            newest_of: A job of the same name that has not begun is dropped: only the newest counts; empty: none is.
        """
        future: Future[T] = Future()
        with self._lock:
            if newest_of:
                if (before := self._newest.get(newest_of)) is not None:
                    before.cancel()
                self._newest[newest_of] = future
            self._jobs.put((job, future))
        return future

    def close(self, last: Callable[[], None] = lambda: None) -> None:
        """Run a last job, then end the thread."""
        self.stopping.set()
        self.do(last)
        self._jobs.put(None)
        self._thread.join(timeout=60)

    def _work(self) -> None:
        while (item := self._jobs.get()) is not None:
            job, future = item
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = job()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
