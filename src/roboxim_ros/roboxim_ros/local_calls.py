"""Calls of the services of a tick between nodes of one process, without the middleware.

A service that is created with ``lockstep=True`` is offered to the middleware and here. A caller of the same process
gives the request object to the thread that spins the server, and gets the response object. Nothing is serialised, and
no wait set is built. Neither side may change a message that it has handed over, and handlers must set only values that
could be serialised: nothing else checks them on this way. The server needs a `LockstepExecutor`.

Other services are registered here too: the server may be waiting for the next tick, so a caller of the same process
makes it look at the middleware.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.node import Node

from roboxim_ros.lockstep_executor import LockstepExecutor

_services: weakref.WeakKeyDictionary[Context, dict[str, LocalService]] = weakref.WeakKeyDictionary()
_lock = threading.Lock()


class LocalService:
    """A service of a node of this process."""

    def __init__(self, node: Node, srv_type: Any, handler: Callable[[Any, Any], Any], *, lockstep: bool) -> None:
        """Describe it.

        Args:
            node: The node that serves.
            srv_type: Service class.
            handler: Called with (request, response) in the node's thread; returns the response and raises nothing. Not
                a coroutine function, if the service is called in lockstep.
            lockstep: Whether it is called without the middleware.
        """
        self._node, self._lockstep = weakref.ref(node), lockstep
        self.srv_type, self.handler = srv_type, handler
        self.open = True
        """Whether the node still serves."""

    def send(self, request: Any) -> LocalCall | None:
        """Hand a request over; None when the service must be called through the middleware.

        Raises:
            TypeError: If the request belongs to another service.
        """
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"expected a {self.srv_type.Request}, got a {type(request)}")
        executor = self._executor() if self._lockstep else None
        if executor is None:
            return None
        call = LocalCall(self, request)
        return call if executor.post(call) else None

    def look(self) -> None:
        """Make the server look at the middleware, where a request has been sent to."""
        executor = self._executor()
        if executor is not None:
            executor.look()

    def _executor(self) -> LockstepExecutor | None:
        node = self._node()
        executor = node.executor if self.open and node is not None else None
        return executor if isinstance(executor, LockstepExecutor) else None


class LocalCall:
    """A request that waits in an executor's queue, is served, or is answered."""

    __slots__ = ("_answered", "_request", "_service", "response")

    def __init__(self, service: LocalService, request: Any) -> None:
        """Keep the request."""
        self._service, self._request = service, request
        self._answered = threading.Lock()
        self._answered.acquire()
        self.response: Any = None
        """The response; None: there is none yet, or the server has ended."""

    def __call__(self) -> None:
        """Serve the request; the executor calls this."""
        try:
            self.response = self._service.handler(self._request, self._service.srv_type.Response())
        finally:
            self._answered.release()

    def abandon(self) -> None:
        """Release the caller without a response."""
        self._answered.release()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end of the call; returns whether it has ended."""
        return self._answered.acquire(timeout=max(0.0, timeout_s))

    @property
    def possible(self) -> bool:
        """Whether the server can still answer."""
        return self._service.open


def offer(node: Node, srv_type: Any, name: str, handler: Callable[[Any, Any], Any], *, lockstep: bool) -> None:
    """Register a service for the callers of this process; see `LocalService`.

    Args:
        node: The node that serves.
        srv_type: Service class.
        name: Full name of the service.
        handler: See `LocalService`.
        lockstep: See `LocalService`.
    """
    with _lock:
        _services.setdefault(node.context, {})[name] = LocalService(node, srv_type, handler, lockstep=lockstep)


def withdraw(node: Node) -> None:
    """Remove the services of a node."""
    with _lock:
        offered = _services.get(node.context, {})
        for name in [name for name, service in offered.items() if service._node() is node]:
            offered.pop(name).open = False


def find(context: Context, srv_type: Any, name: str) -> LocalService | None:
    """Return a service of this process; None when there is none.

    Args:
        context: Context of the caller.
        srv_type: Service class.
        name: Full name of the service.
    """
    service = _services.get(context, {}).get(name)
    return service if service is not None and service.srv_type is srv_type else None
