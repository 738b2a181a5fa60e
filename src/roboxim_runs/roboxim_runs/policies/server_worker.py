"""A worker whose only job is to serve a policy to the simulators of a run, until it is ended."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from typing import Any

from roboxim_bringup.graph import PolicyLaunch
from roboxim_core.config import from_plain, to_plain
from roboxim_policies.base import load_policy
from roboxim_policies.serving.shared import SharedServer, SharedSessions
from roboxim_runs.executors.ray_worker import NODE_ADDRESS

POLICY_KEY = "ROBOXIM_POLICY_KEY"
"""Environment variable with the key that the simulators of a run share with its policy servers."""
BEAT_S = 5.0
"""Time between two signs of life [s]."""


class PolicyServerWorker:
    """Serves a policy."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Load the policy and listen.

        Args:
            settings: ``launch``, a `PolicyLaunch` as plain data.
            number: The worker's number.

        Raises:
            ConfigError: When the policy does not exist, does not take its options, or is privileged.
            PolicyError: When the policy raises.
            UnavailableError: When the address is not one of this machine.
        """
        launch = from_plain(settings["launch"], PolicyLaunch)

        def log(text: str) -> None:
            print(text, flush=True)  # noqa: T201 - the worker's log

        sessions = SharedSessions(lambda: load_policy(launch.spec, **launch.options), log=log)
        host = os.environ.get(NODE_ADDRESS) or "127.0.0.1"  # on this machine alone, no other user can connect
        self._server = SharedServer(sessions, key=os.environ[POLICY_KEY], host=host, port=0, log=log)
        self._server.__enter__()

    def run(self, job: Any, note: Callable[[Any], None]) -> None:
        """Serve until the process is ended; see `Worker.run`. The first note has the address and the description."""
        note({"url": self._server.url, "description": to_plain(self._server.sessions.description)})
        forever = threading.Event()
        while not forever.wait(BEAT_S):
            note(None)

    def close(self) -> None:
        """Stop serving."""
        self._server.__exit__()
