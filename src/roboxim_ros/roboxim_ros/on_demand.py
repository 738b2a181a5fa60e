"""Subscriptions that are served only on request: messages wait in the middleware's queue until then.

Waking an executor for every message is expensive. A node that needs a tick's messages together, or only sometimes the
newest message, takes them when it needs them.
"""

from __future__ import annotations

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.subscription import Subscription


class OnDemandGroup(MutuallyExclusiveCallbackGroup):
    """A callback group whose subscriptions wake no executor, unless it is ``open``.

    A subscription's queue keeps the newest messages, as deep as its QoS; choose the depth by the number of messages
    that `take` needs.
    """

    def __init__(self) -> None:
        """Start closed."""
        super().__init__()
        self.open = False
        """Whether executors serve the subscriptions like any others. After setting it in a thread other than the
        executor's, call the executor's ``wake()``."""

    def can_execute(self, entity: object) -> bool:
        """Return whether an executor may run a callback."""
        return self.open and super().can_execute(entity)

    def take(self) -> None:
        """Run the callbacks of all arrived messages in the calling thread, except those that an executor is running."""
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
