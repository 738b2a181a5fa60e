"""Records topics of a running graph as they come, whatever controls the robot. The bag is not an episode."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Protocol

from roboxim_core.errors import ConfigError
from roboxim_recorder.bag_writer import McapFile, disk_errors
from roboxim_recorder.cdr import MessageLayout, message_layout
from roboxim_ros.messages.schemas import message_schema

FLUSH_S = 2.0
"""Longest time for which messages are only in memory [s]."""


class Graph(Protocol):
    """A node in a graph, e.g. `roboxim_bringup.attach.Peer`."""

    node: Any
    """The rclpy node."""

    def topics(self) -> dict[str, list[str]]:
        """Return topic to types."""
        ...

    def wake(self) -> None:
        """Let the node serve a new subscription."""
        ...


class LiveRecording:
    """A growing bag. A context manager: the bag is complete at its end. Messages arrive in the node's thread.

    A message's time is that of its reception by the middleware, as in bags of ``ros2 bag record``. The node's thread
    may take it much later, when the machine is busy.
    """

    def __init__(self, folder: Path, look_up: Callable[[str], Any], topics: Collection[str] = ()) -> None:
        """Make the bag.

        Args:
            folder: Its folder, which must not exist.
            look_up: Returns the class of a message type's name, or raises a ConfigError.
            topics: Topics to record; none: all.

        Raises:
            RecorderError: ``DISK`` when the folder cannot be made.
        """
        with disk_errors(folder):
            self._file = McapFile(folder, folder.name)
        self._folder, self._wanted, self._look_up = folder, set(topics), look_up
        self._arrived: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._subscriptions: dict[str, Any] = {}
        self._schemas: dict[str, Any] = {}
        self._layouts: dict[str, MessageLayout] = {}
        self._flushed = time.monotonic()
        self.left_out: list[str] = []
        """Topics that cannot be recorded, with the reason."""

    @property
    def counts(self) -> dict[str, int]:
        """Topic to number of recorded messages."""
        return dict.fromkeys(self._layouts, 0) | self._file.counts

    def listen(self, graph: Graph) -> None:
        """Subscribe to the topics that are new in the graph."""
        from roboxim_ros.qos import offered

        for topic, types in graph.topics().items():
            if topic in self._subscriptions or (self._wanted and topic not in self._wanted):
                continue
            self._subscriptions[topic] = None
            try:
                cls, schema = self._look_up(types[0]), message_schema(types[0])
            except (ConfigError, ImportError, AttributeError, ValueError) as error:
                self.left_out.append(f"{topic} of type {types[0]}: {error}")
                continue
            qos = offered(graph.node, topic, 1000)
            self._schemas[topic] = schema
            self._layouts[topic] = message_layout(schema)

            def take(data: bytes, info: dict[str, Any], topic: str = topic) -> None:
                self._arrived.put((topic, info["received_timestamp"], bytes(data)))

            self._subscriptions[topic] = graph.node.create_subscription(cls, topic, take, qos, raw=True)
            graph.wake()

    def write(self) -> None:
        """Write what has arrived.

        Raises:
            RecorderError: ``DISK`` when it cannot be written.
        """
        with disk_errors(self._folder):
            while not self._arrived.empty():
                topic, stamp_ns, data = self._arrived.get()
                if topic not in self._file.counts:  # a silent topic is no part: it would look like a lost episode's
                    self._file.add_topic(topic, self._schemas[topic])
                self._file.write(topic, self._layouts[topic].clean(data).data, stamp_ns)
            if time.monotonic() - self._flushed > FLUSH_S:
                self._file.flush()
                self._flushed = time.monotonic()

    def close(self, graph: Graph) -> None:
        """Stop listening."""
        for subscription in self._subscriptions.values():
            if subscription is not None:
                graph.node.destroy_subscription(subscription)

    def __enter__(self) -> LiveRecording:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write the rest, the index and ``metadata.yaml``."""
        self.write()
        with disk_errors(self._folder):
            self._file.finish({})
