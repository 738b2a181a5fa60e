"""The base class of all nodes: services that answer errors, parameters from a dataclass, blocking clients."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

import rclpy.parameter
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.action.server import ServerGoalHandle
from rclpy.context import Context
from rclpy.subscription import Subscription

from roboxim_core.errors import ConfigError, ErrorCode
from roboxim_ros.clients import Clients
from roboxim_ros.guard import CAUGHT, GuardedNode, describe, fill_error, report

C = TypeVar("C")
R = TypeVar("R", bound=Any)


def parameter(default: Any, description: str, *bounds: float) -> Any:
    """Return the field of a node's parameter, for `RoboximNode.declare_config`.

    Args:
        default: Its default.
        description: What it sets, with its unit.
        bounds: Lowest and highest value; left out: any.
    """
    metadata = {"description": description} | ({"range": bounds} if bounds else {})
    return dataclasses.field(default=default, metadata=metadata)


class RoboximNode(GuardedNode):
    """A node whose handlers raise `RoboximError` and whose answers carry its code; see `GuardedNode`.

    Handlers run in the node's executor thread, one at a time, unless they are inline (`roboxim_ros.local.calls`).
    They may use `clients_of_node`.
    """

    def __init__(
        self,
        name: str,
        *,
        context: Context,
        namespace: str = "",
        parameters: dict[str, Any] | None = None,
    ) -> None:
        """Make the node.

        Args:
            name: Node name, e.g. ``sim``.
            context: An initialised rclpy context.
            namespace: Namespace of the graph, e.g. ``/w0``; empty: the root.
            parameters: Overrides of parameters, by name.
        """
        overrides = [rclpy.parameter.Parameter(key, value=value) for key, value in (parameters or {}).items()]
        super().__init__(name, context=context, namespace=namespace, parameter_overrides=overrides)
        self._clients_or_none: Clients | None = None

    @property
    def clients_of_node(self) -> Clients:
        """Blocking clients of this node, made on first use."""
        if self._clients_or_none is None:
            self._clients_or_none = Clients(
                f"{self.get_name()}_clients", context=self.context, namespace=self.get_namespace()
            )
        return self._clients_or_none

    def serve(self, srv_type: Any, name: str, handler: Callable[[Any, Any], Any], **kwargs: Any) -> None:
        """Offer a service.

        Args:
            srv_type: Service class.
            name: Name, relative to the namespace.
            handler: Called with (request, response); a function or a coroutine function. Fills the response or raises:
                `roboxim_ros.guard.fill_error` turns the exception into the answer.
            **kwargs: Passed to `GuardedNode.create_service`.
        """
        self.create_service(srv_type, name, handler, **kwargs)

    def subscribe(
        self, msg_type: Any, name: str, callback: Callable[..., None], qos: Any, **kwargs: Any
    ) -> Subscription:
        """Subscribe to a topic.

        Args:
            msg_type: Message class.
            name: Name, relative to the namespace.
            callback: Called with the message, or with message and info; an exception is logged.
            qos: Profile of `roboxim_ros.qos`.
            **kwargs: Passed to ``create_subscription``.
        """
        return self.create_subscription(msg_type, name, callback, qos, **kwargs)

    def answering(self, what: str, result: Any) -> ErrorAnswer:
        """Return a context manager that turns an exception into a result's ``error_code`` and ``error_msg``."""
        return ErrorAnswer(self, what, result)

    def declare_config(self, cls: type[C]) -> C:
        """Declare a parameter per field of a dataclass and return the resolved value.

        A field's metadata may give ``description``, ``range`` (lowest, highest) and ``read_only`` (default True).

        Args:
            cls: Frozen dataclass of bool, int, float, str and tuples of them, with defaults.

        Raises:
            ConfigError: When a parameter's value is not valid.
        """
        hints = get_type_hints(cls)
        values = {}
        for field in dataclasses.fields(cls):  # type: ignore[arg-type]
            made = field.default_factory is not dataclasses.MISSING
            default = field.default_factory() if made else field.default  # type: ignore[operator]
            descriptor = _descriptor(field, hints[field.name])
            initial = list(default) if isinstance(default, tuple) else default
            try:
                value = self.declare_parameter(field.name, initial, descriptor).value
            except Exception as error:
                raise ConfigError(f"parameter '{field.name}' of node '{self.get_name()}': {error}") from None
            values[field.name] = tuple(value) if isinstance(default, tuple) else value
        return cls(**values)

    def destroy_node(self) -> None:
        """Destroy the node and its clients."""
        if self._clients_or_none is not None:
            self._clients_or_none.close()
            self._clients_or_none = None
        super().destroy_node()


def ended(goal: ServerGoalHandle, result: R) -> R:
    """End an action's goal as its result's ``error_code`` says, and return the result."""
    code = result.error_code
    if code == ErrorCode.CANCELLED and goal.is_cancel_requested:
        goal.canceled()
    elif code:
        goal.abort()
    else:
        goal.succeed()
    return result


class ErrorAnswer:
    """Turns an exception into a result's ``error_code`` and ``error_msg``; logs unexpected exceptions."""

    def __init__(self, node: GuardedNode, what: str, result: Any) -> None:
        """Store the result to fill."""
        self._node, self._what, self._result = node, what, result

    def __enter__(self) -> ErrorAnswer:
        """Return itself."""
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool:
        """Fill the result; suppress every exception that `roboxim_ros.guard` catches."""
        if not isinstance(error, CAUGHT):
            return False
        fill_error(self._result, *describe(error, self._what))
        report(self._node.get_logger(), error, self._what)
        return True


def _descriptor(field: dataclasses.Field[Any], kind: Any) -> ParameterDescriptor:
    meta = field.metadata
    descriptor = ParameterDescriptor(description=meta.get("description", ""), read_only=meta.get("read_only", True))
    if "range" in meta:
        low, high = meta["range"]
        if kind is int:
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        elif kind is float and math.isfinite(low) and math.isfinite(high):
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor
