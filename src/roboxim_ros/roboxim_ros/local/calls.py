"""Calls between nodes of one process, without the middleware.

A node offers a function on plain values to its process (`LocalFunction`). A caller of the same process hands the
arguments to the thread that spins the node, and gets the returned value. Nothing is converted or serialised, and no
wait set is built. Values are shared, so neither side may change a value after handing it over. Suitable are frozen
dataclasses, and arrays that are read-only or no longer used by the sender.

Services are offered in the same way (`LocalService`): the handler gets the caller's request, and the caller the
handler's response. The sender may not use a request or response after handing it over.

The node needs a `LockstepExecutor`. An *inline* function runs in the caller's thread instead, which saves two changes
of threads and works with any executor. It must be safe to run while the node's thread is working, and the caller's
time-out does not apply to it.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.node import Node

from roboxim_core.errors import ErrorCode
from roboxim_ros.lockstep_executor import LockstepExecutor

Describe = Callable[[BaseException], tuple[ErrorCode, str] | None]
"""Returns the code and the message that answer an exception; None: do not catch it."""


class _Offer:
    """A function or service that a node of this process offers."""

    lockstep = True
    """Whether a call is one of a series, for which the node's executor leaves the middleware for a while."""

    def __init__(self, node: Node, *, inline: bool) -> None:
        self._node = weakref.ref(node)
        self._inline = inline
        self.open = True
        """Whether the node still serves."""

    def belongs_to(self, node: Node) -> bool:
        """Return whether a node offers it."""
        return self._node() is node

    def answer(self, call: LocalCall, arguments: tuple[Any, ...]) -> None:
        """Run the call, and store its value or its error in it."""
        raise NotImplementedError

    def _sent(self, *arguments: Any) -> LocalCall | None:
        """Hand a call over, or run it if it is inline; None when the node does not serve or cannot take it."""
        node = self._node()
        if not self.open or node is None or node.executor is None:
            return None
        if self._inline:
            call = LocalCall(self, arguments)
            call()
            return call
        executor = node.executor
        if not isinstance(executor, LockstepExecutor):
            return None
        call = LocalCall(self, arguments)
        return call if executor.post(call) else None


class LocalService(_Offer):
    """A service of a node of this process."""

    lockstep = False

    def __init__(self, node: Node, srv_type: Any, handler: Callable[[Any, Any], Any], *, inline: bool) -> None:
        """Describe it.

        Args:
            node: The node that serves.
            srv_type: Service class.
            handler: Called with a request and an empty response; returns the response and raises nothing of `CAUGHT`.
            inline: See the module.
        """
        super().__init__(node, inline=inline)
        self._srv_type, self._handler = srv_type, handler

    def send(self, srv_type: Any, request: Any) -> LocalCall | None:
        """Hand a request over; None when it must go through the middleware.

        Raises:
            TypeError: If the request belongs to another service.
        """
        if srv_type is not self._srv_type:
            return None
        if not isinstance(request, srv_type.Request):
            raise TypeError(f"{srv_type.__name__} takes a {srv_type.Request}, got a {type(request)}")
        return self._sent(request)

    def answer(self, call: LocalCall, arguments: tuple[Any, ...]) -> None:
        """Call the handler and keep its response."""
        (request,) = arguments
        call.value = self._handler(request, self._srv_type.Response())
        call.served = True


class LocalFunction(_Offer):
    """A function of a node of this process."""

    def __init__(self, node: Node, function: Callable[..., Any], describe: Describe, *, inline: bool) -> None:
        """Describe it.

        Args:
            node: The node that offers it.
            function: The function.
            describe: Called with an exception of the function.
            inline: See the module.
        """
        super().__init__(node, inline=inline)
        self._function, self._describe = function, describe

    def send(self, *arguments: Any) -> LocalCall | None:
        """Hand a call over; None when the node does not serve."""
        return self._sent(*arguments)

    def answer(self, call: LocalCall, arguments: tuple[Any, ...]) -> None:
        """Call the function and keep its value or its error."""
        try:
            call.value = self._function(*arguments)
        except BaseException as error:
            described = self._describe(error)
            if described is None:
                raise
            call.error_code, call.error_msg = described
        call.served = True


class LocalCall:
    """A call that waits in an executor's queue, is being served, or has ended."""

    __slots__ = ("_arguments", "_ended", "_offer", "error_code", "error_msg", "served", "value")

    def __init__(self, offer: _Offer, arguments: tuple[Any, ...]) -> None:
        """Keep the arguments."""
        self._offer, self._arguments = offer, arguments
        self._ended = threading.Lock()
        self._ended.acquire()
        self.served = False
        """Whether the function has returned or raised; false after the end of the call: the node has ended."""
        self.value: Any = None
        """Returned value."""
        self.error_code, self.error_msg = ErrorCode.OK, ""

    def __call__(self) -> None:
        """Run the call; the executor does this, or the caller if it is inline."""
        try:
            self._offer.answer(self, self._arguments)
        finally:
            self._ended.release()

    def abandon(self) -> None:
        """Release the caller without an answer."""
        self._ended.release()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end of the call; returns whether it has ended."""
        return self._ended.acquire(timeout=max(0.0, timeout_s))

    @property
    def lockstep(self) -> bool:
        """See `Posted.lockstep`."""
        return self._offer.lockstep

    @property
    def possible(self) -> bool:
        """Whether the node can still answer."""
        return self._offer.open


_services: weakref.WeakKeyDictionary[Context, dict[str, LocalService]] = weakref.WeakKeyDictionary()
_functions: weakref.WeakKeyDictionary[Context, dict[str, LocalFunction]] = weakref.WeakKeyDictionary()
_lock = threading.Lock()


def register_service(node: Node, name: str, srv_type: Any, handler: Callable[[Any, Any], Any], *, inline: bool) -> None:
    """Register a service for the callers of this process.

    Args:
        node: The node that serves.
        name: Full name.
        srv_type: See `LocalService`.
        handler: See `LocalService`.
        inline: See the module.
    """
    with _lock:
        _services.setdefault(node.context, {})[name] = LocalService(node, srv_type, handler, inline=inline)


def offer(node: Node, name: str, function: Callable[..., Any], describe: Describe, *, inline: bool) -> None:
    """Offer a function to this process.

    Args:
        node: The node that offers it.
        name: Full name, e.g. that of the service that does the same for other processes.
        function: See `LocalFunction`.
        describe: See `LocalFunction`.
        inline: See the module.
    """
    with _lock:
        _functions.setdefault(node.context, {})[name] = LocalFunction(node, function, describe, inline=inline)


def withdraw(node: Node) -> None:
    """Remove everything that a node offers."""
    with _lock:
        for registry in (_services, _functions):
            offered: dict[str, Any] = registry.get(node.context, {})
            for name in [name for name, one in offered.items() if one.belongs_to(node)]:
                offered.pop(name).open = False


def find_service(context: Context, name: str) -> LocalService | None:
    """Return a service of this process, by its full name; None when there is none."""
    return _services.get(context, {}).get(name)


def find_function(context: Context, name: str) -> LocalFunction | None:
    """Return a function that a node of this process offers, by its full name; None when there is none."""
    return _functions.get(context, {}).get(name)
