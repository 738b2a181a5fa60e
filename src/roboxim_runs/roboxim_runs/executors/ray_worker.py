"""A Ray actor with one worker: a subprocess on the actor's node, in its own ROS domain.

The actor's process imports no ROS: rclpy in an actor needs an environment that the actor's process was not started
with, and forks of it hang. It starts the worker as a program, with an environment of named variables, and passes on the
worker's reports. Only plain data goes through Ray: jobs, results and progress.
"""

from __future__ import annotations

import importlib
import os
import platform
import queue
import socket
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_ros.runs import free_domain, register_run, transport_environment
from roboxim_runs.executors.pool import ClosingError, WorkerDiedError
from roboxim_runs.executors.protocol import Work
from roboxim_runs.executors.worker_process import WorkerProcess

NODE_ADDRESS = "ROBOXIM_NODE_ADDRESS"
"""Environment variable of the worker: the address by which the cluster's other nodes reach this one."""
PASSED_ON = (
    "CUDA_VISIBLE_DEVICES", "HOME", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "LOGNAME", "NVIDIA_DRIVER_CAPABILITIES",
    "NVIDIA_VISIBLE_DEVICES", "PATH", "SSL_CERT_FILE", "TMPDIR", "TZ", "USER", "XDG_RUNTIME_DIR",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
)  # fmt: skip
"""Variables of the node that the worker inherits."""
PREFIXES = ("AWS_", "AZURE_", "FSSPEC_", "GOOGLE_", "JAX_", "LP_", "ROBOXIM_", "XLA_", "__EGL_")
"""Prefixes of further variables."""
NOT_PASSED_ON = ("ROBOXIM_PARENT", "ROBOXIM_READY", "ROBOXIM_RUN")
COMPARED = ("roboxim", "numpy", "pin", "pybullet", "ompl", "ruckig", "moderngl", "mcap", "zstandard")
"""Packages whose versions results depend on."""


def software() -> dict[str, str]:
    """Return the versions that must be equal on all machines for equal results."""
    packages = {name: version(name) for name in COMPARED}
    return {"Python": platform.python_version(), "processor": platform.machine(), **packages}


class RayWorker:
    """The actor. `begin` gives the worker a job, `poll` returns its reports since the last call."""

    def __init__(self, work: Mapping[str, Any], number: int, stall_s: float, folder: str) -> None:
        """Start the worker.

        Args:
            work: The fields of a `Work`, plain data. The transport and domain in its environment are replaced.
            number: The worker's number, unique in the run.
            stall_s: A worker that is silent for this time counts as dead [s].
            folder: Working directory of the worker, for relative paths; another one where it does not exist.
        """
        self._folder = folder if os.path.isdir(folder) else None
        self._work = Work(**{**work, "python_path": tuple(work["python_path"])})
        self._number, self._stall_s = number, stall_s
        self._closing = threading.Event()
        self._jobs: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        # the kernel ends the subprocess with the thread that started it
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def facts(self) -> dict[str, Any]:
        """Return the node's name, the software there, and the actor's process id."""
        return {"host": socket.gethostname(), "software": software(), "pid": os.getpid()}

    def begin(self, job: Any) -> None:
        """Give the worker a job."""
        self._jobs.put(job)

    def poll(self, timeout_s: float) -> list[tuple[str, Any]]:
        """Return the worker's reports: pairs of a kind and its content, plain data.

        Args:
            timeout_s: Longest wait for something other than progress [s]; progress waits as long.
        """
        found: list[tuple[str, Any]] = []
        deadline = time.monotonic() + timeout_s
        while not found or found[-1][0] == "note":
            try:
                found.append(self._events.get(timeout=max(0.0, deadline - time.monotonic())))
            except queue.Empty:
                break
        return found

    def close(self) -> None:
        """End the worker."""
        self._closing.set()
        self._jobs.put(None)
        self._thread.join()

    def _serve(self) -> None:
        try:
            with ExitStack() as stack:
                domain = stack.enter_context(free_domain())
                run = stack.enter_context(register_run("ray-worker", domain=domain, namespaces=(f"/w{self._number}",)))
                logs = Path(tempfile.gettempdir()) / "roboxim-ray-logs" / run.id
                logs.mkdir(parents=True, exist_ok=True)
                environment = {**self._work.environment, **transport_environment(False)}
                environment |= {"ROS_DOMAIN_ID": str(domain), "ROBOXIM_RUN": run.id, **_node_address()}
                work = replace(self._work, environment=environment)
                process = WorkerProcess(
                    work, self._number, self._closing, log_dir=logs, stall_s=self._stall_s, inherited=_environment(),
                    folder=self._folder,
                )  # fmt: skip
                stack.callback(process.end)
                try:
                    process.start()
                    self._events.put(("ready", process.log))
                    while not self._closing.is_set() and (job := self._jobs.get()) is not None:
                        self._events.put(("done", process.run(job[0], lambda data: self._events.put(("note", data)))))
                except WorkerDiedError as death:
                    self._events.put(("died", (str(death), process.end())))
        except ClosingError:
            pass
        except RoboximError as error:
            self._events.put(("failed", (int(error.code), str(error))))
        except BaseException as error:
            self._events.put(("failed", (int(ErrorCode.INTERNAL), f"{type(error).__name__}: {error}")))


def _node_address() -> dict[str, str]:
    ray: Any = importlib.import_module("ray")
    return {NODE_ADDRESS: str(ray.util.get_node_ip_address())}


def _environment() -> dict[str, str]:
    return {
        name: value
        for name, value in os.environ.items()
        if (name in PASSED_ON or name.startswith(PREFIXES)) and name not in NOT_PASSED_ON
    }
