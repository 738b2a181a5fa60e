"""A service client whose caller takes the answer from the middleware itself.

rclpy hands an answer to an executor, which runs in another thread and then wakes the caller. In lockstep this hand-over
is a large part of a call's time. Here the calling thread waits only for its own client.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.client import Client
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

SLICE_S = 0.1
"""Longest wait in the middleware [s], so that Python handles signals."""


class _UnservedGroup(MutuallyExclusiveCallbackGroup):
    """A callback group whose entities no executor serves."""

    def can_execute(self, entity: object) -> bool:
        return False


class DirectClient:
    """A client of one service for one caller at a time."""

    def __init__(self, node: Node, srv_type: Any, name: str) -> None:
        """Create the client.

        Args:
            node: Node that it belongs to.
            srv_type: Service class.
            name: Service name, relative to the node's namespace.

        Raises:
            InvalidServiceNameException: When the name is not a valid service name.
        """
        self.client: Client = node.create_client(srv_type, name, callback_group=_UnservedGroup())
        self._wait_set = rclpy_implementation.WaitSet(0, 0, 0, 1, 0, 0, node.context.handle)

    def send(self, request: Any) -> int:
        """Send a request and return its number.

        Raises:
            TypeError: If the request belongs to another service.
        """
        expected = self.client.srv_type.Request
        if not isinstance(request, expected):
            raise TypeError(f"{self.client.service_name} takes a {expected}, got a {type(request)}")
        with self.client.handle:
            return int(self.client.handle.send_request(request))

    def receive(self, number: int, timeout_s: float) -> Any | None:
        """Wait for the answer to a request; drop answers to earlier requests, whose callers gave up.

        Args:
            number: Number of the request, from `send`.
            timeout_s: Longest wait [s].

        Returns:
            The answer; None if it did not arrive in time.
        """
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0.0:
            with self.client.handle:
                self._wait_set.clear_entities()
                self._wait_set.add_client(self.client.handle)
                self._wait_set.wait(int(1e9 * min(SLICE_S, left)))
                header, answer = self.client.handle.take_response(self.client.srv_type.Response)
            if header is not None and header.request_id.sequence_number == number:
                return answer
        return None
