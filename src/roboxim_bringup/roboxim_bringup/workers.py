"""Episodes on several processes: each worker is a whole graph in a namespace of its own.

Results do not depend on the number of workers: an episode is a function of its index, and a worker gets one index at a
time.

Non-obvious:
- A worker that is started again gets a *new* namespace. The dead one's services stay visible until their lease runs
  out, and a goal sent to them would never be answered.
- Each worker has a thread here, which starts its process and lives as long as the pool: the kernel kills a child when
  the *thread* that started it ends.
"""

from __future__ import annotations

import itertools
import os
import queue
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from roboxim_bringup.graph import GraphConfig, PolicyLaunch
from roboxim_bringup.process import describe_exit, spawn, stop
from roboxim_core.config import to_json
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ErrorCode, RoboximError, UnavailableError, raise_for_code

MAX_TRIES = 3
"""Workers that an index may cost before it is reported as an error."""
READY_S = 300.0
"""Longest start of a worker [s]; a policy may compile."""
WORKER_DIED = "worker_died"
"""Reason of an episode that cost all its tries; going on with the run tries it again."""
STALL_S = 300.0
"""A worker that reports nothing for so long counts as dead [s]."""
WORKER_FAULTS = {ErrorCode.UNAVAILABLE, ErrorCode.TIMEOUT, ErrorCode.POLICY_DIED}
"""Errors of a worker's own graph, which a fresh worker cures; all others end the run."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a worker is doing."""

    worker: int
    """Which worker, from 0."""
    index: int
    """Index of the episode in the run."""
    episode_id: str
    """Episode, attempt included; empty until its first tick."""
    seq: int
    """Tick."""
    note: str = ""
    """Something that the user should know, e.g. that a worker is started again."""


class _WorkerDied(Exception):
    """The worker's process ended, or its graph is beyond use."""


@dataclass(frozen=True)
class _Job:
    config: RunConfig
    index: int
    progress: Callable[[Progress], None]
    before_retry: Callable[[int], None]


class WorkerPool:
    """Worker processes that run episodes. A context manager.

    Must be used in a process whose environment names the domain (`roboxim_ros.runs.Run.join`), or given one.
    """

    def __init__(
        self,
        workers: int,
        *,
        domain: int | None = None,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        policies: Sequence[PolicyLaunch] = (),
        log_dir: Path | str | None = None,
    ) -> None:
        """Start the workers; does not wait for them.

        Args:
            workers: How many, >= 1.
            domain: ROS domain; none: the environment's.
            parameters: Parameters by node.
            policies: Policies that every worker serves itself.
            log_dir: Where the workers' output goes, ``worker-<n>.log``; none: a temporary folder.
        """
        from roboxim_ros.clients import Clients
        from roboxim_ros.host import NodeHost

        if domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
        self.graph = GraphConfig(
            parameters={name: dict(values) for name, values in (parameters or {}).items()}, policies=tuple(policies)
        )
        self.log_dir = Path(log_dir) if log_dir else Path(tempfile.mkdtemp(prefix="roboxim-workers-"))
        self.log_dir.mkdir(parents=True, exist_ok=True)
        self.numbers = itertools.count()
        self.jobs: queue.Queue[_Job | None] = queue.Queue()
        self.results: queue.Queue[EpisodeResult | BaseException] = queue.Queue()
        self.closing = threading.Event()
        self._host = NodeHost()
        self.clients = Clients(f"_workers_{os.getpid()}", context=self._host.context)
        self._workers = [_Worker(self, number) for number in range(workers)]
        for worker in self._workers:
            worker.start()

    def run(
        self,
        config: RunConfig,
        indices: Iterable[int],
        *,
        on_progress: Callable[[Progress], None] = lambda _: None,
        before_retry: Callable[[int], None] = lambda _: None,
    ) -> Iterator[EpisodeResult]:
        """Run episodes; yields each result as soon as it is there, in whatever order they finish.

        Leaving the iteration early, by an exception or Ctrl-C, closes the pool: running episodes are lost.

        Args:
            config: How.
            indices: Which.
            on_progress: Called with what a worker does, in other threads.
            before_retry: Called with an index whose worker died, before another one gets it, in other threads: to
                remove what the dead one left.

        Raises:
            RoboximError: When the configuration is wrong, or a graph has a fault that a fresh worker does not cure.
        """
        pending = 0
        for index in indices:
            self.jobs.put(_Job(config, index, on_progress, before_retry))
            pending += 1
        try:
            while pending:
                result = self.results.get()
                if isinstance(result, BaseException):
                    raise result
                pending -= 1
                yield result
        except BaseException:
            self.close()
            raise

    def wait_until_ready(self) -> None:
        """Wait until every worker's graph is up.

        Raises:
            RoboximError: When a worker cannot start.
        """
        for worker in self._workers:
            while not worker.ready.wait(0.1):
                if not self.results.empty():
                    result = self.results.get()
                    self.close()
                    if isinstance(result, BaseException):
                        raise result

    def close(self) -> None:
        """End all workers, whatever they do."""
        if self.closing.is_set():
            return
        self.closing.set()
        for _ in self._workers:
            self.jobs.put(None)
        for worker in self._workers:
            worker.join()
        self.clients.close()
        self._host.close()

    def pids(self) -> list[int]:
        """Return the workers' process ids."""
        return [worker.process.pid for worker in self._workers if worker.process is not None]

    def __enter__(self) -> WorkerPool:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


class _Worker(threading.Thread):
    """The thread of one worker process: starts it, feeds it, starts it again when it dies."""

    def __init__(self, pool: WorkerPool, slot: int) -> None:
        super().__init__(name=f"worker-{slot}", daemon=True)
        self.pool = pool
        self.slot = slot
        self.ready = threading.Event()
        self.process: subprocess.Popen[bytes] | None = None
        self.action: Any = None
        self.log = Path()
        self.heard = 0.0

    def run(self) -> None:
        try:
            self._start_patiently()
            while not self.pool.closing.is_set() and (job := self.pool.jobs.get()) is not None:
                self.pool.results.put(self._do(job))
        except _Closing:
            pass
        except BaseException as error:  # handed to whoever iterates over the results
            self.pool.results.put(error)
        finally:
            self._end()

    def _do(self, job: _Job) -> EpisodeResult:
        for attempt in range(1, MAX_TRIES + 1):
            try:
                if self.process is None:
                    self._start_patiently()
                return self._run_episode(job)
            except _WorkerDied as death:
                self._end()
                again = "starting it again" if attempt < MAX_TRIES else "giving the episode up"
                note = f"worker {self.slot} died at index {job.index} ({death}); {again}"
                job.progress(Progress(worker=self.slot, index=job.index, episode_id="", seq=0, note=note))
                message = str(death)
                job.before_retry(job.index)
        return EpisodeResult(
            episode_id=f"{job.config.purpose}-{job.config.run_seed}-{job.index:05d}",
            index=job.index,
            outcome="error",
            reason=WORKER_DIED,
            message=f"{MAX_TRIES} workers died at it; the last one (its log: {self.log}): {message}",
        )

    def _run_episode(self, job: _Job) -> EpisodeResult:
        from roboxim_interfaces.action import RunEpisodes
        from roboxim_interfaces.msg import RunConfig as RunConfigMsg

        from roboxim_ros.conversions import from_msg, to_msg

        def feedback(message: Any) -> None:
            self.heard = time.monotonic()
            now = message.feedback
            job.progress(Progress(worker=self.slot, index=job.index, episode_id=now.current, seq=now.seq))

        self.heard = time.monotonic()
        goal = RunEpisodes.Goal(config=to_msg(job.config, RunConfigMsg), indices=[job.index])
        try:
            answer = self.action.run(goal, feedback=feedback, timeout_s=float("inf"), check=self._check).result
            raise_for_code(answer.error_code, answer.error_msg)
        except RoboximError as error:
            if error.code in WORKER_FAULTS:
                raise _WorkerDied(str(error)) from None
            raise
        return from_msg(answer.results[0], EpisodeResult)

    def _check(self) -> None:
        """Give up when there is nobody to wait for."""
        if self.pool.closing.is_set():
            raise _Closing
        assert self.process is not None
        if self.process.poll() is not None:
            raise _WorkerDied(self._obituary())
        if time.monotonic() - self.heard > STALL_S:
            raise _WorkerDied(f"nothing heard of it for {STALL_S:g} s")

    def _start_patiently(self) -> None:
        """Start the process; once more if something kills it, but not if it gives an error itself."""
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
        from roboxim_interfaces.action import RunEpisodes

        from roboxim_ros.actions import ActionCall

        number = next(self.pool.numbers)
        config = replace(self.pool.graph, namespace=f"/w{number}")
        self.log = self.pool.log_dir / f"worker-{number}.log"
        with open(self.log, "wb") as output:
            self.process = spawn("roboxim_bringup.worker", [to_json(config)], output=output)
        self.action = ActionCall(self.pool.clients, RunEpisodes, f"{config.namespace}/evaluator/run_episodes")
        deadline = time.monotonic() + READY_S
        while not self.action.is_ready():
            self.heard = time.monotonic()
            self._check()
            if time.monotonic() > deadline:
                raise UnavailableError(f"a worker is not ready after {READY_S:g} s; its log: {self.log}")
            self.pool.closing.wait(0.02)
        self.ready.set()

    def _end(self) -> None:
        """End the process, if there is one."""
        if self.action is not None:
            self.action.close()
            self.action = None
        if self.process is not None:
            stop([self.process], grace_s=3.0)
            self.process = None

    def _obituary(self) -> str:
        assert self.process is not None
        lines = self.log.read_text(errors="replace").strip().splitlines()
        tail = "\n".join(lines[-15:])
        return describe_exit(self.process.returncode) + (f"; the end of {self.log}:\n{tail}" if tail else "")


class _Closing(Exception):
    """The pool is being closed."""
