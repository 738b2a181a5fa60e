"""The writer of MCAP files against that of the package mcap."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from roboxim_recorder import mcap_writer
from roboxim_recorder.mcap_writer import McapWriter

SCHEMAS = (("a/msg/A", b"int32 x"), ("b/msg/B", b""))
CHANNELS = (("/a", 1), ("/b", 2), ("/again", 1))
Write = Callable[[Any], None]
"""Calls `add_message`, `flush` and so on of one of the two writers, under the names of ours."""


class Package:
    """The package's writer with our methods."""

    def __init__(self, stream: io.BytesIO, chunk_size: int) -> None:
        self._writer = Writer(stream, chunk_size=chunk_size, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="roboxim")
        self.flush = self._writer.flush
        self.add_schema = self._writer.register_schema
        self.add_channel = self._writer.register_channel
        self.add_metadata = self._writer.add_metadata
        self.finish = self._writer.finish

    def add_message(self, channel: int, stamp_ns: int, data: bytes, sequence: int) -> None:
        self._writer.add_message(channel, stamp_ns, bytes(data), stamp_ns, sequence)


def _announce(writer: Any) -> None:
    for name, data in SCHEMAS:
        writer.add_schema(name, "ros2msg", data)
    for topic, schema in CHANNELS:
        writer.add_channel(topic, "cdr", schema, {"offered_qos_profiles": "ä", "topic_type_hash": topic})


def _nothing(writer: Any) -> None:
    """A file without messages."""


def _only_metadata(writer: Any) -> None:
    _announce(writer)
    writer.flush()
    writer.add_metadata("empty", {})


def _chunks(writer: Any) -> None:
    """Several chunks, topics announced late, metadata before the last chunk, as in a bag."""
    _announce(writer)
    random = np.random.default_rng(1)
    writer.add_message(1, 0, b"", 0)
    writer.flush()
    for tick in range(9):
        for channel in (3, 1, 2):
            data = random.integers(0, 4, 3000, np.uint8)
            writer.add_message(channel, tick * 50_000_000, memoryview(data), tick)  # type: ignore[arg-type]
        if tick % 4 == 0:
            writer.flush()
            writer.flush()
    writer.add_channel("/late", "cdr", 2, {})
    writer.add_message(4, 1, bytearray(b"earlier than those before it"), 0)
    writer.add_metadata("roboxim", {"outcome": "success", "": "ü"})


@pytest.mark.parametrize("size", [16 << 20, 2000])
@pytest.mark.parametrize("write", [_nothing, _only_metadata, _chunks])
def test_bytes_of_the_package(write: Write, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", size)
    ours, theirs = io.BytesIO(), io.BytesIO()
    for writer in (McapWriter(ours, profile="ros2", library="roboxim"), Package(theirs, size)):
        write(writer)
        writer.finish()
    assert ours.getvalue() == theirs.getvalue()


def test_readable() -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, profile="ros2", library="roboxim")
    _chunks(writer)
    writer.finish()
    stream.seek(0)
    messages = list(make_reader(stream, validate_crcs=True).iter_messages())
    assert [message.log_time for _, _, message in messages][-3:] == [400_000_000] * 3
    assert len(messages) == 1 + 9 * 3 + 1
    assert writer.span == (0, 400_000_000)


def test_flushed_chunks_are_in_the_stream() -> None:
    """A killed process loses only what came after the last flush."""
    stream = io.BytesIO()
    writer = McapWriter(stream, profile="ros2", library="roboxim")
    _announce(writer)
    writer.add_message(1, 5, b"kept", 0)
    before = len(stream.getvalue())
    writer.flush()
    after = len(stream.getvalue())
    writer.add_message(1, 6, b"lost", 1)
    assert before < after == len(stream.getvalue())
