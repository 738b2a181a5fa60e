"""Decodes the messages of a bag with the definitions that the bag holds; no ROS is needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from roboxim_core.episode import EpisodeResult
from roboxim_recorder.cdr import MessageLayout, message_layout
from roboxim_ros.messages.packing import packer
from roboxim_ros.messages.schemas import MessageSchema, typestore


class Decoder:
    """Decodes the messages of a bag's topics; `bag.damage` converts the errors of a message of another type."""

    def __init__(self, schemas: Mapping[str, MessageSchema]) -> None:
        """Prepare to decode.

        Args:
            schemas: Topic to schema.
        """
        self._schemas = dict(schemas)
        self._store = typestore(self._schemas.values())
        self.types = {topic: schema.name for topic, schema in self._schemas.items()}
        """Topic to message type."""

    def decode(self, topic: str, cdr: bytes | memoryview) -> Any:
        """Decode a message of a topic; its arrays share the memory of ``cdr``."""
        return self._store.deserialize_cdr(memoryview(cdr), self.types[topic])

    def encode(self, topic: str, message: Any) -> bytes:
        """Serialise a message of a topic that `decode` returned, e.g. after a change."""
        return bytes(self._store.serialize_cdr(message, self.types[topic]))

    def layout(self, topic: str) -> MessageLayout:
        """Return the CDR layout of a topic's messages."""
        return message_layout(self._schemas[topic])

    def encode_result(self, topic: str, result: EpisodeResult) -> bytes:
        """Serialise an episode's result as a message of a topic."""
        return bytes(packer(type(result), self.types[topic], self._store)(result))
