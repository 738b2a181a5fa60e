"""An executor that does less between two callbacks than rclpy's, for nodes that answer a few requests per tick.

It also runs calls that other threads of the process post directly (`LockstepExecutor.post`), without a wait set.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Task

LOOK_S = 0.5
"""Longest time for which an executor in lockstep leaves the middleware unserved [s]."""


class Posted(Protocol):
    """A call that a thread posts to an executor."""

    @property
    def lockstep(self) -> bool:
        """Whether others follow soon, so that the executor waits for them instead of at the middleware."""

    def __call__(self) -> None:
        """Run it, in the executor's thread."""

    def abandon(self) -> None:
        """Drop it: the executor has been shut down."""


class LockstepExecutor(SingleThreadedExecutor):
    """A `SingleThreadedExecutor` that does not wake itself after each callback, and takes posts of this process.

    rclpy's executors trigger a guard condition when a callback has ended, so that another thread sees that the
    callback's group is free again. A single thread checks the groups again anyway. The trigger would make it build its
    wait set a second time, while the next node waits for the interpreter.

    After a post in lockstep the executor waits for the next one, which costs a lock instead of a wait set, and checks
    the middleware only every `LOOK_S`.
    """

    def __init__(self, *, context: Context) -> None:
        """Start without posts."""
        self._posts: deque[Posted] = deque()
        self._changed = threading.Condition(threading.Lock())
        self._at_middleware = False  # a post must trigger the guard condition
        self._look_by = 0.0
        self._expects_post = False
        self._closed = False
        super().__init__(context=context)

    def post(self, call: Posted) -> bool:
        """Let the executor's thread run a call; may be used by any thread.

        Returns:
            Whether it was accepted (it then runs or is abandoned); false: the executor has been shut down.
        """
        with self._changed:
            if self._closed:
                return False
            self._posts.append(call)
            if not self._at_middleware:
                self._changed.notify()
                return True
        self._trigger()
        return True

    def look(self) -> None:
        """Make the executor wait at the middleware instead of for the next post; may be used by any thread."""
        with self._changed:
            self._look_by = 0.0
            self._changed.notify()

    def wake(self) -> None:
        """Make the executor check for new entities and tasks; may be used by any thread."""
        self.look()
        super().wake()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Run a callback or a coroutine in the executor's thread, as rclpy does."""
        task = super().create_task(callback, *args, **kwargs)
        self.wake()
        return task

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop; posts that have not begun are abandoned."""
        with self._changed:
            self._closed = True
            left, self._posts = self._posts, deque()
            self._changed.notify()
        for call in left:
            call.abandon()
        return bool(super().shutdown(timeout_sec))

    def _spin_once_impl(self, timeout_sec: Any = None, wait_condition: Callable[[], bool] | None = None) -> None:
        if timeout_sec is not None or wait_condition is not None:
            super()._spin_once_impl(timeout_sec, wait_condition or (lambda: False))
            return
        call = self._next_post()
        if call is not None:
            call()
            return
        try:
            if self._at_middleware:
                super()._spin_once_impl(None, self._has_posts)
            else:
                super()._spin_once_impl(0.0)
        finally:
            self._at_middleware = False
            self._look_by = time.monotonic() + LOOK_S

    def _next_post(self) -> Posted | None:
        """Return the next post; None: time to check the middleware, and to wait there if there is no post."""
        with self._changed:
            while not self._posts and self._expects_post and not self._closed and not self._unfinished():
                left = self._look_by - time.monotonic()
                if left <= 0 or not self._changed.wait(left):
                    break
            if self._posts and time.monotonic() < self._look_by:
                call = self._posts.popleft()
                self._expects_post = self._expects_post or call.lockstep
                return call
            self._expects_post = False
            self._at_middleware = not self._posts
            return None

    def _unfinished(self) -> bool:
        """Return whether a coroutine waits for its turn."""
        return any(not task.done() for task, _, _ in self._tasks)

    def _has_posts(self) -> bool:
        return bool(self._posts)

    def _trigger(self) -> None:
        guard = self._guard
        if guard:
            with contextlib.suppress(rclpy_implementation.InvalidHandle):  # it was shut down meanwhile
                guard.trigger()

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Callable[[Any], Any]) -> Task:
        entity._executor_event = True

        async def handle() -> None:
            if self._is_shutdown or not entity.callback_group.beginning_execution(entity):
                entity._executor_event = False
                self._guard.trigger()
                return
            with self._work_tracker:
                call = take_from_wait_list(entity)
                entity._executor_event = False
                try:
                    if call is not None:
                        await call()
                finally:
                    entity.callback_group.ending_execution(entity)

        task = Task(handle, executor=self)
        with self._tasks_lock:
            self._tasks.append((task, entity, node))
        return task
