"""Runs jobs on worker processes of this machine.

Non-obvious:
- A restarted worker gets a *new* number, after which its graph's namespace is named. The services of a dead graph
  stay visible until their lease runs out, and a goal sent to them would never be answered.
- Each worker has a thread here, which starts its process and lives as long as the process: the kernel kills a child
  when the
  *thread* that started it ends.
- A worker is a program of its own (``python -m roboxim_bringup.executors.worker``), not a `multiprocessing` process:
  that would import the caller's main module, so a script without ``if __name__ == "__main__"`` would start itself.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import queue
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from roboxim_bringup.executors.protocol import MAX_TRIES, Cancellation, CancelledError, Done, Job, Lost, Note, Work
from roboxim_bringup.process import describe_exit, spawn, stop
from roboxim_core.errors import UnavailableError, raise_for_code

READY_S = 300.0
"""Longest start of a worker [s]; a policy may compile meanwhile."""
STALL_S = 300.0
"""A worker that is silent for this time counts as dead [s]."""
GRACE_S = 3.0
"""Longest time for a worker to end [s]."""
LOG_LINES = 15
"""Number of lines of a dead worker's log in an error message."""


class LocalExecutor:
    """Runs jobs on processes of this machine."""

    def __init__(self, workers: int = 1, *, log_dir: Path | str | None = None, stall_s: float = STALL_S) -> None:
        """Make the executor. `run` starts the workers.

        Args:
            workers: Largest number of processes, >= 1; never more than jobs.
            log_dir: Folder of the workers' output, ``worker-<n>.log``; none: a temporary folder.
            stall_s: A worker that is silent for this time counts as dead [s].
        """
        self.workers = workers
        self.stall_s = stall_s
        self._log_dir = Path(log_dir) if log_dir else None
        self._slots: list[_Slot] = []

    def run(
        self,
        work: Work,
        jobs: Sequence[Job],
        *,
        on_note: Callable[[Note], None] = lambda _: None,
        before_retry: Callable[[str], None] = lambda _: None,
        cancellation: Cancellation | None = None,
    ) -> Iterator[Done | Lost]:
        """Run jobs; see `Executor.run`.

        Raises:
            UnavailableError: When a worker cannot start, with the end of its log.
        """
        log_dir = self._log_dir or Path(tempfile.mkdtemp(prefix="roboxim-workers-"))
        log_dir.mkdir(parents=True, exist_ok=True)
        pool = _Pool(work, jobs, log_dir, self.stall_s, before_retry)
        self._slots = [_Slot(pool, slot) for slot in range(min(self.workers, len(jobs)))]
        try:
            for thread in self._slots:
                thread.start()
            pending = len(jobs)
            while pending:
                event = _next_event(pool.events, cancellation)
                if isinstance(event, BaseException):
                    raise event
                if isinstance(event, Note):
                    on_note(event)
                else:
                    pending -= 1
                    yield event
        finally:
            pool.closing.set()
            for thread in self._slots:
                if thread.ident is not None:
                    thread.join()

    def pids(self) -> list[int]:
        """Return the process ids of the running workers."""
        return [slot.process.pid for slot in self._slots if slot.process is not None]


_Event = Done | Lost | Note | BaseException


def _next_event(events: queue.Queue[_Event], cancellation: Cancellation | None) -> _Event:
    while True:
        if cancellation is not None and cancellation.is_set():
            raise CancelledError("the run was cancelled")
        try:
            return events.get(timeout=None if cancellation is None else 0.1)
        except queue.Empty:
            continue


class _Pool:
    """State that the threads of one run share."""

    def __init__(
        self, work: Work, jobs: Sequence[Job], log_dir: Path, stall_s: float, before_retry: Callable[[str], None]
    ) -> None:
        self.work, self.log_dir, self.stall_s, self.before_retry = work, log_dir, stall_s, before_retry
        self.jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        for job in jobs:
            self.jobs.put(job)
        self.events: queue.Queue[_Event] = queue.Queue()
        self.closing = threading.Event()
        self.numbers = itertools.count()


class _Slot(threading.Thread):
    """The thread of one worker process: starts it, sends it jobs, restarts it when it dies."""

    def __init__(self, pool: _Pool, slot: int) -> None:
        super().__init__(name=f"worker-{slot}", daemon=True)
        self.pool = pool
        self.slot = slot
        self.process: subprocess.Popen[bytes] | None = None
        self._connection: Connection[Any, Any] | None = None
        self._log = Path()
        self._heard = 0.0

    def run(self) -> None:
        try:
            self._start_with_retry()
            while (job := self._next()) is not None:
                self.pool.events.put(self._do(job))
        except _Closing:
            pass
        except BaseException as error:  # raised in the thread that iterates over the results
            self.pool.events.put(error)
        finally:
            self._end()

    def _next(self) -> Job | None:
        if self.pool.closing.is_set():
            raise _Closing
        try:
            return self.pool.jobs.get_nowait()
        except queue.Empty:
            return None

    def _do(self, job: Job) -> Done | Lost:
        for attempt in range(1, MAX_TRIES + 1):
            try:
                if self.process is None:
                    self._start_with_retry()
                return Done(key=job.key, value=self._exchange(job))
            except _WorkerDied as death:
                message = f"{MAX_TRIES} workers died at it; the last one (its log: {self._log}): {death}"
                self._end()
                again = "starting it again" if attempt < MAX_TRIES else "giving the job up"
                text = f"worker {self.slot} died at {job.key} ({death}); {again}"
                self.pool.events.put(Note(worker=self.slot, key=job.key, text=text))
                self.pool.before_retry(job.key)
        return Lost(key=job.key, message=message)

    def _exchange(self, job: Job) -> Any:
        """Give the worker a job and return its result."""
        self._send(job.data)
        while True:
            kind, content = self._receive()
            if kind == "done":
                return content
            if kind == "note":
                self.pool.events.put(Note(worker=self.slot, key=job.key, data=content))
            else:
                self._raise_for(kind, content)

    def _send(self, data: Any) -> None:
        assert self._connection is not None
        try:
            self._connection.send_bytes(json.dumps(data).encode())
        except OSError:
            raise _WorkerDied(self._describe_death()) from None

    def _receive(self, ready_within_s: float = float("inf")) -> tuple[str, Any]:
        """Return the worker's next message; raise when the worker cannot send one any more."""
        assert self._connection is not None
        assert self.process is not None
        self._heard = time.monotonic()
        while not self._connection.poll(0.1):
            silence = time.monotonic() - self._heard
            if self.pool.closing.is_set():
                raise _Closing
            if self.process.poll() is not None:
                raise _WorkerDied(self._describe_death())
            if silence > ready_within_s:
                raise UnavailableError(f"a worker is not ready after {ready_within_s:g} s; its log: {self._log}")
            if silence > self.pool.stall_s:
                raise _WorkerDied(f"no message from it for {self.pool.stall_s:g} s")
        try:
            kind, content = json.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            raise _WorkerDied(self._describe_death()) from None
        return kind, content

    def _raise_for(self, kind: str, content: Any) -> None:
        if kind == "broken":
            raise _WorkerDied(str(content))
        code, message = content
        raise_for_code(code, message)

    def _start_with_retry(self) -> None:
        """Start the process. Retry when a signal kills it, but not when it reports an error."""
        for attempt in range(1, MAX_TRIES + 1):
            try:
                self._start()
                return
            except _WorkerDied as death:
                assert self.process is not None
                killed = (self.process.poll() or 0) < 0
                self._end()
                if not killed or attempt == MAX_TRIES:
                    raise UnavailableError(f"a worker could not start: {death}") from None

    def _start(self) -> None:
        number = next(self.pool.numbers)
        self._log = self.pool.log_dir / f"worker-{number}.log"
        self._connection, theirs = Pipe()
        with theirs, open(self._log, "wb") as output:
            self.process = spawn(
                "roboxim_bringup.executors.worker", [str(theirs.fileno()), str(number)],
                output=output, environment=self.pool.work.environment, pass_fds=[theirs.fileno()],
            )  # fmt: skip
        self._send(asdict(self.pool.work))
        kind, content = self._receive(READY_S)
        if kind != "ready":
            self._raise_for(kind, content)

    def _end(self) -> None:
        """End the process, if there is one."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self.process is not None:
            stop([self.process], grace_s=GRACE_S)
            self.process = None

    def _describe_death(self) -> str:
        assert self.process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):  # let it exit by itself, for its own exit code
            self.process.wait(GRACE_S)
        stop([self.process], grace_s=GRACE_S)
        lines = self._log.read_text(errors="replace").strip().splitlines()
        tail = "\n".join(lines[-LOG_LINES:])
        return describe_exit(self.process.returncode) + (f"; the end of {self._log}:\n{tail}" if tail else "")


class _WorkerDied(Exception):
    """The worker's process ended or is unusable."""


class _Closing(Exception):
    """The run is over."""
