"""Spinning that survives a failure of the middleware."""

from __future__ import annotations

from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node

from roboxim_ros.guard import CAUGHT, report

MAX_EXECUTOR_FAILURES = 10_000
"""Number of failures of the middleware after which a node ends, because their cause is permanent."""


def spin(executor: Executor, node: Node) -> None:
    """Spin until the executor or its context is shut down.

    Callbacks raise nothing (`roboxim_ros.guard`), but the middleware does, e.g. on a message of a wrong type or an
    answer to a disconnected action client. Such an error drops one message; the node keeps running.

    Args:
        executor: The executor.
        node: Its node, whose log takes the reports.
    """
    failures = 0
    while True:
        try:
            executor.spin()
            return
        except ExternalShutdownException:
            return
        except CAUGHT as error:
            if executor._is_shutdown:  # rclpy frees the guard conditions while this thread still waits for them
                return
            failures += 1
            report(node.get_logger(), error, f"the executor of '{node.get_name()}', failure {failures}")
            if failures >= MAX_EXECUTOR_FAILURES:
                raise
