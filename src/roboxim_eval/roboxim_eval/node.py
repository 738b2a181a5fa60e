"""The evaluator node: runs the episode loop over the graph."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from roboxim_interfaces.action import RunEpisodes as RunEpisodesAction
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg
from roboxim_interfaces.srv import RunEpisodes as RunEpisodesService

from roboxim_core import limits
from roboxim_core.episode import EpisodeResult, EpisodeRunner, Ports, RunConfig
from roboxim_core.errors import ErrorCode, EvaluationError, RequestTimeoutError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_eval.ports import RosPorts
from roboxim_ros.local.episodes import RUN_EPISODES
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.node import RoboximNode, ended, parameter

FEEDBACK_PERIOD_S = 0.2
ENDING_S = 60.0
"""Longest wait of a new run for a cancelled run to end its tick; then the new run is rejected [s]."""
VERSIONED = ("roboxim", "numpy", "scipy", "pybullet", "pin", "ompl", "ruckig", "moderngl", "ros-rclpy")

FORK = "pybullet-arm64"
"""PyBullet's maintained fork, which brings the same module where PyBullet has no wheel: from Python 3.12 on."""


@cache
def versions() -> dict[str, str]:
    """Return package to version, for the packages that an episode's bytes depend on; do not change it."""
    installed = {distribution.name: distribution.version for distribution in metadata.distributions()}
    found = {name: installed.get(name, "absent") for name in VERSIONED}
    if found["pybullet"] == "absent" and FORK in installed:
        found["pybullet"] = f"{installed[FORK]} ({FORK})"
    return found


@dataclass(frozen=True, kw_only=True)
class EvaluatorConfig:
    """Parameters of the evaluator node."""

    service_timeout_s: float = parameter(
        limits.WALL_TIME_S, "wall-clock limit of the service, which cannot be cancelled; the action has none [s]",
        0.001, limits.WALL_TIME_S,
    )  # fmt: skip
    """Longest run of the service [s]."""


class EvaluatorNode(RoboximNode):
    """Serves ``evaluator/run_episodes`` as an action and as a blocking service; one run at a time.

    Callers of its process may run episodes in their own thread (`roboxim_ros.local.episodes`).
    """

    executor_threads = 3
    """Number of threads: a run blocks its callback, and cancelling it needs another thread."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Make the node; see `RoboximNode`."""
        super().__init__("evaluator", context=context, namespace=namespace, parameters=parameters)
        self._config = self.declare_config(EvaluatorConfig)
        self._busy = threading.Lock()
        self._goal: ServerGoalHandle | None = None
        self._ports: RosPorts | None = None
        self._runner: EpisodeRunner | None = None
        self.offer(RUN_EPISODES, self.run_episodes, inline=True)
        group = MutuallyExclusiveCallbackGroup()
        self.serve(RunEpisodesService, "evaluator/run_episodes", self._on_service, callback_group=group)
        self._action = self.serve_action(
            RunEpisodesAction, "evaluator/run_episodes", self._on_action, callback_group=ReentrantCallbackGroup()
        )

    def destroy_node(self) -> None:
        """Destroy the node and its clients."""
        self._drop_ports()
        self._action.destroy()
        super().destroy_node()

    def _on_service(self, request: RunEpisodesService.Request, response: RunEpisodesService.Response) -> None:
        limits.require_count("episodes of the service", len(request.indices), limits.SERVICE_EPISODES)
        deadline = time.monotonic() + self._config.service_timeout_s

        def over() -> bool:
            return time.monotonic() > deadline or not self.context.ok()

        try:
            for result in self._run(_config_of(request), request.indices, over):
                response.results = [*response.results, to_msg(result, EpisodeResultMsg)]
        except RoboximError as error:
            if error.code != ErrorCode.CANCELLED or time.monotonic() <= deadline:
                raise
            raise RequestTimeoutError(
                f"ended after {self._config.service_timeout_s:g} s (parameter service_timeout_s) with "
                f"{len(response.results)} of {len(request.indices)} episodes; the action of this name has no limit"
            ) from None

    def _on_action(self, goal: ServerGoalHandle) -> RunEpisodesAction.Result:
        result = RunEpisodesAction.Result()
        feedback = RunEpisodesAction.Feedback(total=len(goal.request.indices))

        def progress(current: str, seq: int) -> None:
            feedback.current, feedback.seq = current, seq
            goal.publish_feedback(feedback)

        cancelled = self._with_progress(progress, lambda: bool(goal.is_cancel_requested))
        with self.answering("evaluator/run_episodes", result):
            for episode in self._run(_config_of(goal.request), goal.request.indices, cancelled, goal):
                message = to_msg(episode, EpisodeResultMsg)
                result.results = [*result.results, message]
                feedback.done, feedback.finished, feedback.current = len(result.results), [message], episode.episode_id
                goal.publish_feedback(feedback)
                feedback.finished = []
        return ended(goal, result)

    def run_episodes(
        self,
        config: RunConfig,
        indices: Sequence[int],
        progress: Callable[[str, int], None],
        cancelled: Callable[[], bool],
    ) -> list[EpisodeResult]:
        """Run episodes in the thread of the caller.

        Args:
            config: Configuration of the run.
            indices: Indices of the episodes.
            progress: Called with the id and the tick of the running episode every `FEEDBACK_PERIOD_S`, between ticks.
            cancelled: Called before every tick; True cancels the run.

        Raises:
            EvaluationError: When another run is active.
            RoboximError: See `EpisodeRunner.run_index`.
        """
        return list(self._run(config, indices, self._with_progress(progress, cancelled)))

    def _with_progress(self, progress: Callable[[str, int], None], cancelled: Callable[[], bool]) -> Callable[[], bool]:
        """Return a function that returns whether to cancel, and reports the progress of the run from time to time."""
        last = 0.0

        def look() -> bool:
            nonlocal last
            if self._runner is not None and time.monotonic() - last > FEEDBACK_PERIOD_S:
                last = time.monotonic()
                progress(*self._runner.progress)
            return cancelled() or not self.context.ok()

        return look

    def _run(
        self,
        config: RunConfig,
        indices: Sequence[int],
        cancelled: Callable[[], bool],
        goal: ServerGoalHandle | None = None,
    ) -> Iterator[EpisodeResult]:
        ending = (running := self._goal) is not None and running.is_cancel_requested
        if not self._busy.acquire(timeout=ENDING_S if ending else 0):
            raise EvaluationError("the evaluator is already running episodes; wait for them or cancel them")
        self._goal = goal
        try:
            self._runner = EpisodeRunner(self._make_ports(config), config, versions=versions(), library=ModelLibrary())
            for index in indices:
                yield self._runner.run_index(int(index), cancelled=cancelled)
        except RoboximError as error:
            if error.code != ErrorCode.CANCELLED:
                self._drop_ports()
            raise
        finally:
            self._runner = None
            self._goal = None
            self._busy.release()

    def _make_ports(self, config: RunConfig) -> Ports:
        if self._ports is None:
            self._ports = RosPorts(self.context, self.get_namespace())
        actor, recorder = self._ports.for_run(
            config.actor, config.policy_timeout_s or RunConfig.policy_timeout_s, config.output_dir
        )
        return Ports(
            scenes=self._ports.tasks, sim=self._ports.sim, actor=actor, judge=self._ports.tasks, recorder=recorder,
            clock=time.monotonic,
        )  # fmt: skip

    def _drop_ports(self) -> None:
        """Close the clients, so that the next run creates new ones: after a fault a peer may be gone."""
        if self._ports is not None:
            self._ports.close()
            self._ports = None


def _config_of(request: Any) -> RunConfig:
    """Return the configuration in a request; an empty ``keep`` keeps every episode.

    Raises:
        InvalidRequestError: When a value is out of range or unknown.
    """
    request.config.keep = request.config.keep or "all"
    return from_msg(request.config, RunConfig)
