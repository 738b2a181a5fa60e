"""Reads the wanted messages of an MCAP file, in the order of their times.

The reader of the package mcap makes an object and several copies of every message of a chunk, also of unwanted ones. A
bag consists mostly of images, so this took a third of the reading time.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from operator import itemgetter
from typing import IO

import zstandard
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

StampedMessage = tuple[Channel, int, memoryview]
"""Channel, time of recording [ns] and serialised message, which shares the memory of its chunk (about 1.5 MB)."""
RECORD = struct.Struct("<BQ")
"""Opcode and length of any record."""
_CHUNK = struct.Struct("<QQQI")  # first time, last time, size and CRC-32 of the records
_LENGTH, _LONG_LENGTH = struct.Struct("<I"), struct.Struct("<Q")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence number, time of recording, time of publishing
_ZSTD = "zstd"
LARGEST_CHUNK = 1 << 29
"""Largest decompressed chunk that is read [B]. Recorders write chunks of a megabyte; one message fits in any case."""
_FRAME_BYTES = 18
"""Length of the header of a compressed frame, which may hold the size of its content [B]."""
_LZ4_SIZED = 0x08
"""Bit of an lz4 frame's fifth byte: the header holds the size."""


def read_messages(
    stream: IO[bytes], summary: Summary, topics: Collection[str] | None = None
) -> Generator[StampedMessage, None, None]:
    """Yield messages in the order of their times of recording, those of equal times in the order of the file.

    Args:
        stream: The file, which can seek.
        summary: Its summary.
        topics: Topics; None: all.

    Raises:
        ValueError: On a chunk whose checksum is wrong, or that is not one.
        struct.error: On a chunk that ends early.
        zstandard.ZstdError: On a chunk that cannot be decompressed.
        McapError: As the package mcap raises it, for files that only its reader can read.
    """
    channels = summary.channels
    wanted = {number for number, channel in channels.items() if topics is None or channel.topic in topics}
    chunks = sorted(summary.chunk_indexes, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    chunks = [chunk for chunk in chunks if _may_hold(chunk, wanted)]
    if not summary.chunk_indexes or _overlap(chunks) or any(chunk.compression != _ZSTD for chunk in chunks):
        stream.seek(0)
        reader = SeekingReader(stream, validate_crcs=True)
        for _, channel, message in reader.iter_messages(topics=None if topics is None else list(topics)):
            yield channel, message.log_time, memoryview(message.data)
        return
    for records in _ahead(stream, chunks):
        found = list(_messages(records, wanted, channels))
        if any(later[1] < earlier[1] for earlier, later in pairwise(found)):
            found.sort(key=itemgetter(1))
        yield from found


def refuse_bombs(stream: IO[bytes]) -> None:
    """Refuse a file of which a record claims to be larger than `LARGEST_CHUNK`, decompressed, before any is read.

    The libraries allocate the memory that a record or the header of a compressed frame claims. The sizes of frames
    without one are bounded by the chunk's own claim.

    Raises:
        ValueError: On such a record.
    """
    stream.seek(0, 2)
    end, at = stream.tell(), len(MCAP0_MAGIC)
    while at + RECORD.size <= end:
        stream.seek(at)
        opcode, length = RECORD.unpack(stream.read(RECORD.size))
        claims = _claim(stream) if opcode == Opcode.CHUNK else length
        if claims > LARGEST_CHUNK:
            raise ValueError(f"the record at byte {at} claims to hold {claims} bytes; at most {LARGEST_CHUNK} are read")
        at += RECORD.size + length
    stream.seek(0)


def _claim(stream: IO[bytes]) -> int:
    """Return the largest size that a chunk claims for its decompressed records, the stream being at its begin."""
    head = stream.read(_CHUNK.size + _LENGTH.size)
    if len(head) < _CHUNK.size + _LENGTH.size:
        return 0  # the file ends here; its reader reports this
    claims, named = _CHUNK.unpack_from(head)[2], _LENGTH.unpack_from(head, _CHUNK.size)[0]
    if named > len(_ZSTD):
        return int(claims)
    compression = stream.read(named)
    frame = stream.read(_LONG_LENGTH.size + _FRAME_BYTES)[_LONG_LENGTH.size :]
    try:
        if compression == _ZSTD.encode():
            known = zstandard.get_frame_parameters(frame).content_size
            return int(max(claims, 0 if known == zstandard.CONTENTSIZE_UNKNOWN else known))
    except zstandard.ZstdError:
        return int(claims)  # no frame; its reader reports this
    if compression == b"lz4" and frame[4:5] and frame[4] & _LZ4_SIZED:
        return int(max(claims, *_LONG_LENGTH.unpack(frame[6:14])))
    return int(claims)


def _may_hold(chunk: ChunkIndex, wanted: set[int]) -> bool:
    """Return whether a chunk may hold messages of channels; one without an index may."""
    return not chunk.message_index_offsets or not wanted.isdisjoint(chunk.message_index_offsets)


def _overlap(chunks: list[ChunkIndex]) -> bool:
    return any(later.message_start_time < earlier.message_end_time for earlier, later in pairwise(chunks))


def _ahead(stream: IO[bytes], chunks: list[ChunkIndex]) -> Iterator[bytes]:
    """Yield the records of chunks; the next chunk is decompressed in a thread while the caller works on one."""
    if len(chunks) < 2:
        yield from (_records(stream, chunk) for chunk in chunks)
        return
    with ThreadPoolExecutor(1, "chunk reader") as reader:
        coming = reader.submit(_records, stream, chunks[0])
        for chunk in chunks[1:]:
            records, coming = coming.result(), reader.submit(_records, stream, chunk)
            yield records
        yield coming.result()


def _records(stream: IO[bytes], chunk: ChunkIndex) -> bytes:
    """Return the records of a chunk."""
    stream.seek(chunk.chunk_start_offset)
    raw = stream.read(chunk.chunk_length)
    opcode, length = RECORD.unpack_from(raw)
    if opcode != Opcode.CHUNK or RECORD.size + length > len(raw):
        raise ValueError(f"byte {chunk.chunk_start_offset} is not the start of a whole chunk")
    at = RECORD.size
    _, _, size, crc = _CHUNK.unpack_from(raw, at)
    at += _CHUNK.size
    at += _LENGTH.size + _LENGTH.unpack_from(raw, at)[0]  # the name of the compression, which the index also holds
    compressed = _LONG_LENGTH.unpack_from(raw, at)[0]
    at += _LONG_LENGTH.size
    if at + compressed > len(raw):
        raise ValueError(f"the chunk at byte {chunk.chunk_start_offset} ends early")
    records: bytes = zstandard.decompress(memoryview(raw)[at : at + compressed], size)
    if crc and zlib.crc32(records) != crc:
        raise ValueError(f"the checksum of the chunk at byte {chunk.chunk_start_offset} is wrong")
    return records


def _messages(records: bytes, wanted: set[int], channels: Mapping[int, Channel]) -> Iterator[StampedMessage]:
    at, end, view = 0, len(records), memoryview(records)
    while at < end:
        opcode, length = RECORD.unpack_from(records, at)
        start, at = at + RECORD.size, at + RECORD.size + length
        if at > end:
            raise ValueError("a record ends behind its chunk")
        if opcode != Opcode.MESSAGE:
            continue
        number, _, stamp, _ = _MESSAGE.unpack_from(records, start)
        if number in wanted:
            yield channels[number], stamp, view[start + _MESSAGE.size : at]
        elif number not in channels:
            raise ValueError(f"a message is of channel {number}, which the summary does not have")
