"""The worker for runs of episodes: a whole graph in this process that runs one episode at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from roboxim_interfaces.action import RunEpisodes
from roboxim_interfaces.msg import RunConfig as RunConfigMsg

from roboxim_bringup.executors.protocol import WorkerBrokenError
from roboxim_bringup.graph import GraphConfig, start_graph
from roboxim_bringup.runs.staging import Staging
from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ErrorCode, RoboximError, UnavailableError, raise_for_code
from roboxim_ros.actions import ActionCall
from roboxim_ros.clients import Clients
from roboxim_ros.conversions import from_msg, to_msg
from roboxim_ros.host import NodeHost

READY_S = 60.0
"""Longest wait for the graph's own evaluator [s]."""
STALL_S = 300.0
"""A graph that is silent for this time counts as broken [s]."""
WORKER_FAULTS = {ErrorCode.UNAVAILABLE, ErrorCode.TIMEOUT, ErrorCode.POLICY_DIED}
"""Errors of a worker's own graph, which a new worker recovers from; all other errors end the run."""


class EpisodeWorker:
    """Runs episodes on its own graph, in the namespace ``/w<number>``."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Start the graph; returns when it serves.

        Args:
            settings: ``graph``, a `GraphConfig`, ``config``, a `RunConfig`, ``staging``, see `Staging`, and
                ``served``, whether the policy is behind a server of the run, as plain data.
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
        self._heard = time.monotonic()
        self._host = NodeHost()
        try:
            start_graph(self._host, **vars(graph))
            self._clients = Clients("worker", context=self._host.context, namespace=graph.namespace)
            self._action = ActionCall(self._clients, RunEpisodes, "evaluator/run_episodes")
            deadline = time.monotonic() + READY_S
            while not self._action.is_ready():
                if time.monotonic() > deadline:
                    raise UnavailableError(f"the worker's own evaluator does not serve after {READY_S:g} s")
                time.sleep(0.01)
        except BaseException:
            self._host.close()
            raise

    def run(self, job: int, note: Callable[[Any], None]) -> dict[str, Any]:
        """Run the episode of an index; see `Worker.run`."""

        def hear(message: Any) -> None:
            self._heard = time.monotonic()
            now = message.feedback
            note({"index": job, "episode_id": now.current, "seq": int(now.seq)})

        self._heard = time.monotonic()
        goal = RunEpisodes.Goal(config=to_msg(self._config, RunConfigMsg), indices=[job])
        try:
            answer = self._action.run(goal, feedback=hear, timeout_s=float("inf"), check=self._check).result
            raise_for_code(answer.error_code, answer.error_msg)
        except RoboximError as error:
            if error.code in WORKER_FAULTS:
                raise WorkerBrokenError(str(error)) from None
            raise
        result: dict[str, Any] = to_plain(from_msg(answer.results[0], EpisodeResult))
        if self._served and result["reason"] == ErrorCode.POLICY_DIED.name.lower():
            raise WorkerBrokenError(f"its policy server was lost: {result['message']}")
        return result if self._staging is None else {"result": result, **self._staging.handed_over()}

    def _check(self) -> None:
        """Raise when the graph can no longer answer."""
        if not self._host.alive():
            raise WorkerBrokenError(f"node {', '.join(self._host.dead())} has died; its traceback is in the log")
        if time.monotonic() - self._heard > STALL_S:
            raise WorkerBrokenError(f"no message from its graph for {STALL_S:g} s")

    def close(self) -> None:
        """End the graph."""
        self._action.close()
        self._clients.close()
        self._host.close()
        if self._staging is not None:
            self._staging.close()
