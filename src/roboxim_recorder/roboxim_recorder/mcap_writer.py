"""Writes an MCAP file in compressed chunks, with the bytes that the writer of the package mcap would write.

The writer of the package encodes a message field by field, copies it four times and makes a compressor for every chunk.
In a worker, the simulator waits for the interpreter meanwhile. Here a message costs a header and two list entries;
joining, compressing and checking a chunk take one call each, which lets other threads run. The package encodes the
records that are rare in a file. `tests/test_mcap_writer.py` compares the bytes.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping
from functools import lru_cache
from typing import IO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from roboxim_recorder.cdr import Cdr

CHUNK_BYTES = 16 << 20
"""Size of a chunk's records at which it ends by itself."""
COMPRESSION = "zstd"
"""Compression of chunks, at its level 3."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence number, time of recording, time of publication."""
_MESSAGE_FIELDS = _MESSAGE.size - 9
"""Length of a message's record without its data."""
_CHUNK = struct.Struct(f"<BQQQQII{len(COMPRESSION)}sQ")
"""Opcode, length, first and last time, size and CRC-32 of the records, compression, size of the compressed records."""
_INDEX = struct.Struct("<BQHI")
"""Opcode, length, channel, size of the entries."""
_FOOTER_START = struct.Struct("<BQQQ")
"""The part of the footer that the summary's checksum covers."""


class McapWriter:
    """Writes an MCAP file with compressed chunks, indexes, statistics, a summary and checksums."""

    def __init__(self, stream: IO[bytes], *, profile: str, library: str) -> None:
        """Write the header.

        Args:
            stream: The file, at its beginning.
            profile: Profile that the file follows, e.g. ``ros2``.
            library: The program that writes it.
        """
        self._stream, self._at, self._crc = stream, 0, 0
        self._compressor = zstandard.ZstdCompressor()
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._counts: dict[int, int] = {}
        self.span = (0, 0)
        """Stamps of the first and the last message of the chunks that have ended [ns]."""
        self._chunk = _Chunk()
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._write(MAGIC + encoded(Header(profile, library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a message type; return its number.

        Args:
            name: Its full name.
            encoding: Format of its description, e.g. ``ros2msg``.
            data: The description.
        """
        number = len(self._schemas) + 1
        self._schemas.append(_schema(number, name, encoding, data))
        self._chunk.add(self._schemas[-1])
        return number

    def add_channel(self, topic: str, message_encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a topic; return its number.

        Args:
            topic: Its name.
            message_encoding: Encoding of its messages, e.g. ``cdr``.
            schema: Number of their type.
            metadata: Facts about it.
        """
        number = len(self._channels) + 1
        self._channels.append(_channel(number, topic, message_encoding, schema, tuple(metadata.items())))
        self._chunk.add(self._channels[-1])
        return number

    def add_message(self, channel: int, stamp_ns: int, data: Cdr, sequence: int) -> None:
        """Add a message.

        Args:
            channel: Number of its topic.
            stamp_ns: Time of recording and of publication [ns].
            data: The message; unchanged until its chunk ends.
            sequence: Number of earlier messages on the topic.
        """
        chunk = self._chunk
        chunk.add_message(channel, stamp_ns, data, sequence)
        if chunk.size > CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a record of metadata, before the chunk that has not ended."""
        record = encoded(Metadata(name=name, metadata=dict(metadata)))
        self._metadata_indexes.append(MetadataIndex(offset=self._at, length=len(record), name=name))
        self._write(record)

    def flush(self) -> None:
        """End the chunk, if it has messages, and hand everything to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """End the chunk and write the summary. The file stays open."""
        self._end_chunk()
        end = encoded(DataEnd(self._crc))
        self._write(end)
        start = self._at
        groups = {
            Opcode.SCHEMA: b"".join(self._schemas),
            Opcode.CHANNEL: b"".join(self._channels),
            Opcode.STATISTICS: encoded(self._statistics()),
            Opcode.CHUNK_INDEX: encoded(*self._chunk_indexes),
            Opcode.ATTACHMENT_INDEX: b"",
            Opcode.METADATA_INDEX: encoded(*self._metadata_indexes),
        }
        summary, offsets = b"", []
        for opcode, group in groups.items():
            offsets.append(
                SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(group))
            )
            summary += group
        offsets_start = start + len(summary)
        summary += encoded(*offsets)
        crc = zlib.crc32(_FOOTER_START.pack(Opcode.FOOTER, 8 + 8 + 4, start, offsets_start), zlib.crc32(summary))
        self._write(summary + encoded(Footer(start, offsets_start, crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=self.span[0],
            message_end_time=self.span[1],
            schema_count=len(self._schemas),
        )

    def _end_chunk(self) -> None:
        chunk = self._chunk
        if not chunk.entries:
            return
        self._chunk = _Chunk()
        records = b"".join(chunk.parts)
        compressed = self._compressor.compress(records)
        first, last = chunk.span()
        self.span = (min(first, self.span[0]), max(last, self.span[1])) if self._counts else (first, last)
        for channel, entries in chunk.entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
        crc, at = zlib.crc32(records), self._at
        length = _CHUNK.size - 9 + len(compressed)
        head = _CHUNK.pack(
            Opcode.CHUNK, length, first, last, len(records), crc, len(COMPRESSION), COMPRESSION.encode(),
            len(compressed),
        )  # fmt: skip
        indexes, index_at = chunk.indexes(), at + len(head) + len(compressed)
        offsets = {}
        for channel, index in indexes.items():
            offsets[channel] = index_at
            index_at += len(index)
        self._write(head, compressed, *indexes.values())
        self._chunk_indexes.append(
            ChunkIndex(
                message_start_time=first, message_end_time=last, chunk_start_offset=at, chunk_length=9 + length,
                message_index_offsets=offsets, message_index_length=sum(map(len, indexes.values())),
                compression=COMPRESSION, compressed_size=len(compressed), uncompressed_size=len(records),
            )
        )  # fmt: skip

    def _write(self, *parts: bytes) -> None:
        for part in parts:
            self._crc = zlib.crc32(part, self._crc)
            self._stream.write(part)
            self._at += len(part)


class _Chunk:
    """The records of a chunk that has not ended."""

    def __init__(self) -> None:
        self.parts: list[Cdr] = []
        self.entries: defaultdict[int, list[int]] = defaultdict(list)
        """Channel to the times and positions of its messages, alternately."""
        self.size = 0

    def add(self, record: bytes) -> None:
        self.parts.append(record)
        self.size += len(record)

    def add_message(self, channel: int, stamp_ns: int, data: Cdr, sequence: int) -> None:
        length = _MESSAGE_FIELDS + len(data)
        self.entries[channel] += (stamp_ns, self.size)
        self.parts += (_MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, stamp_ns, stamp_ns), data)
        self.size += 9 + length

    def span(self) -> tuple[int, int]:
        """Return the times of the first and the last message."""
        times = [time for entries in self.entries.values() for time in entries[::2]]
        return min(times), max(times)

    def indexes(self) -> dict[int, bytes]:
        """Return the record of the messages of each channel."""
        made = {}
        for channel, entries in self.entries.items():
            size = 8 * len(entries)
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, channel, size)
            made[channel] = head + struct.pack(f"<{len(entries)}Q", *entries)
        return made


@lru_cache(maxsize=256)
def _schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    """Return the record of a message type; made once, since bags share their types."""
    return encoded(Schema(id=number, name=name, encoding=encoding, data=data))


@lru_cache(maxsize=256)
def _channel(number: int, topic: str, encoding: str, schema: int, metadata: tuple[tuple[str, str], ...]) -> bytes:
    """Return the record of a topic; see `_schema`."""
    channel = Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(metadata))
    return encoded(channel)


def encoded(*records: McapRecord) -> bytes:
    """Return records one after the other, as the package mcap encodes them."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    return content
