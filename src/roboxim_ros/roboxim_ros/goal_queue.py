"""Goals that are executed one after another. A waiting goal occupies no thread, so that the node stays responsive."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.action.server import ServerGoalHandle


class GoalQueue:
    """Executes the goals of one or several action servers in the order of their arrival."""

    def __init__(self) -> None:
        """Start empty."""
        self._lock = threading.Lock()
        self._waiting: deque[ServerGoalHandle] = deque()
        self._busy = False

    def add(self, goal: ServerGoalHandle) -> None:
        """Execute an accepted goal when those before it have ended."""
        with self._lock:
            self._waiting.append(goal)
            if self._busy:
                return
            self._busy = True
        self._begin_next()

    def in_turn(self, execute: Callable[[ServerGoalHandle], Any]) -> Callable[[ServerGoalHandle], Any]:
        """Return an execute callback, not a coroutine function, that begins the next goal when it has ended."""

        def call(goal: ServerGoalHandle) -> Any:
            try:
                return execute(goal)
            finally:
                self._begin_next()

        return call

    def _begin_next(self) -> None:
        with self._lock:
            self._busy = bool(self._waiting)
            goal = self._waiting.popleft() if self._waiting else None
        if goal is None:
            return
        try:
            goal.execute()
        except RCLError:  # it is being cancelled since a moment ago, which needs no change of its state
            goal.execute()
