"""A worker in a process of this machine: started, given jobs, watched, ended.

Non-obvious:
- The kernel kills the process when the *thread* that started it ends, so that thread must live as long as the worker.
- A worker is a program of its own (``python -m roboxim_bringup.executors.worker``), not a `multiprocessing` process:
  that would import the caller's main module, so a script without ``if __name__ == "__main__"`` would start itself.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from roboxim_bringup.executors.pool import ClosingError, WorkerDiedError
from roboxim_bringup.executors.protocol import Work
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


class WorkerProcess:
    """A worker in a child process; a `roboxim_bringup.executors.pool.Place`. Used by one thread."""

    def __init__(
        self,
        work: Work,
        number: int,
        log_dir: Path,
        *,
        closing: threading.Event,
        stall_s: float = STALL_S,
        inherited: Mapping[str, str] | None = None,
        folder: str | None = None,
    ) -> None:
        """Store what the worker is; `start` starts it.

        Args:
            work: Its work.
            number: Its number, unique in the run.
            log_dir: Existing folder of its output, ``worker-<number>.log``.
            closing: Ends every wait when it is set.
            stall_s: A worker that is silent for this time counts as dead [s].
            inherited: Environment that the work's variables are added to; none: this process's.
            folder: Working directory; none: this process's.
        """
        self.log = str(log_dir / f"worker-{number}.log")
        self.process: subprocess.Popen[bytes] | None = None
        self._work, self._number, self._stall_s, self._closing = work, number, stall_s, closing
        self._inherited, self._folder = inherited, folder
        self._connection: Connection[Any, Any] | None = None
        self._heard = 0.0

    def start(self) -> None:
        """Start the process; see `Place.start`."""
        self._connection, theirs = Pipe()
        with theirs, open(self.log, "wb") as output:
            self.process = spawn(
                "roboxim_bringup.executors.worker", [str(theirs.fileno()), str(self._number)], output=output,
                environment=self._work.environment, inherited=self._inherited, pass_fds=[theirs.fileno()],
                folder=self._folder,
            )  # fmt: skip
        self._send(asdict(self._work))
        kind, content = self._receive(READY_S)
        if kind != "ready":
            self._raise_for(kind, content)

    def run(self, job: Any, on_note: Callable[[Any], None]) -> Any:
        """Give the worker a job and return its result; see `Place.run`."""
        self._send(job)
        while True:
            kind, content = self._receive()
            if kind == "done":
                return content
            if kind != "note":
                self._raise_for(kind, content)
            on_note(content)
            if self._closing.is_set():  # a worker that never falls silent must end as well
                raise ClosingError

    def end(self) -> bool:
        """End the process, if there is one; see `Place.end`."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        killed = False
        if self.process is not None:
            killed = (self.process.poll() or 0) < 0
            stop([self.process], grace_s=GRACE_S)
            self.process = None
        return killed

    def _send(self, data: Any) -> None:
        assert self._connection is not None
        try:
            self._connection.send_bytes(json.dumps(data).encode())
        except OSError:
            raise WorkerDiedError(self._describe_death()) from None

    def _receive(self, ready_within_s: float = float("inf")) -> tuple[str, Any]:
        """Return the worker's next message; raise when the worker cannot send one any more."""
        assert self._connection is not None
        assert self.process is not None
        self._heard = time.monotonic()
        while not self._connection.poll(0.1):
            silence = time.monotonic() - self._heard
            if self._closing.is_set():
                raise ClosingError
            if self.process.poll() is not None:
                raise WorkerDiedError(self._describe_death())
            if silence > ready_within_s:
                raise UnavailableError(f"a worker is not ready after {ready_within_s:g} s; its log: {self.log}")
            if silence > self._stall_s:
                raise WorkerDiedError(f"no message from it for {self._stall_s:g} s")
        try:
            kind, content = json.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            raise WorkerDiedError(self._describe_death()) from None
        return kind, content

    def _raise_for(self, kind: str, content: Any) -> None:
        if kind == "broken":
            raise WorkerDiedError(str(content))
        code, message = content
        raise_for_code(code, message)

    def _describe_death(self) -> str:
        assert self.process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):  # let it exit by itself, for its own exit code
            self.process.wait(GRACE_S)
        stop([self.process], grace_s=GRACE_S)
        lines = Path(self.log).read_text(errors="replace").strip().splitlines()
        tail = "\n".join(lines[-LOG_LINES:])
        return describe_exit(self.process.returncode) + (f"; the end of {self.log}:\n{tail}" if tail else "")
