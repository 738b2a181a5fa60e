"""A worker process: ``python -m roboxim_bringup.executors.worker FD NUMBER``, started by `LocalExecutor`.

It reads the work and then jobs from the connection, and answers with pairs of a kind (``ready``, ``note``, ``done``,
``failed``, ``broken``) and its content, all as JSON. What it prints goes to its log. It ends on SIGTERM, when the
connection is closed, and with its parent.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from roboxim_bringup.executors.protocol import Work, Worker, WorkerBrokenError
from roboxim_bringup.process import die_with_parent
from roboxim_core.errors import ErrorCode, RoboximError


def main() -> int:
    """Run jobs until the connection closes; return the exit code."""
    die_with_parent(int(os.environ.pop("ROBOXIM_PARENT")))
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    descriptor, number = map(int, sys.argv[1:])
    os.set_inheritable(descriptor, False)  # a grandchild would keep the connection open
    with Connection(descriptor) as connection:
        writing = threading.Lock()  # a worker may note from other threads

        def send(kind: str, content: Any = None) -> None:
            with writing:
                connection.send_bytes(json.dumps([kind, content]).encode())

        try:
            data = json.loads(connection.recv_bytes())
            worker = Work(**{**data, "python_path": tuple(data["python_path"])}).make_worker(number)
        except (Exception, SystemExit) as error:
            send("failed", _code_and_message(error))
            return 1
        try:
            send("ready")
            return _serve(worker, connection, send)
        finally:
            worker.close()


def _serve(worker: Worker, connection: Connection[Any, Any], send: Any) -> int:
    while True:
        try:
            job = json.loads(connection.recv_bytes())
        except EOFError:
            return 0
        try:
            send("done", worker.run(job, lambda note: send("note", note)))
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


def _end(number: int, _: FrameType | None) -> None:
    """End as by a normal exit, so that everything is closed."""
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
