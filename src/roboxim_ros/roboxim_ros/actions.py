"""Blocking action goals that may be sent from any thread, like the service calls of `roboxim_ros.clients`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.task import Future

from roboxim_core.closing import Closing
from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError
from roboxim_ros.clients import Clients, wait_until

POLL_S = 0.5
"""Time between two checks that a goal's server is still available [s]."""
_STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "canceled",
}


@dataclass(frozen=True, kw_only=True)
class GoalResult:
    """How a goal ended."""

    status: str
    """``succeeded``, ``aborted`` or ``canceled``."""
    result: Any
    """The action's result message."""


class ActionCall(Closing):
    """A client of one action. A context manager."""

    def __init__(self, clients: Clients, action_type: Any, name: str) -> None:
        """Make the client.

        Args:
            clients: Clients whose node and thread to use.
            action_type: Action class.
            name: Action name, relative to the node's namespace.
        """
        self.name = name
        self._clients = clients
        self._client = clients.in_thread(lambda: ActionClient(clients.node, action_type, name))

    def is_ready(self) -> bool:
        """Return whether the action's server is available."""
        return bool(self._client.server_is_ready())

    def run(
        self,
        goal: Any,
        *,
        feedback: Callable[[Any], None] | None = None,
        timeout_s: float = 600.0,
        wait_s: float = 30.0,
        check: Callable[[], None] = lambda: None,
    ) -> GoalResult:
        """Send a goal and wait for its end. An interrupted wait (also by Ctrl-C) cancels the goal.

        Args:
            goal: The goal message.
            feedback: Called with each feedback message, in another thread.
            timeout_s: Longest wait for the result [s].
            wait_s: Longest wait for the server to appear [s].
            check: Called every `POLL_S`; raises to stop waiting.

        Raises:
            UnavailableError: When the server does not appear, or disappears.
            InvalidRequestError: When it rejects the goal.
            RequestTimeoutError: When the result does not come in time.
        """
        if not wait_until(self.is_ready, wait_s):
            raise UnavailableError(f"action '{self.name}' is not available after {wait_s:g} s; is its node running?")
        deadline = time.monotonic() + timeout_s
        handle = self._wait(
            self._clients.in_thread(lambda: self._client.send_goal_async(goal, feedback_callback=feedback)),
            deadline,
            check,
        )
        if not handle.accepted:
            raise InvalidRequestError(f"action '{self.name}' rejected the goal; see its node's log for the reason")
        try:
            answer = self._wait(self._clients.in_thread(handle.get_result_async), deadline, check)
        except BaseException:
            answered = threading.Event()
            self._clients.in_thread(handle.cancel_goal_async).add_done_callback(lambda _: answered.set())
            answered.wait(
                30.0
            )  # a client that leaves before the server receives the cancellation would let the goal run
            raise
        return GoalResult(status=_STATUS.get(answer.status, "aborted"), result=answer.result)

    def _wait(self, future: Future, deadline: float, check: Callable[[], None]) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        while not done.wait(POLL_S):
            check()
            if time.monotonic() > deadline:
                raise RequestTimeoutError(f"action '{self.name}' did not end in time; its node hangs or has died")
            if not self.is_ready():
                raise UnavailableError(f"action '{self.name}' disappeared during the goal; its node has died")
        return future.result()

    def close(self) -> None:
        """Destroy the client."""
        self._clients.in_thread(self._client.destroy)
