from __future__ import annotations

import threading

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from roboxim_ros import qos
from roboxim_ros.clients import wait_until
from roboxim_ros.on_demand import OnDemandGroup
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


class Listener(Node):
    """A node with one subscription on demand and one ordinary subscription."""

    def __init__(self, context):
        super().__init__("listener", context=context)
        self.group, self.heard, self.marks = OnDemandGroup(), [], []
        self.opened = threading.Event()
        self.create_subscription(
            String, "quiet", lambda m: self.heard.append(m.data), qos.EVENTS, callback_group=self.group
        )
        self.create_subscription(String, "mark", lambda m: self.marks.append(m.data), qos.EVENTS)


def test_messages_wait_until_they_are_taken(graph_host):
    listener = graph_host.add(Listener)
    talker = graph_host.add(lambda context: Node("talker", context=context))
    quiet = talker.create_publisher(String, "quiet", qos.EVENTS)
    mark = talker.create_publisher(String, "mark", qos.EVENTS)
    for text in "abc":
        quiet.publish(String(data=text))
    for text in "xyz":
        mark.publish(String(data=text))
    assert wait_until(lambda: listener.marks == ["x", "y", "z"], PATIENCE_S)
    assert listener.heard == []
    assert wait_until(lambda: listener.group.take() or len(listener.heard) == 3, PATIENCE_S)
    assert listener.heard == ["a", "b", "c"]

    listener.group.open = True
    listener.executor.wake()
    quiet.publish(String(data="d"))
    assert wait_until(lambda: listener.heard[-1] == "d", PATIENCE_S)
    listener.group.open = False
    quiet.publish(String(data="e"))
    mark.publish(String(data="end"))
    assert wait_until(lambda: listener.marks[-1] == "end", PATIENCE_S)
    listener.group.take()
    assert wait_until(lambda: listener.group.take() or listener.heard[-1] == "e", PATIENCE_S)
