"""Messages are read as the package mcap reads them, whatever the chunks look like."""

from __future__ import annotations

from dataclasses import replace

import pytest
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer

from roboxim_recorder.chunks import read_messages

STAMPS = {"sorted": [0, 1, 1, 2, 3, 5], "unsorted": [2, 0, 3, 1, 5, 4]}


@pytest.fixture(params=[(order, kind) for order in STAMPS for kind in (CompressionType.ZSTD, CompressionType.NONE)])
def file(request, tmp_path):
    """A file of small chunks with two topics."""
    order, compression = request.param
    path = tmp_path / "some.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=150, compression=compression)
        writer.start()
        channels = [writer.register_channel(topic, "cdr", 0) for topic in ("/a", "/b")]
        for number, stamp in enumerate(STAMPS[order]):
            for channel in channels:
                writer.add_message(channel, stamp, bytes([number, channel]) * 20, stamp)
        writer.finish()
    return path


@pytest.mark.parametrize("topics", [None, ("/b",), ()])
def test_messages_are_those_of_the_library(file, topics):
    with file.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        expected = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages(topics=topics)]
        found = [(c.topic, stamp, data) for c, stamp, data in read_messages(stream, reader.get_summary(), topics)]
    assert found == expected
    assert len(found) == {None: 12, ("/b",): 6, (): 0}[topics]


def test_a_wrong_chunk_is_refused(fake, tmp_path):
    path = next(fake().record(tmp_path).glob("*.mcap"))
    with path.open("rb") as stream:
        summary = SeekingReader(stream).get_summary()
        first = summary.chunk_indexes[0]
        for wrong in (
            replace(first, chunk_start_offset=first.chunk_start_offset + 1),
            replace(first, chunk_length=first.chunk_length - 200),
        ):
            summary.chunk_indexes[0] = wrong
            with pytest.raises(ValueError, match="chunk"):
                list(read_messages(stream, summary))
