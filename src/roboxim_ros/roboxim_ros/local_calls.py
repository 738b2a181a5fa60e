"""Calls between nodes of one process, without messages and without the middleware.

A node offers a function of the core's values to its process (`LocalFunction`). A caller of the same process hands the
arguments to the thread that spins the node, and gets the returned value. Nothing is converted or serialised, and no
wait set is built. Values are shared, so neither side may change what it has handed over: frozen dataclasses, and arrays
that are read-only or given away. The node needs a `LockstepExecutor`.

Services are registered here too: their node may be waiting for the next call of a function, so a caller of the same
process makes it look at the middleware.
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
"""Returns the code and the message that answer an exception; None: it is not to be caught."""


class _Offer:
    """What a node of this process offers."""

    def __init__(self, node: Node) -> None:
        self._node = weakref.ref(node)
        self.open = True
        """Whether the node still serves."""

    def belongs_to(self, node: Node) -> bool:
        """Tell whether a node offers it."""
        return self._node() is node

    def _executor(self) -> LockstepExecutor | None:
        node = self._node()
        executor = node.executor if self.open and node is not None else None
        return executor if isinstance(executor, LockstepExecutor) else None


class LocalService(_Offer):
    """A service of a node of this process, which is called through the middleware."""

    def look(self) -> None:
        """Make the server look at the middleware, where a request has been sent to."""
        executor = self._executor()
        if executor is not None:
            executor.look()


class LocalFunction(_Offer):
    """A function of a node of this process."""

    def __init__(self, node: Node, function: Callable[..., Any], describe: Describe) -> None:
        """Describe it.

        Args:
            node: The node that offers it.
            function: Called in the node's thread.
            describe: Called with what the function raises.
        """
        super().__init__(node)
        self._function, self._describe = function, describe

    def send(self, *arguments: Any) -> LocalCall | None:
        """Hand a call over; None when the node does not serve."""
        executor = self._executor()
        if executor is None:
            return None
        call = LocalCall(self, arguments)
        return call if executor.post(call) else None

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

    __slots__ = ("_arguments", "_ended", "_function", "error_code", "error_msg", "served", "value")

    def __init__(self, function: LocalFunction, arguments: tuple[Any, ...]) -> None:
        """Keep the arguments."""
        self._function, self._arguments = function, arguments
        self._ended = threading.Lock()
        self._ended.acquire()
        self.served = False
        """Whether the function has returned or raised; false after the end: the node has ended."""
        self.value: Any = None
        """What it has returned."""
        self.error_code, self.error_msg = ErrorCode.OK, ""

    def __call__(self) -> None:
        """Call the function; the executor does this."""
        try:
            self._function.answer(self, self._arguments)
        finally:
            self._ended.release()

    def abandon(self) -> None:
        """Release the caller without an answer."""
        self._ended.release()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the end of the call; returns whether it has ended."""
        return self._ended.acquire(timeout=max(0.0, timeout_s))

    @property
    def possible(self) -> bool:
        """Whether the node can still answer."""
        return self._function.open


_services: weakref.WeakKeyDictionary[Context, dict[str, LocalService]] = weakref.WeakKeyDictionary()
_functions: weakref.WeakKeyDictionary[Context, dict[str, LocalFunction]] = weakref.WeakKeyDictionary()
_lock = threading.Lock()


def register_service(node: Node, name: str) -> None:
    """Register a service, by its full name, for the callers of this process."""
    with _lock:
        _services.setdefault(node.context, {})[name] = LocalService(node)


def offer(node: Node, name: str, function: Callable[..., Any], describe: Describe) -> None:
    """Offer a function to this process.

    Args:
        node: The node that offers it.
        name: Full name, e.g. that of the service that does the same for other processes.
        function: See `LocalFunction`.
        describe: See `LocalFunction`.
    """
    with _lock:
        _functions.setdefault(node.context, {})[name] = LocalFunction(node, function, describe)


def withdraw(node: Node) -> None:
    """Remove what a node offers."""
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
