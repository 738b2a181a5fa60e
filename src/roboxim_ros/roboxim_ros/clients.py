"""Blocking service calls that may be made from any thread, callbacks included.

A client needs an executor to hear its answer; if that is the executor whose callback waits, nothing ever moves. So the
clients of a process part live on a node of their own, spun by a thread of their own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter

from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError, raise_for_code
from roboxim_ros.guard import GuardedNode

T = TypeVar("T")


def wait_until(ready: Callable[[], bool], timeout_s: float) -> bool:
    """Ask until it is so. rclpy's own wait asks only four times a second, which every first call would pay."""
    deadline = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


class Clients:
    """Service clients with a node and a thread of their own; a context manager.

    Close it: a client that exits without destroying its node delays the first answer that the next process gets.
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
        self._lock = threading.Lock()
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def client(self, srv_type: Any, name: str) -> Client:
        """Return the client of a service, made on first use.

        Raises:
            InvalidRequestError: When no service can have that name.
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
        """Have the thread notice what was just made on ``node``: a subscription, an action client."""
        self._executor.wake()

    def call(
        self,
        srv_type: Any,
        name: str,
        request: Any,
        *,
        timeout_s: float = 120.0,
        wait_s: float = 30.0,
        check: bool = True,
    ) -> Any:
        """Call a service and return its response.

        Args:
            srv_type: Service class.
            name: Service name, relative to the namespace.
            request: The request.
            timeout_s: Longest wait for the answer [s].
            wait_s: Longest wait for the service to appear [s].
            check: Raise what the response's ``error_code`` says; false: return the response whatever it says.

        Raises:
            UnavailableError: When no such service appears in time, or it goes away before it has answered.
            RequestTimeoutError: When the answer does not come in time.
            RoboximError: What the response's ``error_code`` and ``error_msg`` say, when it has them.
        """
        client = self.client(srv_type, name)
        if not wait_until(client.service_is_ready, wait_s):
            raise UnavailableError(
                f"service '{client.service_name}' is not there after {wait_s:g} s; is its node running?"
            )
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        deadline = time.monotonic() + timeout_s
        while not done.wait(min(1.0, max(0.0, deadline - time.monotonic()))):
            if time.monotonic() >= deadline:
                client.remove_pending_request(future)
                raise RequestTimeoutError(
                    f"service '{client.service_name}' did not answer within {timeout_s:g} s; its node hangs or has died"
                )
            if not client.service_is_ready():  # its lease ran out
                client.remove_pending_request(future)
                raise UnavailableError(f"service '{client.service_name}' went away during the call; its node has died")
        response = future.result()
        if check:
            raise_for_code(getattr(response, "error_code", 0), getattr(response, "error_msg", ""))
        return response

    def in_thread(self, function: Callable[[], T]) -> T:
        """Call a function in the clients' thread and return its result.

        For what is not safe beside a spinning executor. An rclpy action client notes a request only after it is sent:
        an answer that is quicker is taken for a stranger's, and the request waits for ever.

        Args:
            function: Must not wait for an answer of these clients.

        Raises:
            UnavailableError: When the thread has ended.
            Exception: Whatever the function raises.
        """
        if threading.current_thread() is self._thread:
            return function()
        done = threading.Event()
        returned: list[T] = []
        raised: list[BaseException] = []

        def call() -> None:
            try:
                returned.append(function())
            except BaseException as error:  # handed to the caller below
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
        """Stop the thread and destroy the node, so that peers see it go at once."""
        self._executor.shutdown()
        self._thread.join(timeout=5.0)
        self.node.destroy_node()

    def __enter__(self) -> Clients:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()
