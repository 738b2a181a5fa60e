"""Blocking service calls from any thread, callbacks included.

`Clients.call` hands the request to a node of the same process (`roboxim_ros.local.calls`), or else takes the answer
from the middleware itself (`roboxim_ros.direct_calls`). `Clients.send_local` calls a function on plain values that a
node of the same process offers. Everything else on the clients' node needs an executor: subscriptions, action clients,
rclpy's own service clients. If a callback waited for its own executor, it would wait forever. A separate thread
therefore spins this node.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidServiceNameException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.parameter import Parameter
from rclpy.validate_topic_name import validate_topic_name

from roboxim_core.closing import Closing
from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError, raise_for_code
from roboxim_ros.direct_calls import DirectClient
from roboxim_ros.guard import GuardedNode
from roboxim_ros.local import calls as local_calls
from roboxim_ros.local.calls import LocalCall
from roboxim_ros.lockstep_executor import LockstepExecutor
from roboxim_ros.spinning import spin

T = TypeVar("T")
APPEARANCE_S = 30.0
"""Longest wait for a service to appear, unless a call gives another [s]."""


def wait_until(ready: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition. rclpy's own wait polls only four times a second, which would delay every first call."""
    deadline = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def _late(service: str, timeout_s: float) -> RequestTimeoutError:
    return RequestTimeoutError(f"service '{service}' did not answer within {timeout_s:g} s; its node hangs or has died")


def _disappeared(service: str) -> UnavailableError:
    return UnavailableError(f"service '{service}' disappeared during the call; its node has died")


class Clients(Closing):
    """Service clients with their own node and thread; a context manager.

    Close it: a process that exits without destroying its node delays the first answer to the next process.
    """

    def __init__(self, name: str, *, context: Context, namespace: str = "") -> None:
        """Start the node and its thread.

        Args:
            name: Name of the client node, e.g. ``evaluator_clients``.
            context: An initialised rclpy context.
            namespace: Namespace that relative service names resolve in.
        """
        self.node = GuardedNode(
            name,
            context=context,
            namespace=namespace,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
        self._clients: dict[tuple[Any, str], Client] = {}
        self._idle: defaultdict[tuple[Any, str], list[DirectClient]] = defaultdict(list)
        self._full_names: dict[str, str] = {}
        self._closed = False
        self._lock = threading.Lock()
        self._executor = LockstepExecutor(context=context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=spin, args=(self._executor, self.node), name=name, daemon=True)
        self._thread.start()

    def client(self, srv_type: Any, name: str) -> Client:
        """Return the client of a service, made on first use.

        Raises:
            InvalidRequestError: When the name is not a valid service name.
        """
        with self._lock:
            key = (srv_type, name)
            if key not in self._clients:
                try:
                    self._clients[key] = self.node.create_client(srv_type, name)
                except InvalidServiceNameException as error:
                    raise InvalidRequestError(str(error)) from None
                self.wake()
            return self._clients[key]

    def wake(self) -> None:
        """Wake the thread, so that it serves a new subscription or action client of ``node``."""
        self._executor.wake()

    def call(
        self,
        srv_type: Any,
        name: str,
        request: Any,
        *,
        timeout_s: float = 120.0,
        wait_s: float | None = None,
        check: bool = True,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Any:
        """Call a service and return its response. Request and response may be shared with a node of this process.

        Args:
            srv_type: Service class.
            name: Service name, relative to the namespace.
            request: The request.
            timeout_s: Longest wait for the answer [s]; handlers that run in the caller's thread have their own limits.
            wait_s: Longest wait for the service to appear [s]; None: `APPEARANCE_S`.
            check: Raise the error in the response's ``error_code``; false: return the response with any code.
            meanwhile: Called when the request has been sent, before the wait for its answer.

        Raises:
            UnavailableError: When the service does not appear in time, or disappears before it answers.
            RequestTimeoutError: When the answer does not come in time.
            RoboximError: As the response's ``error_code`` and ``error_msg`` state, when it has them.
        """
        local = local_calls.find_service(self.node.context, self._full_name(name))
        sent = None if local is None else local.send(srv_type, request)
        if sent is not None:
            meanwhile()
            response = self.value_of(sent, name, timeout_s)
        else:
            response = self._answer_of_middleware(srv_type, name, request, timeout_s, wait_s, meanwhile)
        if check:
            raise_for_code(getattr(response, "error_code", 0), getattr(response, "error_msg", ""))
        return response

    def _full_name(self, name: str) -> str:
        """Return a service's full name.

        Raises:
            InvalidRequestError: When the name is not a valid service name.
        """
        if name not in self._full_names:
            try:
                validate_topic_name(name, is_service=True)
            except InvalidServiceNameException as error:
                raise InvalidRequestError(str(error)) from None
            self._full_names[name] = self.node.resolve_service_name(name)
        return self._full_names[name]

    def send_local(self, name: str, *arguments: Any) -> LocalCall | None:
        """Call a function that a node of this process offers; `value_of` waits for its value.

        Args:
            name: Name, relative to the namespace.
            *arguments: Its arguments; see `roboxim_ros.local.calls`.

        Returns:
            The call; None when no node of this process offers the function.
        """
        function = local_calls.find_function(self.node.context, self._full_name(name))
        return None if function is None else function.send(*arguments)

    def value_of(self, call: LocalCall, name: str, timeout_s: float) -> Any:
        """Wait for the value of a function or the response of a service of this process, and return it.

        Args:
            call: From `send_local`.
            name: Name of the function or service, for errors.
            timeout_s: Longest wait [s].

        Raises:
            UnavailableError: When the node ends, or these clients are closed.
            RequestTimeoutError: When the value does not come in time.
            RoboximError: As the function raises it.
        """
        deadline = time.monotonic() + timeout_s
        while not call.wait(min(1.0, deadline - time.monotonic())):
            if self._closed:
                raise self._closed_during(name)
            if not call.possible:
                break
            if time.monotonic() >= deadline:
                raise _late(self._full_name(name), timeout_s)
        if not call.served:
            raise _disappeared(self._full_name(name))
        raise_for_code(call.error_code, call.error_msg)
        return call.value

    def _answer_of_middleware(
        self,
        srv_type: Any,
        name: str,
        request: Any,
        timeout_s: float,
        wait_s: float | None,
        meanwhile: Callable[[], None],
    ) -> Any:
        """Return the answer of any server."""
        direct = self._borrow(srv_type, name)
        try:
            wait_s = APPEARANCE_S if wait_s is None else wait_s
            return self._answer(direct, request, timeout_s, wait_s, meanwhile)
        except rclpy_implementation.InvalidHandle:
            raise self._closed_during(name) from None
        finally:
            with self._lock:
                self._idle[srv_type, name].append(direct)

    def _closed_during(self, name: str) -> UnavailableError:
        return UnavailableError(f"the clients '{self.node.get_name()}' were closed during a call of '{name}'")

    def _borrow(self, srv_type: Any, name: str) -> DirectClient:
        """Return a client that no other thread uses."""
        with self._lock:
            if idle := self._idle[srv_type, name]:
                return idle.pop()
            try:
                return DirectClient(self.node, srv_type, name)
            except InvalidServiceNameException as error:
                raise InvalidRequestError(str(error)) from None

    def _answer(
        self, direct: DirectClient, request: Any, timeout_s: float, wait_s: float, meanwhile: Callable[[], None]
    ) -> Any:
        """Send a request and return its answer."""
        client = direct.client
        if not wait_until(client.service_is_ready, wait_s):
            raise UnavailableError(
                f"service '{client.service_name}' is not available after {wait_s:g} s; is its node running?"
            )
        number = direct.send(request)
        meanwhile()
        deadline = time.monotonic() + timeout_s
        while (answer := direct.receive(number, min(1.0, deadline - time.monotonic()))) is None:
            if time.monotonic() >= deadline:
                raise _late(client.service_name, timeout_s)
            if not client.service_is_ready():  # its lease expired
                raise _disappeared(client.service_name)
        return answer

    def in_thread(self, function: Callable[[], T]) -> T:
        """Call a function in the clients' thread and return its result.

        For calls that are not safe while another thread spins the executor. An rclpy action client registers a request
        only after sending it: it drops an answer that arrives earlier, and the request waits forever.

        Args:
            function: The function; it must not wait for an answer of these clients.

        Raises:
            UnavailableError: When the thread has ended.
            Exception: As the function raises it.
        """
        if threading.current_thread() is self._thread:
            return function()
        done = threading.Event()
        returned: list[T] = []
        raised: list[BaseException] = []

        def call() -> None:
            try:
                returned.append(function())
            except BaseException as error:  # raised in the caller below
                raised.append(error)
            finally:
                done.set()

        self._executor.create_task(call)
        while not done.wait(0.5):
            if not self._thread.is_alive():
                raise UnavailableError(f"the clients '{self.node.get_name()}' are closed")
        if raised:
            raise raised[0]
        return returned[0]

    def close(self) -> None:
        """Stop the thread and destroy the node, so that peers notice at once."""
        self._closed = True
        self._executor.shutdown()
        self._thread.join(timeout=5.0)
        self.node.destroy_node()
