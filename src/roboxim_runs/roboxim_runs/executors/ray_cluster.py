"""Runs jobs on the nodes of a Ray cluster. Ray is imported when a run begins, and only then.

Non-obvious:
- Ray decides where a worker runs and reports lost nodes. RoboXim itself handles jobs, retries and results
  (`roboxim_runs.executors.pool`), so that a run is the same on every executor.
- A worker on a disconnected node may keep running for seconds while another one repeats its job. Workers of a cluster
  therefore never write into the folder of finished episodes; see ``staged``.
- When the cluster's head is lost for long, Ray ends the process that runs the jobs. The same command continues.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from roboxim_core.errors import ConfigError, UnavailableError, raise_for_code
from roboxim_runs.executors.pool import ClosingError, WorkerDiedError
from roboxim_runs.executors.pooled import PlaceFor, PooledExecutor
from roboxim_runs.executors.protocol import Work
from roboxim_runs.executors.worker_process import READY_S, STALL_S

POLL_S = 1.0
"""Longest time between two requests to an actor [s]; progress is at most this old."""
PLACED_S = 600.0
"""Longest wait for a node with free resources [s]."""
GONE_S = 60.0
"""Time without an answer after which an actor counts as lost [s]."""
CONNECT_S = 20.0
"""Longest wait for a connection to the cluster's head [s]."""
OWN_CLUSTER = {"agent_register_timeout_ms": 120_000, "worker_niceness": 0}
"""Settings of clusters on this machine. With Ray's defaults, nodes of a busy machine end when their agents do not start
within 15 s, and workers run at niceness 15, so that any other program delays them."""
MISSING = (
    "the executor 'ray' needs Ray, which is not installed; install it on all machines with: pip install 'roboxim[ray]'"
)


class RayExecutor(PooledExecutor):
    """Runs jobs on a Ray cluster, one worker per actor."""

    staged = True
    """A worker may still write after it counts as lost, so each writes into its own folder, from which the run takes
    the results."""

    def __init__(
        self,
        workers: int = 1,
        *,
        address: str = "",
        resources: Mapping[str, float] | None = None,
        stall_s: float = STALL_S,
        option: str = "--resources",
    ) -> None:
        """Make the executor. `run` connects to the cluster and starts the workers.

        Args:
            workers: Largest number of workers in the cluster, >= 1; never more than jobs.
            address: Address of the cluster, e.g. ``auto`` or ``ray://host:10001``; empty: a cluster on this machine,
                for this run.
            resources: Resources that a worker occupies: ``CPU``, ``GPU``, or names that the cluster defines; none: one
                CPU.
            stall_s: A worker that is silent for this time counts as dead [s].
            option: Name of the option that sets the resources, for errors.

        Raises:
            ConfigError: When Ray is not installed.
        """
        _import_ray()
        self._connection = contextlib.ExitStack()
        super().__init__(workers)
        self.address, self.stall_s, self.option = address, stall_s, option
        self.resources = dict(resources or {"CPU": 1.0})

    @property
    def elsewhere(self) -> bool:
        """Whether workers may run on other machines."""
        return bool(self.address)

    def __enter__(self) -> RayExecutor:
        """Stay connected until the block ends, so that several runs share one connection, or one cluster of their own.

        Raises:
            UnavailableError: When there is no cluster at the address.
        """
        self._connection.enter_context(_connected(self.address, self.workers))
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self._connection.close()

    @contextlib.contextmanager
    def places(self) -> Iterator[PlaceFor]:
        """Connect to the cluster; see `PooledExecutor.places`.

        Raises:
            UnavailableError: When there is no cluster at the address.
        """
        with _connected(self.address, self.workers) as ray:
            yield partial(_RayPlace, ray, self, _PlacedWorkers())


def _import_ray() -> Any:
    try:
        import ray
    except ImportError:
        raise ConfigError(MISSING) from None
    return ray


@contextlib.contextmanager
def _connected(address: str, workers: int) -> Iterator[Any]:
    """Connect to the cluster, unless the program is connected already; yields the module ``ray``."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray = _import_ray()
    if ray.is_initialized():
        yield ray
        return
    try:
        _require_listening(address)
        own = {} if address else _own_cluster(workers)
        ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise UnavailableError(
            f"no connection to the Ray cluster at '{address or 'this machine'}': {error}; start one with 'ray start "
            "--head', and name its address with --address"
        ) from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listening(address: str) -> None:
    """Refuse an unreachable address at once; Ray itself tries for minutes.

    Raises:
        OSError: When there is no connection.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()


def _own_cluster(workers: int) -> dict[str, Any]:
    """Return the arguments of a cluster on this machine for one run."""
    return {
        "num_cpus": max(workers, os.cpu_count() or 1), "include_dashboard": False,
        "_system_config": OWN_CLUSTER,
    }  # fmt: skip


class _PlacedWorkers:
    """The workers of a run that have a node. As long as there are any, further workers may wait for a node."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._placed = 0

    def change(self, by: int) -> None:
        with self._lock:
            self._placed += by

    def __bool__(self) -> bool:
        return self._placed > 0


class _RayPlace:
    """A worker behind an actor; a `roboxim_runs.executors.pool.Place`."""

    def __init__(
        self,
        ray: Any,
        executor: RayExecutor,
        placed_workers: _PlacedWorkers,
        work: Work,
        number: int,
        closing: threading.Event,
    ) -> None:
        self.log = "not started"
        self._ray, self._executor, self._placed_workers = ray, executor, placed_workers
        self._work, self._number, self._closing = work, number, closing
        self._actor: Any = None
        self._placed = self._lost = self._killed = False

    def start(self) -> None:
        from roboxim_runs.executors.ray_worker import RayWorker, software

        resources = self._executor.resources
        more = {name: value for name, value in resources.items() if name not in ("CPU", "GPU")}
        remote = self._ray.remote(RayWorker).options(
            num_cpus=resources.get("CPU", 0.0), num_gpus=resources.get("GPU", 0.0), resources=more,
            max_restarts=0, max_concurrency=4,
        )  # fmt: skip
        self._actor = remote.remote(asdict(self._work), self._number, self._executor.stall_s, os.getcwd())
        facts = self._answer(self._actor.facts.remote(), PLACED_S, waiting_for="a node with free resources")
        self._placed = True
        self._placed_workers.change(1)
        local_software = software()
        if facts["software"] != local_software:
            changes = [
                f"{n}: {v} there, {local_software[n]} here"
                for n, v in facts["software"].items()
                if v != local_software[n]
            ]
            raise ConfigError(
                f"the node {facts['host']} has other software, so its episodes may differ: {'; '.join(changes)}; "
                "install the same on all machines"
            )
        self._host = facts["host"]
        self.log = f"on {self._host}"
        deadline = time.monotonic() + READY_S
        while not (found := self._poll()):
            if time.monotonic() > deadline:
                raise UnavailableError(f"a worker on {self._host} is not ready after {READY_S:g} s")
        kind, content = found[0]
        if kind != "ready":
            self._raise_for(kind, content)
        self.log = f"{content} on {self._host}"

    def run(self, job: Any, on_note: Callable[[Any], None]) -> Any:
        self._answer(self._actor.begin.remote([job]), GONE_S)
        while True:
            for kind, content in self._poll():
                if kind == "done":
                    return content
                if kind == "note":
                    on_note(content)
                else:
                    self._raise_for(kind, content)

    def end(self) -> bool:
        actor, self._actor = self._actor, None
        placed, self._placed = self._placed, False
        self._placed_workers.change(-int(placed))
        if actor is not None and not self._lost:
            with contextlib.suppress(Exception):
                if placed:
                    self._ray.wait([actor.close.remote()], timeout=GONE_S)
            with contextlib.suppress(Exception):
                self._ray.kill(actor)
        return self._lost or self._killed

    def _poll(self) -> list[tuple[str, Any]]:
        found: list[tuple[str, Any]] = self._answer(self._actor.poll.remote(POLL_S), GONE_S)
        return found

    def _answer(self, reference: Any, within_s: float, *, waiting_for: str = "") -> Any:
        """Return an actor's answer; raise when the actor or its node is lost, or the run is over."""
        deadline = time.monotonic() + within_s
        try:
            while not self._ray.wait([reference], timeout=0.2)[0]:
                if self._closing.is_set():
                    raise ClosingError
                if waiting_for and self._placed_workers:
                    deadline = time.monotonic() + within_s
                if time.monotonic() > deadline:
                    if waiting_for:
                        raise UnavailableError(
                            f"no {waiting_for} ({self._executor.resources}) for {within_s:g} s; the cluster has "
                            f"{self._ray.cluster_resources()}; ask for less with {self._executor.option}, or add nodes"
                        )
                    self._lost = True
                    raise WorkerDiedError(f"its node did not answer for {within_s:g} s")
            return self._ray.get(reference)
        except self._ray.exceptions.RayActorError as error:
            self._lost = True
            raise WorkerDiedError(f"its node or its actor was lost: {str(error).strip().splitlines()[0]}") from None
        except self._ray.exceptions.RayError as error:
            self._lost = True
            raise WorkerDiedError(f"Ray: {str(error).strip().splitlines()[-1]}") from None

    def _raise_for(self, kind: str, content: Any) -> None:
        if kind == "failed":
            raise_for_code(*content)
        message, self._killed = content
        raise WorkerDiedError(message)
