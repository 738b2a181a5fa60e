"""Subscriptions that are heard only when somebody asks: what arrives meanwhile waits in the middleware's queue.

An executor that wakes for every message costs more than most messages are worth: a node that needs a tick's messages
together, or only the newest now and then, takes them when it needs them.
"""

from __future__ import annotations

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.subscription import Subscription


class OnDemandGroup(MutuallyExclusiveCallbackGroup):
    """A callback group whose subscriptions no executor wakes for, unless it is ``open``.

    A subscription's queue keeps the newest messages, as deep as its QoS; choose the depth by what `take` must find.
    """

    def __init__(self) -> None:
        """Start closed."""
        super().__init__()
        self.open = False
        """Whether executors serve the subscriptions as they do others. After opening it from a thread that is not
        the executor's, call the executor's ``wake()``."""

    def can_execute(self, entity: object) -> bool:
        """Tell whether an executor may run a callback."""
        return self.open and super().can_execute(entity)

    def take(self) -> None:
        """Run the callbacks of what has arrived, in the calling thread, but for what an executor runs just now."""
        for reference in list(self.entities):
            subscription = reference()
            if isinstance(subscription, Subscription) and self.beginning_execution(subscription):
                try:
                    _take(subscription)
                finally:
                    self.ending_execution(subscription)


def _take(subscription: Subscription) -> None:
    with_info = subscription._callback_type is Subscription.CallbackType.WithMessageInfo
    while True:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        subscription.callback(*(taken if with_info else taken[:1]))
