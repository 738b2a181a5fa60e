"""The base of every node: services whose errors are answers, parameters from a dataclass, clients that may block."""

from __future__ import annotations

import dataclasses
import functools
import math
import traceback
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

import rclpy.parameter
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.node import Node

from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
from roboxim_ros.clients import Clients

C = TypeVar("C")


class RoboximNode(Node):
    """A node whose handlers raise `RoboximError` and whose results carry the code.

    Handlers run in the node's executor thread, one at a time; `clients` may be used from within them.
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

    def serve(self, srv_type: Any, name: str, handler: Callable[[Any, Any], None], **kwargs: Any) -> None:
        """Offer a service.

        Args:
            srv_type: Service class whose response has ``error_code`` and ``error_msg``.
            name: Name, relative to the namespace.
            handler: Called with (request, response); fills the response or raises.
            **kwargs: Passed to ``create_service``.
        """
        self.create_service(srv_type, name, functools.partial(self._handle, name, handler), **kwargs)

    def _handle(self, name: str, handler: Callable[[Any, Any], None], request: Any, response: Any) -> Any:
        with self.answering(name, response):
            handler(request, response)
        return response

    def answering(self, what: str, result: Any) -> ErrorAnswer:
        """Return a context manager that turns an exception into a result's ``error_code`` and ``error_msg``."""
        return ErrorAnswer(self, what, result)

    def declare_config(self, cls: type[C]) -> C:
        """Declare a parameter per field of a dataclass and return the resolved value.

        A field's metadata may give ``description``, ``range`` (lowest, highest) and ``read_only`` (default True).

        Args:
            cls: Frozen dataclass of bool, int, float, str and tuples of them, with defaults.

        Raises:
            ConfigError: When a parameter's value does not fit.
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


class ErrorAnswer:
    """Turns an exception into a result's ``error_code`` and ``error_msg``; logs what nobody expected."""

    def __init__(self, node: Node, what: str, result: Any) -> None:
        """Remember where to put the answer."""
        self._node, self._what, self._result = node, what, result

    def __enter__(self) -> ErrorAnswer:
        """Return itself."""
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool:
        """Fill the result; swallow every `Exception`."""
        if error is None:
            return False
        if not isinstance(error, Exception):
            return False
        if isinstance(error, RoboximError):
            self._result.error_code = int(error.code)
            self._result.error_msg = str(error)
            self._node.get_logger().info(f"{self._what}: {error.code.name}: {error}")
        else:
            self._result.error_code = int(ErrorCode.INTERNAL)
            self._result.error_msg = f"{type(error).__name__} in {self._what}: {error}"
            self._node.get_logger().error(f"{self._what}:\n{''.join(traceback.format_exception(error))}")
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
