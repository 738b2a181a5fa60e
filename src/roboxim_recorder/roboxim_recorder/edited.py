"""Copies bags with edited messages. All other messages stay byte for byte, without decoding; times and order stay."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from mcap.reader import SeekingReader

from roboxim_core.errors import RecorderError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, damage
from roboxim_recorder.bag_writer import BagWriter
from roboxim_ros.messages.schemas import MessageSchema

Edit = Callable[[str, Any], None]
"""Changes a decoded message of a topic in place."""


def copy_edited(source: Path, out: Path, edited: Collection[str], edit: Edit, *, episode_id: str = "") -> Path:
    """Copy a bag into a run's folder, with edited messages.

    Non-obvious: a notice names the checksums of its tick's images. It is written again after they are known, so the
    copy passes `check_bag`, however the edit changes images.

    Args:
        source: The bag.
        out: Folder of the run, absolute.
        edited: Topics whose messages are decoded and given to ``edit``.
        edit: Changes a message.
        episode_id: Id of the copy; empty: that of the source. Another id needs edits of every message that has one.

    Returns:
        The new bag.

    Raises:
        RecorderError: When the source is damaged, the episode exists, or the copy cannot be written.
    """
    reader = BagReader(source)
    name = episode_id or reader.info.episode_id
    writer = BagWriter(out, name)
    try:
        _copy(reader, writer, {*edited, topics.NOTICE}, edit)
    except BaseException:
        with contextlib.suppress(RecorderError):
            writer.drop()
        raise
    own = {"format_version", "episode_id"}
    metadata = {key: value for key, value in reader.metadata.items() if key not in own}
    if topics.INFO in edited and "instruction" in metadata:
        metadata["instruction"] = _instruction(reader, edit)
    return out / writer.close("keep", metadata)


def _copy(reader: BagReader, writer: BagWriter, decoded: set[str], edit: Edit) -> None:
    _announce(reader, writer)
    checksums: dict[str, int] = {}
    for tick in _ticks(reader):
        made: list[tuple[str, bytes, int]] = []
        for topic, data, stamp in tick:
            if topic in decoded and topic != topics.NOTICE:
                message = reader.decode(topic, data)
                edit(topic, message)
                if hasattr(message, "encoding") and hasattr(message, "data"):
                    checksums[topic] = zlib.crc32(message.data.tobytes())
                data = reader.encode(topic, message)
            made.append((topic, data, stamp))
        for topic, written, stamp in made:
            if topic == topics.NOTICE:
                notice = reader.decode(topic, written)
                edit(topic, notice)
                notice.image_crc32 = notice.image_crc32.copy()
                for place, named in enumerate(notice.topics):
                    if topics.absolute(named) in checksums:
                        notice.image_crc32[place] = checksums[topics.absolute(named)]
                written = reader.encode(topic, notice)
            writer.write(topic, written, stamp)
        checksums.clear()
        writer.flush()


def _announce(reader: BagReader, writer: BagWriter) -> None:
    """Announce every topic of the source, also those without messages."""
    with damage(reader.path), reader.file.open("rb") as stream:
        summary = SeekingReader(stream, validate_crcs=True).get_summary()
        assert summary is not None, "the reader has opened it"
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id):
            schema = summary.schemas[channel.schema_id]
            writer.add_topic(channel.topic, MessageSchema(name=schema.name, text=schema.data.decode()))


def _ticks(reader: BagReader) -> Iterator[list[tuple[str, bytes, int]]]:
    """Yield topic, message and stamp [ns] of the messages of a tick together, a notice first."""
    found: list[tuple[str, bytes, int]] = []
    with damage(reader.path), reader.file.open("rb") as stream:
        for _, channel, message in SeekingReader(stream, validate_crcs=True).iter_messages():
            if channel.topic == topics.NOTICE and found:
                yield found
                found = []
            found.append((channel.topic, message.data, message.log_time))
    yield found


def _instruction(reader: BagReader, edit: Edit) -> str:
    for topic, _, message in reader.messages((topics.INFO,)):
        edit(topic, message)
        return str(message.task.instruction)
    return reader.info.task.instruction
