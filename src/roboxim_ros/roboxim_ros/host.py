"""Runs nodes in this process: one context, one executor thread per node, an orderly shutdown.

Used by the runner, by every separately started node, and by tests (`roboxim_ros.testing`).
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from roboxim_core.closing import Closing
from roboxim_ros.lockstep_executor import LockstepExecutor
from roboxim_ros.runs import activate_transport
from roboxim_ros.spinning import spin

N = TypeVar("N", bound=Node)
ENDING_S = 60.0
"""Longest time for a node to finish its current callback at shutdown [s]."""
SWITCH_INTERVAL_S = 0.001
"""Longest time that a node's thread holds the interpreter while another thread waits for it [s]; Python's default is
0.005."""


class NodeHost(Closing):
    """A context with nodes, each spun by its own thread. A context manager."""

    def __init__(self, *, domain_id: int | None = None, args: Sequence[str] = ()) -> None:
        """Initialise a context.

        ``ROBOXIM_TRANSPORT`` sets who can reach its nodes; by default, only this user on this machine.

        Args:
            domain_id: ROS domain; none: the environment's.
            args: ROS arguments, e.g. ``["--ros-args", "--params-file", FILE]``.
        """
        activate_transport()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self.context = Context()
        rclpy.init(
            args=list(args),
            context=self.context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._running: list[tuple[Node, Executor, threading.Thread]] = []

    def add(self, make: Callable[[Context], N]) -> N:
        """Make a node and spin it.

        The node is made in the thread that spins it, because a GL context belongs to the thread that made it. A node
        with an attribute ``executor_threads`` above 1 gets a `MultiThreadedExecutor`.

        Args:
            make: Makes the node from the context.

        Raises:
            Exception: As ``make`` raises it.
        """
        ready = threading.Event()
        made: list[N] = []
        failed: list[BaseException] = []
        executors: list[Executor] = []

        def run() -> None:
            try:
                made.append(make(self.context))
                executors.append(_executor(made[0], self.context))
                executors[0].add_node(made[0])
            except BaseException as error:  # raised in the caller below
                failed.append(error)
                return
            finally:
                ready.set()
            try:
                spin(executors[0], made[0])
            finally:
                made[0].destroy_node()

        thread = threading.Thread(target=run, name="node", daemon=True)
        thread.start()
        ready.wait()
        if failed:
            thread.join()
            raise failed[0]
        thread.name = made[0].get_name()
        self._running.append((made[0], executors[0], thread))
        return made[0]

    def alive(self) -> bool:
        """Return whether every node still spins."""
        return not self.dead()

    def dead(self) -> list[str]:
        """Return the names of the nodes that no longer spin."""
        return [thread.name for _, _, thread in self._running if not thread.is_alive()]

    def close(self) -> None:
        """Stop every node in reverse order, then shut the context down."""
        for _, executor, _ in reversed(self._running):
            executor.shutdown(timeout_sec=0)
        for _, executor, thread in reversed(self._running):
            executor.wake()
            thread.join(timeout=ENDING_S)
        self._running.clear()
        if self.context.ok():
            self.context.shutdown()


def _executor(node: Node, context: Context) -> Executor:
    """Return a node's executor: one thread, unless the node has ``executor_threads``."""
    threads = getattr(node, "executor_threads", 1)
    if threads == 1:
        return LockstepExecutor(context=context)
    return MultiThreadedExecutor(threads, context=context)


def wait_for_stop(
    should_stop: Callable[[], bool] = lambda: False,
    *,
    period_s: float = 0.2,
    on_waiting: Callable[[], None] = lambda: None,
) -> int:
    """Block until SIGINT, SIGTERM or ``should_stop``.

    Args:
        should_stop: Called every period; true ends the wait.
        period_s: The period [s].
        on_waiting: Called once when signals are handled, e.g. to report that the process is ready for them.

    Returns:
        The signal's number, or 0.
    """
    stop = threading.Event()
    received = [0]

    def handler(number: int, _: FrameType | None) -> None:
        received[0] = number
        stop.set()

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        on_waiting()
        while not stop.wait(period_s) and not should_stop():
            pass
    finally:
        for number, old in before.items():
            signal.signal(number, old)
    return received[0]
