"""A worker in a process of this machine: started, given jobs, watched, ended.

Non-obvious:
- The kernel kills the process when the *thread* that started it ends, so that thread must live as long as the worker.
- So a process that outlives its run is started by the thread of `KeptProcesses`.
- A worker is a separate program (``python -m roboxim_runs.executors.worker``), not a `multiprocessing` process: that
  would import the caller's main module, so a script without ``if __name__ == "__main__"`` would start itself.
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

from roboxim_bringup.process import describe_exit, spawn, stop
from roboxim_core.errors import UnavailableError, raise_for_code
from roboxim_runs.executors.kept import KeptProcesses, Spawned
from roboxim_runs.executors.pool import ClosingError, WorkerDiedError
from roboxim_runs.executors.protocol import Work

READY_S = 900.0
"""Longest start of a worker [s]; a policy may compile on a busy machine meanwhile."""
STALL_S = 300.0
"""A worker that is silent for this time counts as dead [s]."""
EXIT_S = 10.0
"""Longest time for a broken worker to exit by itself [s]."""
REST_S = 30.0
"""Longest time for a worker to close within its process [s]."""
LOG_LINES = 15
"""Number of lines of a dead worker's log in an error message."""


class WorkerProcess:
    """A worker in a child process; a `roboxim_runs.executors.pool.Place`. Used by one thread."""

    def __init__(
        self,
        work: Work,
        number: int,
        closing: threading.Event,
        *,
        log_dir: Path,
        stall_s: float = STALL_S,
        inherited: Mapping[str, str] | None = None,
        folder: str | None = None,
        kept: KeptProcesses | None = None,
    ) -> None:
        """Store the worker's settings; `start` starts it.

        Args:
            work: Its work.
            number: Its number, unique in the run.
            closing: Ends every wait when it is set.
            log_dir: Existing folder of its output, ``worker-<number>.log``.
            stall_s: A worker that is silent for this time counts as dead [s].
            inherited: Environment that the work's variables are added to; none: this process's.
            folder: Working directory; none: this process's.
            kept: Idle processes of earlier works. The worker uses one of them if there is one, and returns its process
                to them at the end; none: it starts its own process.
        """
        self.log = str(log_dir / f"worker-{number}.log")
        self.process: subprocess.Popen[bytes] | None = None
        self._work, self._number, self._stall_s, self._closing = work, number, stall_s, closing
        self._inherited, self._folder = inherited, folder
        self._connection: Connection[Any, Any] | None = None
        self._received_at = 0.0
        self._kept = kept if work.leaves_nothing else None
        self._idle, self._printed_before = False, 0

    def start(self) -> None:
        """Start the process, or continue in one of an earlier work; see `Place.start`."""
        Path(self.log).touch()  # a continued run keeps what was printed before
        self._printed_before = Path(self.log).stat().st_size
        if self._kept is not None and (found := self._kept.take()) is not None:
            try:
                self._begin(found)
            except WorkerDiedError:  # an earlier work may have made it die while idle
                self._stop()
            else:
                return
        self._begin(self._spawned())

    def _begin(self, place: Spawned) -> None:
        """Make the worker in a process; returns when it is ready."""
        self.process, self._connection = place
        self._send("work", {"work": asdict(self._work), "number": self._number, "log": self.log})
        kind, content = self._receive(starting=True)
        if kind != "ready":
            self._raise_for(kind, content)
        self._idle = True

    def _spawned(self) -> Spawned:
        def make() -> Spawned:
            own_end, child_end = Pipe()
            with child_end, open(self.log, "ab") as output:
                process = spawn(
                    "roboxim_runs.executors.worker", [str(child_end.fileno())], output=output,
                    environment=environment, inherited=self._inherited, pass_fds=[child_end.fileno()],
                    folder=self._folder,
                )  # fmt: skip
            return process, own_end

        if self._kept is None:
            environment = self._work.environment
            return make()
        environment = {}  # each work sets its own variables
        return self._kept.spawned(make)

    def run(self, job: Any, on_note: Callable[[Any], None]) -> Any:
        """Give the worker a job and return its result; see `Place.run`."""
        self._idle = False
        self._send("job", job)
        while True:
            kind, content = self._receive()
            if kind == "done":
                self._idle = True
                return content
            if kind != "note":
                self._raise_for(kind, content)
            on_note(content)
            if self._closing.is_set():  # a worker that keeps sending messages must end as well
                raise ClosingError

    def end(self) -> bool:
        """End the process, or keep it idle for a later work; see `Place.end`."""
        if self._kept is not None and self._idle and self._rests():
            assert self.process is not None
            assert self._connection is not None
            self._kept.give(self.process, self._connection)
            self.process = self._connection = None
            return False
        return self._stop()

    def _stop(self) -> bool:
        """End the process; return whether it had been ended from outside before."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        killed = False
        if self.process is not None:
            killed = (self.process.poll() or 0) < 0
            stop([self.process])
            self.process = None
        return killed

    def _rests(self) -> bool:
        """Close the worker in its process; return whether the process is ready for another work."""
        assert self._connection is not None
        self._idle = False
        try:
            self._send("rest")
            return self._connection.poll(REST_S) and json.loads(self._connection.recv_bytes())[0] == "resting"
        except (WorkerDiedError, EOFError, OSError):
            return False

    def _send(self, kind: str, content: Any = None) -> None:
        assert self._connection is not None
        try:
            self._connection.send_bytes(json.dumps([kind, content]).encode())
        except OSError:
            raise WorkerDiedError(self._describe_death()) from None

    def _receive(self, *, starting: bool = False) -> tuple[str, Any]:
        """Return the worker's next message; raise when the worker cannot send one any more.

        Args:
            starting: Whether it is the first one, for which the worker has `READY_S`.
        """
        assert self._connection is not None
        assert self.process is not None
        self._received_at = time.monotonic()
        while not self._connection.poll(0.1):
            silence = time.monotonic() - self._received_at
            if self._closing.is_set():
                raise ClosingError
            if self.process.poll() is not None:
                raise WorkerDiedError(self._describe_death())
            if starting and silence > READY_S:
                raise UnavailableError(f"a worker is not ready after {READY_S:g} s; its log: {self.log}")
            if not starting and silence > self._stall_s:
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
            self.process.wait(EXIT_S)
        stop([self.process])
        lines = Path(self.log).read_bytes()[self._printed_before :].decode(errors="replace").strip().splitlines()
        tail = "\n".join(lines[-LOG_LINES:])
        return describe_exit(self.process.returncode) + (f"; the end of {self.log}:\n{tail}" if tail else "")
