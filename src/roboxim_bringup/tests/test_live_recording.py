"""A recording of a running graph."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from mcap.reader import make_reader
from rclpy.node import Node
from std_msgs.msg import String

from roboxim_bringup.live_recording import LiveRecording
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.testing import eventually, graph_host  # noqa: F401

pytestmark = pytest.mark.ros


class Peer:
    """A node in the graph with one topic."""

    def __init__(self, clients):
        self.node, self.wake = clients.node, clients.wake

    def topics(self):
        return {"/said": ["std_msgs/msg/String"]}


def test_messages_have_the_times_of_their_reception(graph_host, tmp_path):  # noqa: F811
    """The thread that takes them is busy meanwhile, as on a slow machine; bag play would send them all at once."""
    node = graph_host.add(lambda context: Node("talker", context=context))
    said = node.create_publisher(String, "/said", qos.EVENTS)
    with Clients("listener", context=graph_host.context) as clients:
        peer = Peer(clients)
        eventually(lambda: clients.node.get_publishers_info_by_topic("/said"))
        with LiveRecording(tmp_path / "bag", lambda _: String) as recording:
            recording.listen(peer)
            said.publish(String(data="0"))
            eventually(lambda: (recording.write(), recording.counts["/said"])[1] == 1)
            free = threading.Event()
            busy = threading.Thread(target=clients.in_thread, args=(free.wait,))
            busy.start()
            for number in range(1, 4):
                time.sleep(0.1)
                said.publish(String(data=str(number)))
            free.set()
            busy.join()
            eventually(lambda: (recording.write(), recording.counts["/said"])[1] == 4)
            recording.close(peer)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert np.diff(times).min() > 50e6
