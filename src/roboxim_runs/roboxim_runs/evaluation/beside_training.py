"""Evaluations inside the user's own training loop: `Evaluator` keeps workers warm between calls.

A worker is a process with simulator, renderer and planner, without nodes. The policy stays in the user's process: a
worker sends what it observes and waits for the actions, so a model on a GPU needs no copy and no checkpoint. The
episodes are those that ``evaluate`` would give for the purpose and the seed.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from roboxim_bringup.process import spawn, stop
from roboxim_core.closing import Closing
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, EvaluationError, PolicyError, UnavailableError, one_of
from roboxim_core.policies import ActionChunk, Policy, PolicyDescription
from roboxim_core.policy_guard import checked_answer
from roboxim_eval.statistics.rates import SuccessRate, error_line, is_measured, rate_of
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.rendering import RENDERERS

PURPOSES = ("train", "eval", "test")
WORKER = "roboxim_runs.evaluation.beside_worker"


@dataclass(frozen=True, kw_only=True)
class Score:
    """Result of an evaluation inside a training."""

    episodes: tuple[EpisodeResult, ...]
    """Results, by index."""
    seconds: float
    """Wall time [s]."""

    @property
    def successes(self) -> int:
        """Number of episodes that succeeded."""
        return sum(episode.outcome == "success" for episode in self.episodes)

    @property
    def errors(self) -> int:
        """Number of episodes that ended in an error, e.g. an action that is not finite; they are no successes."""
        return sum(episode.outcome == "error" for episode in self.episodes)

    @property
    def rate(self) -> SuccessRate:
        """Success rate with its 95 % interval; errors count as failures."""
        return rate_of(self.episodes)

    def __str__(self) -> str:
        """Say it in one line."""
        success = f"success {self.successes} of {len(self.episodes)}, {self.seconds:.0f} s"
        return "; ".join(filter(None, (success, error_line(self.episodes))))


@dataclass
class _Worker:
    """A worker, with the policy that acts in its episodes."""

    process: subprocess.Popen[bytes]
    connection: Connection[Any, Any]
    policy: Policy | None = None
    description: PolicyDescription | None = None
    index: int | None = None

    def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            UnavailableError: When the worker has died.
        """
        try:
            self.connection.send(message)
        except (BrokenPipeError, ConnectionResetError):
            raise self.died() from None

    def died(self) -> UnavailableError:
        """Return the error that says so."""
        return UnavailableError(
            f"a worker of the evaluator has died (exit code {self.process.poll()}) in episode {self.index}; its last "
            "words are above"
        )


class Evaluator(Closing):
    """Evaluates the policy of a training that is running; a context manager.

    Non-obvious:

    - Scenes have the purpose ``train``: choosing a checkpoint by them does not use up the scenes of ``evaluate``.
      Each call has the same scenes, so that its numbers can be compared with those of the call before.
    - The first call starts the workers, which takes some seconds; the later ones find them warm.
    - An exception of the policy is raised unchanged, and ends the workers; the next call starts new ones.
    - An episode whose policy answers something invalid, e.g. NaN, ends in an error; when most do, the call raises.
    """

    def __init__(
        self, task: str = "", *, episodes: int = 20, workers: int = 2, size: int = 128, seed: int = 0,
        purpose: str = "train", max_steps: int = 0, renderer: str = "raster",
    ) -> None:  # fmt: skip
        """Read the task; nothing is started yet.

        Args:
            task: Task of ``config/tasks``, or a YAML file; empty: the default task.
            episodes: Number of episodes of each call.
            workers: Number of processes, each with about 0.6 GB.
            size: Side of the pictures [px].
            seed: Seed of the scenes.
            purpose: ``train``, ``eval`` or ``test``: scenes of different purposes are never the same.
            max_steps: Actions per episode; 0: as the task says.
            renderer: ``raster`` (needs EGL) or ``tiny``.

        Raises:
            ConfigError: When there is no such task, purpose or renderer, or a number is below 1.
        """
        if purpose not in PURPOSES:
            raise ConfigError(f"unknown purpose '{purpose}'; {one_of(PURPOSES, purpose)}")
        RENDERERS[renderer]
        if min(episodes, workers, size) < 1:
            raise ConfigError(f"episodes, workers and size must be >= 1, got {episodes}, {workers}, {size}")
        self._config = RunConfig(
            run_seed=seed, purpose=purpose, task_config=task_text(task), image_width=size, image_height=size,
            max_steps=max_steps,
        )  # fmt: skip
        self._episodes, self._count, self._renderer = episodes, min(workers, episodes), renderer
        self._workers: list[_Worker] = []

    def __call__(self, make: Callable[[], Policy]) -> Score:
        """Evaluate a policy in all episodes.

        Args:
            make: Makes the policy, once for each worker, e.g. ``lambda: MyPolicy(model)``: each plays another episode
                at the same time, so each needs its own memory. They may share the model.

        Raises:
            EvaluationError: When most episodes ended in errors, so that the policy is not measured.
            UnavailableError: When a worker has died.
            Exception: What the policy has raised.
        """
        began = time.monotonic()
        try:
            self._start()
            waiting, found = list(range(self._episodes)), dict[int, EpisodeResult]()
            for worker in self._workers:
                worker.policy = make()
                worker.description = worker.policy.describe()
                worker.send(("policy", worker.description))
                self._next(worker, waiting)
            while len(found) < self._episodes:
                for connection in wait([worker.connection for worker in self._workers], timeout=1.0):
                    worker = next(worker for worker in self._workers if worker.connection is connection)
                    if (result := self._answer(worker)) is not None:
                        found[result[0]] = result[1]
                        self._next(worker, waiting)
        except BaseException:
            self.close()
            raise
        score = Score(episodes=tuple(found[i] for i in range(self._episodes)), seconds=time.monotonic() - began)
        if not is_measured(score.episodes):
            first = next(episode for episode in score.episodes if episode.outcome == "error")
            raise EvaluationError(f"{error_line(score.episodes)}. The first, episode {first.index}: {first.message}")
        return score

    def _start(self) -> None:
        """Start the workers, unless they run."""
        while len(self._workers) < self._count:
            here, there = socket.socketpair()
            with there:
                process = spawn(WORKER, [str(there.fileno()), self._renderer], pass_fds=(there.fileno(),))
            self._workers.append(_Worker(process, Connection(here.detach())))
            self._workers[-1].send(self._config)

    @staticmethod
    def _next(worker: _Worker, waiting: list[int]) -> None:
        """Give a worker its next episode, if there is one."""
        worker.index = waiting.pop(0) if waiting else None
        if worker.index is not None:
            worker.send(("episode", worker.index))

    @staticmethod
    def _answer(worker: _Worker) -> tuple[int, EpisodeResult] | None:
        """Answer what a worker asks; return its episode's result, if that is what it says."""
        assert worker.policy is not None
        assert worker.description is not None
        try:
            kind, value = worker.connection.recv()
        except (EOFError, OSError):
            raise worker.died() from None
        if kind == "result":
            assert worker.index is not None
            return worker.index, value
        if kind == "reset":
            worker.policy.reset(value)
            worker.send(None)
        else:
            worker.send(_readable(worker.policy.act(value), worker.description))
        return None

    def close(self) -> None:
        """End the workers; a later call starts new ones."""
        stop(worker.process for worker in self._workers)
        for worker in self._workers:
            with contextlib.suppress(OSError):
                worker.connection.close()
        self._workers = []


def _readable(answer: Any, description: PolicyDescription) -> ActionChunk | PolicyError:
    """Return what a worker can read of a policy's answer, e.g. of a tensor of this process, or why it is invalid."""
    try:
        return checked_answer(answer, description)
    except PolicyError as error:
        return PolicyError(f"policy '{description.name}': {error}", error.code)
