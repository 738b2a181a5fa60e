"""An executor that does less between two callbacks than rclpy's, for nodes that answer a few requests per tick."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Task


class LockstepExecutor(SingleThreadedExecutor):
    """A `SingleThreadedExecutor` that does not wake itself after each callback.

    rclpy's executors trigger a guard condition when a callback has ended, so that another thread sees that the
    callback's group is free again. A single thread looks at the groups again anyway. The trigger would make it build
    its wait set a second time, while it keeps the interpreter from the node whose turn it is.
    """

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
