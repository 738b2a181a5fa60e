"""A worker process: ``python -m roboxim_runs.executors.worker FD``, started by `WorkerProcess`.

It reads pairs of a kind and its content from the connection: ``work`` makes a worker, ``job`` is for it, ``rest``
closes it, after which another ``work`` may follow. It answers with such pairs (``ready``, ``note``, ``done``,
``failed``, ``broken``, ``resting``), all as JSON. Its printed output goes to the log that the work names. It ends on
SIGTERM, when the connection is closed, and with its parent.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from roboxim_bringup.process import die_with_parent
from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_runs.executors.protocol import Work, Worker, WorkerBrokenError

Send = Callable[..., None]


def main() -> int:
    """Serve works until the connection closes; return the exit code."""
    die_with_parent(int(os.environ.pop("ROBOXIM_PARENT")))
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    descriptor = int(sys.argv[1])
    os.set_inheritable(descriptor, False)  # a grandchild would keep the connection open
    environment, path = dict(os.environ), list(sys.path)
    with Connection(descriptor) as connection:
        writing = threading.Lock()  # a worker may note from other threads

        def send(kind: str, content: Any = None) -> None:
            with writing:
                connection.send_bytes(json.dumps([kind, content]).encode())

        code = None
        while code is None:
            os.environ.clear()
            os.environ.update(environment)
            sys.path[:] = path
            code = _serve(connection, send)
        return code


def _serve(connection: Connection[Any, Any], send: Send) -> int | None:
    """Serve one work; return the exit code, or none when another work may follow."""
    try:
        _, content = json.loads(connection.recv_bytes())
    except EOFError:
        return 0
    try:
        worker = _made(**content)
    except (Exception, SystemExit) as error:
        send("failed", _code_and_message(error))
        return 1
    try:
        send("ready")
        code = _run_jobs(worker, connection, send)
    finally:
        with _uninterrupted():
            worker.close()
    if code is None:
        del worker
        send("resting")
        gc.unfreeze()
        gc.collect()  # frees graphs and policies, whose parts refer to one another; no caller waits for this
    return code


def _made(work: dict[str, Any], number: int, log: str) -> Worker:
    """Make a work's worker, with the work's log and environment."""
    with open(log, "ab") as file:
        sys.stdout.flush()
        sys.stderr.flush()
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    made = Work(**{**work, "python_path": tuple(work["python_path"])})
    os.environ.update(made.environment)
    return made.make_worker(number)


def _run_jobs(worker: Worker, connection: Connection[Any, Any], send: Send) -> int | None:
    """Run jobs; return the exit code, or None if the worker becomes idle."""
    first = True
    while True:
        try:
            kind, job = json.loads(connection.recv_bytes())
        except EOFError:
            return 0
        if kind == "rest":
            return None
        try:
            send("done", worker.run(job, lambda note: send("note", note)))
            if first:
                first = False
                gc.freeze()  # loaded modules stay: collecting garbage among them would take 0.15 s every few episodes
        except WorkerBrokenError as broken:
            send("broken", str(broken))
            return 1
        except Exception as error:
            send("failed", _code_and_message(error))


def _code_and_message(error: BaseException) -> tuple[int, str]:
    """Return an error's code and message."""
    if isinstance(error, RoboximError):
        return int(error.code), str(error)
    traceback.print_exception(error)
    return int(ErrorCode.INTERNAL), "".join(traceback.format_exception(error, limit=-3)).strip()


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ignore SIGTERM in the block: a graph that is half closed leaves files in the shared memory."""
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _end(number: int, _: FrameType | None) -> None:
    """End as by a normal exit, so that everything is closed."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
