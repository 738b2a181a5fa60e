"""The worker for runs of episodes: a graph in this process that runs one episode at a time."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any

from roboxim_bringup.graph import GraphConfig, start_graph
from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.episode.records import POLICY_DIED
from roboxim_core.errors import ErrorCode, RoboximError, UnavailableError
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.local.episodes import RUN_EPISODES
from roboxim_runs.episodes.staging import Staging
from roboxim_runs.executors.protocol import WorkerBrokenError
from roboxim_runs.policies.waiting import Retries
from roboxim_runs.storage.folder import EPISODE_MARK, RunFolder

LOOK_S = 0.5
"""Time between two looks whether the graph is alive [s]."""
ENDING_S = 3.0
"""Longest wait for an episode that is given up to end its tick [s]."""
STALL_S = 300.0
"""A graph that is silent for this time counts as broken [s]."""
WORKER_FAULTS = {ErrorCode.UNAVAILABLE, ErrorCode.TIMEOUT, ErrorCode.POLICY_DIED}
"""Errors of a worker's own graph, which a new worker recovers from; all other errors end the run."""


class EpisodeWorker:
    """Runs episodes on its own graph, in the namespace ``/w<number>``."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Start the graph; returns when it serves.

        Args:
            settings: ``graph``, a `GraphConfig`, ``config``, a `RunConfig`, ``staging``, see `Staging`,
                ``served``, whether the policy is behind a server of the run, and ``server_wait_s``, the longest wait
                for any other policy that is away, as plain data.
            number: The worker's number.

        Raises:
            RoboximError: When a node cannot be made.
        """
        graph = replace(from_plain(settings["graph"], GraphConfig), namespace=f"/w{number}")
        config = from_plain(settings["config"], RunConfig)
        self._staging = Staging.of(settings.get("staging"), config.output_dir, number)
        if self._staging is not None:
            config = replace(config, output_dir=str(self._staging.folder))
            graph = self._staging.recording(graph)
        self._config = config
        self._served = bool(settings.get("served"))
        self._wait_s = float(settings.get("server_wait_s", 0.0))
        self._alive_at = time.monotonic()
        self._host = NodeHost()
        self._episodes = ThreadPoolExecutor(1, "episodes")
        try:
            start_graph(self._host, **vars(graph))
            self._clients = Clients("worker", context=self._host.context, namespace=graph.namespace)
        except BaseException:
            self._host.close()
            raise

    def run(self, job: int, note: Callable[[Any], None]) -> dict[str, Any]:
        """Run the episode of an index, again if the policy's server was away; see `Worker.run`.

        Raises:
            UnavailableError: When the server stays away.
        """
        retries = Retries(self._wait_s)
        while (result := self._tried(job, note)).reason == POLICY_DIED:
            self._check()
            if self._served:
                raise WorkerBrokenError(f"its policy server was lost: {result.message}")
            pause_s = retries.lost(result)
            note({"index": job, "waiting": retries.text(result)})
            self._pause(pause_s)
            RunFolder(self._config.output_dir).discard([job])
        if retries.tried:
            note({"index": job, "waiting": ""})
        plain: dict[str, Any] = to_plain(result)
        return plain if self._staging is None else {"result": plain, **self._staging.handed_over()}

    def _pause(self, seconds: float) -> None:
        """Wait, and watch over the graph meanwhile."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(left, LOOK_S))
            self._alive_at = time.monotonic()
            self._check()

    def _tried(self, job: int, note: Callable[[Any], None]) -> EpisodeResult:
        """Run the episode of an index once."""

        def alive(episode: str, seq: int) -> None:
            self._alive_at = time.monotonic()
            note({"index": job, "episode_id": episode, "seq": seq})

        self._alive_at = time.monotonic()
        try:
            return self._result(job, alive)
        except RoboximError as error:
            if error.code in WORKER_FAULTS:
                raise WorkerBrokenError(str(error)) from None
            raise

    def _result(self, job: int, alive: Callable[[str, int], None]) -> EpisodeResult:
        """Run the episode in the thread of episodes, and watch over the graph meanwhile."""
        given_up = threading.Event()
        try:
            found = self._episodes.submit(self._episode, job, alive, given_up)
            while not wait([found], LOOK_S).done:
                self._check()
        except BaseException:
            given_up.set()
            raise
        return found.result()

    def _episode(self, job: int, alive: Callable[[str, int], None], given_up: threading.Event) -> EpisodeResult:
        sys.stdout.write(f"{EPISODE_MARK.format(job)}\n")  # into the worker's log, before what the policy prints
        sys.stdout.flush()
        call = self._clients.send_local(RUN_EPISODES, self._config, [job], alive, given_up.is_set)
        if call is None:
            raise UnavailableError("the worker's own evaluator has ended")
        results: list[EpisodeResult] = self._clients.value_of(call, RUN_EPISODES, 0.0)  # it ran in this thread
        return results[0]

    def _check(self) -> None:
        """Raise when the graph can no longer answer."""
        if not self._host.alive():
            raise WorkerBrokenError(f"node {', '.join(self._host.dead())} has died; its traceback is in the log")
        if time.monotonic() - self._alive_at > STALL_S:
            raise WorkerBrokenError(f"no message from its graph for {STALL_S:g} s")

    def close(self) -> None:
        """End the graph; an episode that is given up ends its tick before, unless that takes long."""
        idle = self._episodes.submit(lambda: None)
        self._episodes.shutdown(wait=False)
        wait([idle], ENDING_S)
        self._clients.close()
        self._host.close()
        if self._staging is not None:
            self._staging.close()
