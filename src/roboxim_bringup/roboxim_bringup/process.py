"""Child processes that cannot outlive this one, and settings of this one."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import IO, Any

from roboxim_ros.environment import clean_environment as clean_environment

_PR_SET_PDEATHSIG = 1
_MALLOPT = {"M_ARENA_MAX": (-8, 1), "M_MMAP_MAX": (-4, 0), "M_TRIM_THRESHOLD": (-1, 2**31 - 1)}
"""Options of glibc's ``malloc.h`` with their numbers and the values that make `keep_freed_memory`."""
THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Environment variables with the number of threads of NumPy and OpenCV; a worker gets 1 unless they are set."""


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends.

    Args:
        parent: Process id of the parent; if it has ended already, this process ends at once.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def keep_freed_memory() -> bool:
    """Have the C library keep freed memory for this process's next allocations; see ``man mallopt``.

    A training step of XLA allocates and frees large buffers. By default glibc returns them to the kernel, which hands
    out zeroed pages again at the next step, thousands of page faults each time. `make bench-bc_training` measures the
    cost, which is small on an idle machine.

    Returns:
        Whether the C library took all settings; C libraries other than glibc lack them.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and all(mallopt(option, value) for option, value in _MALLOPT.values())


def spawn(
    module: str,
    arguments: Sequence[str],
    *,
    output: IO[Any] | None = None,
    environment: Mapping[str, str] | None = None,
    inherited: Mapping[str, str] | None = None,
    ready: int | None = None,
    pass_fds: Sequence[int] = (),
    folder: str | None = None,
    one_thread: bool = True,
) -> subprocess.Popen[bytes]:
    """Start ``python -m module arguments`` as a child that dies with the calling *thread*.

    The child has a process group of its own: Ctrl-C reaches only the parent, which ends its children properly.

    Args:
        module: A module that calls `die_with_parent` with ``$ROBOXIM_PARENT`` when it starts.
        arguments: Its arguments.
        output: Destination of its stdout and stderr; none: those of this process.
        ready: Write end of a pipe, which the child gets as ``$ROBOXIM_READY``; see `tell_ready`.
        environment: Environment variables in addition to those inherited.
        inherited: Environment variables that it inherits; none: those of this process.
        pass_fds: File descriptors that it inherits.
        folder: Its working directory; none: this process's.
        one_thread: Whether each library gets one thread unless its variable is set, see `THREAD_COUNTS`: where many
            such children are the parallelism. False for programs of others.
    """
    inherited = os.environ if inherited is None else inherited
    defaults = {name: "1" for name in THREAD_COUNTS if one_thread and name not in inherited}
    if ready is not None:
        defaults["ROBOXIM_READY"] = str(ready)
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        env={
            **inherited,
            **defaults,
            **(environment or {}),
            "ROBOXIM_PARENT": str(os.getpid()),
            "PYTHONUNBUFFERED": "1",
        },
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        process_group=0,
        cwd=folder,
        pass_fds=(*pass_fds, *(() if ready is None else (ready,))),
    )


def report_ready() -> None:
    """Signal to the parent that this process has started completely; do nothing if the parent does not wait for it."""
    pipe = os.environ.pop("ROBOXIM_READY", None)
    if pipe is not None:
        os.write(int(pipe), b"1")
        os.close(int(pipe))


def stop(processes: Iterable[subprocess.Popen[bytes]], *, grace_s: float = 8.0) -> None:
    """End processes: send SIGTERM to all, and SIGKILL to those that outlive the grace time.

    Args:
        processes: The processes.
        grace_s: Time to end after SIGTERM [s].
    """
    alive = [process for process in processes if process.poll() is None]
    for process in alive:
        process.terminate()
    for process in alive:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(grace_s)
        if process.poll() is None:
            process.kill()
            process.wait()


def describe_exit(returncode: int) -> str:
    """Return how a process ended, e.g. ``killed by SIGKILL`` or ``exit code 1``."""
    if returncode < 0:
        return f"killed by {signal.Signals(-returncode).name}"
    return f"exit code {returncode}"
