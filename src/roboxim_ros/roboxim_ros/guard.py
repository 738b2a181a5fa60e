"""The guard around every callback of a node: an exception becomes an answer with a code, and the node keeps running.

The fields of a response that report a failure depend on the interface package; `fill_error` handles them. `GuardedNode`
wraps the callbacks that rclpy calls, so that no exception reaches the executor, where it would end the node.

Non-obvious:
- ``SystemExit`` is caught as well: in a node's thread it comes from a library that calls ``sys.exit``, and would end
  the node silently. ``KeyboardInterrupt`` reaches the main thread only and is not caught.
- A response that cannot be sent (e.g. a string that is not UTF-8) is replaced by an error; without an answer the client
  would wait until its timeout.
"""

from __future__ import annotations

import functools
import inspect
import os
import traceback
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.serialization import serialize_message

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, RoboximError, UnavailableError
from roboxim_ros.bounds import check_message
from roboxim_ros.goal_queue import GoalQueue
from roboxim_ros.local import calls as local_calls
from roboxim_ros.shared_memory import fault_of_folder, private_files, seal

CAUGHT = (Exception, SystemExit)
"""Exceptions that a callback may raise without ending its node."""
_FOLLOW_TRAJECTORY_INVALID_GOAL = -1
_SIMULATION_OPERATION_FAILED = 4
_SIMULATION_RESULTS = {
    ErrorCode.UNKNOWN_ENTITY: 2,
    ErrorCode.UNKNOWN_MODEL: 2,
    ErrorCode.NO_SCENE: 3,
    ErrorCode.LEASE_HELD: 3,
}
"""RoboXim's error code to ``simulation_interfaces/Result``: not found, incorrect state; all others: failed."""


def describe(error: BaseException, what: str) -> tuple[ErrorCode, str]:
    """Return the code and the message that answer an exception.

    Args:
        error: The exception.
        what: Name of the service or action, used in the message of an unexpected exception.
    """
    if isinstance(error, RoboximError):
        return error.code, limits.printable(str(error))
    text = f"{type(error).__name__} in {what}: {error}"
    return ErrorCode.INTERNAL, limits.printable(text)


def fill_error(answer: Any, code: ErrorCode, message: str) -> None:
    """Write an error into the error fields of a response or a result.

    Args:
        answer: A response of RoboXim, ``simulation_interfaces``, ``std_srvs`` or ``rcl_interfaces``, or the result of
            an action. A type without such fields (``std_srvs/Empty``, ``GripperCommand``) stays unchanged.
        code: Error code.
        message: Error message.
    """
    fields = answer.get_fields_and_field_types()
    if "error_code" in fields and "error_msg" in fields:
        answer.error_code, answer.error_msg = int(code), message
    elif fields.get("result") == "simulation_interfaces/Result":
        answer.result.result = _SIMULATION_RESULTS.get(code, _SIMULATION_OPERATION_FAILED)
        answer.result.error_message = f"{code.name}: {message}"
    elif "error_code" in fields and "error_string" in fields:
        answer.error_code, answer.error_string = _FOLLOW_TRAJECTORY_INVALID_GOAL, f"{code.name}: {message}"
    elif "success" in fields and "message" in fields:
        answer.success, answer.message = False, f"{code.name}: {message}"
    elif fields.get("result") == "rcl_interfaces/SetParametersResult":
        answer.result.successful, answer.result.reason = False, f"{code.name}: {message}"


def report(logger: RcutilsLogger, error: BaseException, what: str) -> None:
    """Log an error: one line for a faulty request, the traceback for an unexpected exception."""
    if isinstance(error, RoboximError):
        logger.info(f"{what}: {error.code.name}: {limits.printable(str(error))}")
    else:
        logger.error(limits.printable(f"{what}:\n{''.join(traceback.format_exception(error))}", limits.LOG_CHARACTERS))


def guarded_service(
    logger: RcutilsLogger, name: str, handler: Callable[[Any, Any], Any], response_type: Callable[[], Any]
) -> Callable[[Any, Any], Any]:
    """Return a service callback that turns every exception of its handler into an answer.

    Args:
        logger: Logger of the reports.
        name: Name of the service.
        handler: Called with (request, response); a function or a coroutine function. It returns the response, or none
            for the response it was given.
        response_type: Makes the empty response for an error.
    """

    def refused(error: BaseException, begun: Any) -> Any:
        """Return the error as an answer. A `RoboximError` keeps the handler's other fields, e.g. a partial path."""
        report(logger, error, name)
        answer = begun if isinstance(error, RoboximError) else response_type()
        fill_error(answer, *describe(error, name))
        return answer

    if inspect.iscoroutinefunction(handler):

        async def wait(request: Any, response: Any) -> Any:
            try:
                check_message(request)
                answer = await handler(request, response)
            except CAUGHT as error:
                return refused(error, response)
            return response if answer is None else answer

        return wait

    def call(request: Any, response: Any) -> Any:
        try:
            check_message(request)
            answer = handler(request, response)
        except CAUGHT as error:
            return refused(error, response)
        return response if answer is None else answer

    return call


def guard_sending(logger: RcutilsLogger, service: Any, response_type: Callable[[], Any]) -> None:
    """Make a service answer with an error when its response cannot be sent."""
    send = service.send_response

    def guarded(response: Any, header: Any) -> None:
        try:
            send(response, header)
        except CAUGHT as error:
            report(logger, error, f"the answer of {service.srv_name}")
            answer = response_type()
            fill_error(answer, *describe(error, service.srv_name))
            try:
                send(answer, header)
            except CAUGHT as again:  # the client has disconnected
                report(logger, again, f"the answer of {service.srv_name}")

    service.send_response = guarded


def guarded_callback(logger: RcutilsLogger, name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return a subscription's or a timer's callback that logs every exception of the given callback.

    It keeps the given callback's signature, from which rclpy derives the arguments.
    """

    @functools.wraps(callback)
    def call(*args: Any) -> Any:
        try:
            return callback(*args)
        except CAUGHT as error:
            report(logger, error, name)
            return None

    return call


class GuardedNode(Node):  # type: ignore[misc]  # rclpy has no types
    """A node that survives exceptions of its callbacks: services, subscriptions, timers and actions, also rclpy's own.

    Other users cannot open its participant's shared memory, unless the run is open to the network.
    """

    def __init__(self, node_name: str, *, context: Context, **kwargs: Any) -> None:
        """Make the node; see `rclpy.node.Node`.

        Raises:
            UnavailableError: When the shared memory of its domain belongs to another user, or cannot be written.
        """
        try:
            with private_files():
                super().__init__(node_name, context=context, **kwargs)
        except RCLError as error:
            fault = fault_of_folder()
            if fault is None or "participant" not in str(error):
                raise
            raise UnavailableError(fault) from None
        if os.environ.get("ROBOXIM_TRANSPORT", "user") == "user":
            try:
                seal(context.get_domain_id())
            except UnavailableError:
                self.destroy_node()
                raise

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any) -> Any:
        """Publish as rclpy does, without its warnings about subscribers that ask for another QoS.

        The subscriber warns too. Each warning is an entity that the executor checks after every callback.
        """
        kwargs.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(msg_type, topic, qos_profile, **kwargs)

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *args: Any,
        inline: bool = False,
        **kwargs: Any,
    ) -> Any:
        """Offer a service as rclpy does; an exception of its callback becomes the answer.

        Callers of this process hand the request over without the middleware, unless the callback is a coroutine
        function (`roboxim_ros.local.calls`).

        Args:
            srv_type: Service class.
            srv_name: Name, relative to the namespace.
            callback: The handler.
            *args: Passed to rclpy.
            inline: Whether callers of this process run the handler in their own thread, see `roboxim_ros.local.calls`.
            **kwargs: Passed to rclpy.
        """
        guarded = guarded_service(self.get_logger(), srv_name, callback, srv_type.Response)
        service = super().create_service(srv_type, srv_name, guarded, *args, **kwargs)
        guard_sending(self.get_logger(), service, srv_type.Response)
        if not inspect.iscoroutinefunction(guarded):
            local_calls.register_service(self, service.service_name, srv_type, guarded, inline=inline)
        return service

    def offer(self, name: str, function: Callable[..., Any], *, inline: bool = False) -> None:
        """Offer a function to callers of this process, which pass plain values; see `roboxim_ros.local.calls`.

        Args:
            name: Name, relative to the namespace; a service of the same name serves other processes.
            function: Called in the node's thread unless ``inline``; not a coroutine function. An exception is raised at
                the caller, with the same code and message as from a service.
            inline: Whether callers run it in their own thread, see `roboxim_ros.local.calls`.
        """

        def described(error: BaseException) -> tuple[ErrorCode, str] | None:
            if not isinstance(error, CAUGHT):
                return None
            report(self.get_logger(), error, name)
            return describe(error, name)

        local_calls.offer(self, self.resolve_service_name(name), function, described, inline=inline)

    def destroy_node(self) -> None:
        """Destroy the node and end its offers to this process."""
        local_calls.withdraw(self)
        super().destroy_node()

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *args: Any, **kwargs: Any
    ) -> Any:
        """Subscribe as rclpy does; an exception of the callback is logged."""
        guarded = guarded_callback(self.get_logger(), f"a message of '{topic}'", callback)
        return super().create_subscription(msg_type, topic, guarded, *args, **kwargs)

    def create_timer(self, timer_period_sec: float, callback: Callable[..., None], *args: Any, **kwargs: Any) -> Any:
        """Make a timer as rclpy does; an exception of the callback is logged."""
        guarded = guarded_callback(self.get_logger(), "a timer", callback)
        return super().create_timer(timer_period_sec, guarded, *args, **kwargs)

    def add_on_set_parameters_callback(self, callback: Callable[[list[Any]], SetParametersResult]) -> None:
        """Register a callback that checks new parameter values as rclpy does; an exception refuses them."""

        @functools.wraps(callback)
        def guarded(parameters: list[Any]) -> SetParametersResult:
            try:
                return callback(parameters)
            except CAUGHT as error:
                report(self.get_logger(), error, "setting parameters")
                code, message = describe(error, "setting parameters")
                return SetParametersResult(successful=False, reason=f"{code.name}: {message}")

        super().add_on_set_parameters_callback(guarded)

    def serve_action(
        self,
        action_type: Any,
        name: str,
        execute: Callable[[ServerGoalHandle], Any],
        *,
        queue: GoalQueue | None = None,
        **kwargs: Any,
    ) -> ActionServer:
        """Offer an action.

        Every goal is accepted, so that a refusal can give its reason in the result. Goals can be cancelled.

        Args:
            action_type: Action class.
            name: Name, relative to the namespace.
            execute: Called with the goal's handle; a function or a coroutine function. It ends the goal and returns the
                result. An exception aborts the goal and becomes the result.
            queue: Queue in which the goals wait for their turn; ``execute`` is then no coroutine function. None: every
                goal is executed at once.
            **kwargs: Passed to ``ActionServer``, e.g. ``callback_group``.
        """
        guarded = _guarded_execute(self.get_logger(), name, execute, action_type.Result)
        if queue is not None:
            guarded = queue.in_turn(guarded)
            kwargs["handle_accepted_callback"] = queue.add
        return ActionServer(
            self,
            action_type,
            name,
            execute_callback=guarded,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            result_timeout=10,
            **kwargs,
        )


def _guarded_execute(
    logger: RcutilsLogger, name: str, execute: Callable[[ServerGoalHandle], Any], result_type: Callable[[], Any]
) -> Callable[[ServerGoalHandle], Any]:
    """Return an action's execute callback that ends the goal and answers, even if the given one raises."""

    def refused(goal: ServerGoalHandle, error: BaseException) -> Any:
        report(logger, error, name)
        if goal.is_active:
            goal.abort()
        result = result_type()
        fill_error(result, *describe(error, name))
        return result

    if inspect.iscoroutinefunction(execute):

        async def wait(goal: ServerGoalHandle) -> Any:
            try:
                check_message(goal.request)
                result = await execute(goal)
                serialize_message(result)  # raises on a string that is not UTF-8, while an answer is still possible
            except CAUGHT as error:
                return refused(goal, error)
            return result

        return wait

    def call(goal: ServerGoalHandle) -> Any:
        try:
            check_message(goal.request)
            result = execute(goal)
            serialize_message(result)
        except CAUGHT as error:
            return refused(goal, error)
        return result

    return call
