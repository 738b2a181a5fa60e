"""Policies that separate processes serve to all simulators of a run, on any machine.

A server is a job that does not end: the executor places it and restarts it when it dies, like any worker. A simulator
that loses its server gives its episode up; the worker that repeats the episode receives the new address.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from typing import Any

from roboxim_bringup.graph import PolicyLaunch
from roboxim_core.config import to_plain
from roboxim_core.errors import UnavailableError
from roboxim_runs.events import Event, Notice, OnEvent
from roboxim_runs.executors import CancelledError, Executor, Job, Lost, Note, Work
from roboxim_runs.executors.pool import ClosingError
from roboxim_runs.policies.server_worker import POLICY_KEY

SERVED = "roboxim_policies.served:ServedPolicy"
STABLE_S = 600.0
"""A server that served for so long before it died may die again; one that dies at once three times ends the run [s]."""
SHARE_OF_TIMEOUT = 0.75
"""Deadline of an answer, as a share of the evaluator's: so a late server is named."""


@dataclass(frozen=True, kw_only=True)
class _Serving:
    """Where a server is."""

    url: str
    description: dict[str, Any]


def behind_server(work: Work, url: str, description: Mapping[str, Any], key: str) -> Work:
    """Return the work of an episode worker whose policy is behind a server.

    Args:
        work: The work, whose graph has the policy itself.
        url: Address of the server.
        description: The policy's `PolicyDescription` as plain data.
        key: The server's key.
    """
    graph = work.settings["graph"]
    options = {
        "url": url, "description": description, "key_env": POLICY_KEY,
        "timeout_s": SHARE_OF_TIMEOUT * work.settings["config"]["policy_timeout_s"],
    }  # fmt: skip
    launches = [{**launch, "spec": SERVED, "options": options} for launch in graph["policies"]]
    return replace(
        work,
        settings={**work.settings, "graph": {**graph, "policies": launches}, "served": True},
        environment={**work.environment, POLICY_KEY: key},
    )


class PolicyServers:
    """Servers of one policy. A context manager, at whose end they end."""

    def __init__(self, name: str, launch: PolicyLaunch, executors: Sequence[Executor]) -> None:
        """Store what to serve.

        Args:
            name: Name of the policy, for messages.
            launch: The policy.
            executors: One for each server.
        """
        self._name, self._launch, self._executors = name, launch, executors
        self._key = secrets.token_urlsafe(24)
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._serving: list[_Serving | None] = [None] * len(executors)
        self._error: BaseException | None = None
        self._notices: list[str] = []
        self._threads: list[threading.Thread] = []
        self._stack = ExitStack()

    def __enter__(self) -> PolicyServers:
        """Start the servers; they are ready later, see `prepared`."""
        for executor in self._executors:
            if isinstance(executor, AbstractContextManager):
                self._stack.enter_context(executor)
        for number in range(len(self._executors)):
            thread = threading.Thread(target=self._keep, args=(number,), name=f"policy-server-{number}", daemon=True)
            self._threads.append(thread)
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the servers."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._stack.close()

    def with_notices(self, on_event: OnEvent) -> OnEvent:
        """Return a receiver of events that also receives, in its own thread, what happened to the servers."""

        def receive(event: Event) -> None:
            while self._notices:
                on_event(Notice(text=self._notices.pop(0)))
            on_event(event)

        return receive

    def prepared(self, work: Work, number: int, closing: threading.Event) -> Work:
        """Return the work of an episode worker whose policy is behind a server; waits for one.

        Args:
            work: The work, whose graph has the policy itself.
            number: Number of the worker. Workers are spread over the servers by it.
            closing: Ends the wait.

        Raises:
            ClosingError: When the run is over.
            RoboximError: When the servers cannot run.
        """
        serving = self._wait(number, closing)
        return behind_server(work, serving.url, serving.description, self._key)

    def _wait(self, number: int, closing: threading.Event) -> _Serving:
        with self._changed:
            while True:
                if self._error is not None:
                    raise self._error
                turn = number % len(self._serving)
                for serving in (*self._serving[turn:], *self._serving[:turn]):
                    if serving is not None:
                        return serving
                self._changed.wait(0.1)
                if closing.is_set():
                    raise ClosingError

    # -------------------------------------------------------------- one server

    def _keep(self, number: int) -> None:
        """Keep a server running until the run is over."""
        title = f"the server of policy '{self._name}'"
        work = Work(
            worker="roboxim_runs.policies.server_worker:PolicyServerWorker",
            settings={"launch": to_plain(self._launch)}, environment={POLICY_KEY: self._key},
        )  # fmt: skip
        try:
            while True:
                began = time.monotonic()
                (outcome,) = self._executors[number].run(
                    work, [Job(key=title)], on_note=lambda note: self._receive(number, note),
                    before_retry=lambda _: self._set(number, None), cancellation=self._stop,
                )  # fmt: skip
                self._set(number, None)
                if isinstance(outcome, Lost) and time.monotonic() - began < STABLE_S:
                    raise UnavailableError(f"{title} cannot run: {outcome.message}")
        except CancelledError:
            pass
        except BaseException as error:  # raised in the threads that wait for a server
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _receive(self, number: int, note: Note) -> None:
        if note.text:
            self._notices.append(note.text)
        elif isinstance(note.data, dict) and "url" in note.data:
            self._set(number, _Serving(**note.data))

    def _set(self, number: int, serving: _Serving | None) -> None:
        with self._changed:
            self._serving[number] = serving
            self._changed.notify_all()
