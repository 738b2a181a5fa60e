"""The newest pictures of an episode that is still being recorded, read from its bag as it grows.

A bag is written in complete chunks of a few ticks, so a reader needs no index and does not disturb the recorder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, Message, Schema

from roboxim_core.errors import RoboximError
from roboxim_recorder.bag import damage
from roboxim_recorder.bag_writer import PARTIAL
from roboxim_recorder.decoding import Decoder
from roboxim_recorder.integrity.salvage import SalvagedChunk, salvage
from roboxim_recorder.topics import IMAGE, STATE, image_topic
from roboxim_ros.messages.conversions import image_from_msg
from roboxim_ros.messages.schemas import MessageSchema

Picture = npt.NDArray[np.uint8]
MAX_BYTES = 1 << 26
"""Bytes that are read at once; an episode that grew by more shows its newest pictures at the next look."""
_BEFORE, _AFTER = image_topic("|").split("|")


class Unfinished:
    """One episode that is being recorded."""

    def __init__(self, bag: Path) -> None:
        """Follow a bag.

        Args:
            bag: Its folder, in the run's folder of unfinished bags.
        """
        self.name = bag.name
        """Id of the episode."""
        self.ticks = 0
        """Number of its ticks that have been written."""
        self._bag, self._at = bag, 0
        self._schemas: dict[int, MessageSchema] = {}
        self._channels: dict[int, Channel] = {}
        self._newest: dict[str, bytes] = {}
        self._decoders: dict[str, Decoder] = {}
        self._decoded: dict[str, tuple[bytes, Picture]] = {}

    def read(self) -> None:
        """Read what was written since the last time; a bag that has been finished or moved meanwhile adds nothing."""
        file = next(iter(self._bag.glob("*.mcap")), None)
        if file is None:
            return
        try:
            with open(file, "rb") as stream:
                stream.seek(self._at)
                data = stream.read(MAX_BYTES)
        except OSError:
            return
        read = 0
        for part in salvage(data):
            if isinstance(part, SalvagedChunk):
                read = part.end
                for record in part.records:
                    self._take(record)
        self._at += read

    def _take(self, record: Schema | Channel | Message) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = MessageSchema(name=record.name, text=record.data.decode())
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif (channel := self._channels.get(record.channel_id)) is not None:
            self.ticks += channel.topic == STATE
            if self._schemas[channel.schema_id].name == IMAGE:
                self._newest[channel.topic] = record.data

    def picture(self, camera: str = "") -> Picture | None:
        """Return the newest picture of a camera, uint8, shape (height, width, 3); the same array until one is newer.

        Args:
            camera: Its name; empty: the first one that was recorded.

        Returns:
            None before the first chunk, or when the picture cannot be decoded.
        """
        topic = image_topic(camera) if camera else next(filter(_is_picture, self._newest), "")
        data = self._newest.get(topic)
        if data is None:
            return None
        if topic not in self._decoded or self._decoded[topic][0] is not data:
            if topic not in self._decoders:
                schema = next(self._schemas[one.schema_id] for one in self._channels.values() if one.topic == topic)
                self._decoders[topic] = Decoder({topic: schema})
            try:
                with damage(self._bag):
                    picture = image_from_msg(self._decoders[topic].decode(topic, data))
            except RoboximError:
                return None
            self._decoded[topic] = data, picture
        return self._decoded[topic][1]


def _is_picture(topic: str) -> bool:
    """Return whether a topic of images is that of a camera's colours, not of its depth."""
    return topic == image_topic(topic.removeprefix(_BEFORE).removesuffix(_AFTER))


class Growing:
    """The episodes that are being recorded in some runs."""

    def __init__(self) -> None:
        """Follow nothing yet."""
        self._known: dict[Path, Unfinished] = {}

    def look(self, runs: list[Path]) -> tuple[Unfinished, ...]:
        """Return the episodes that are being recorded now, with what is written of them, by name."""
        there = [bag for run in runs for bag in sorted((run / PARTIAL).glob("*")) if bag.is_dir()]
        self._known = {bag: self._known.get(bag) or Unfinished(bag) for bag in there}
        for episode in self._known.values():
            episode.read()
        return tuple(self._known.values())
