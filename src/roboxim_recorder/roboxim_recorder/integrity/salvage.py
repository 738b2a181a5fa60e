"""Reads the intact chunks of a damaged MCAP file, i.e. those with a correct checksum, and locates the damage.

This module does not rely on the file's structure. Chunks are found by the name of their compression, not by following
lengths and offsets, so that a damaged length, index or chunk does not hide the chunks after it. A chunk's content is
used only if its CRC-32 is correct: a changed byte never reaches a message.

Non-obvious: the recorder writes zstd chunks with checksums; a file without them has nothing to salvage.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from roboxim_recorder.chunks import LARGEST_CHUNK, RECORD

_COMPRESSION = b"\x04\x00\x00\x00zstd"
"""Length and name of a chunk's compression, as every chunk of the recorder has them."""
_PREFIX = struct.Struct("<BQQQQI")
"""Fields before them: opcode, length, first and last time, size and checksum of the decompressed records."""
_LENGTH = struct.Struct("<Q")
_OUTSIDE = frozenset(Opcode) - {Opcode.CHUNK, Opcode.MESSAGE}
"""Records between chunks or after them."""
Bytes = bytes | mmap.mmap


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A range of a file that cannot be read."""

    start: int
    """First byte."""
    end: int
    """Byte behind the last one."""
    what: str
    """The fault, a phrase."""

    @property
    def text(self) -> str:
        """Readable description."""
        return f"bytes {self.start} to {self.end - 1}: {self.what}"


@dataclass(frozen=True, kw_only=True)
class SalvagedChunk:
    """A chunk whose checksum is right."""

    start: int
    """First byte of its record."""
    end: int
    """Byte behind the last one."""
    records: tuple[Schema | Channel | Message, ...]
    """Its records in the order of recording."""


def salvage(data: Bytes) -> Iterator[SalvagedChunk | Damage]:
    """Yield the readable chunks and the damaged ranges of an MCAP file in their order. Never raises.

    Args:
        data: The whole file.
    """
    at = 0
    for chunk in _chunks(data):
        yield from _between(data, at, chunk.start, last=False)
        yield chunk
        at = chunk.end
    yield from _between(data, at, len(data), last=True)


def _chunks(data: Bytes) -> Iterator[SalvagedChunk]:
    at = done = 0
    while (at := data.find(_COMPRESSION, at)) >= 0:
        start = at - _PREFIX.size
        chunk = _chunk(data, start) if start >= done else None
        at, done = (chunk.end, chunk.end) if chunk else (at + 1, done)
        if chunk:
            yield chunk


def _chunk(data: Bytes, start: int) -> SalvagedChunk | None:
    """Return the chunk that begins at a byte; None: there is none, or it is damaged.

    Its opcode, length and times are not read: the checksum shows whether the records are intact.
    """
    size_at = start + _PREFIX.size + len(_COMPRESSION)
    if size_at + _LENGTH.size > len(data):
        return None
    *_, crc = _PREFIX.unpack_from(data, start)
    begin = size_at + _LENGTH.size
    end = begin + _LENGTH.unpack_from(data, size_at)[0]
    if end > len(data):
        return None
    packed = data[begin:end]
    try:
        if not 0 < zstandard.get_frame_parameters(packed).content_size <= LARGEST_CHUNK:
            return None
        records = zstandard.decompress(packed)
        if zlib.crc32(records) != crc:
            return None
        found = breakup_chunk(_unpacked(records))
    except (zstandard.ZstdError, McapError, struct.error, ValueError, EOFError, MemoryError):
        return None
    kept = tuple(record for record in found if isinstance(record, Schema | Channel | Message))
    return SalvagedChunk(start=start, end=end, records=kept)


def _unpacked(records: bytes) -> Chunk:
    return Chunk(
        compression="", data=records, message_end_time=0, message_start_time=0, uncompressed_crc=0,
        uncompressed_size=len(records),
    )  # fmt: skip


def _between(data: Bytes, start: int, end: int, *, last: bool) -> Iterator[Damage]:
    """Yield the damage in a range between two chunks, before the first or behind the last one."""
    at = start
    if not at:
        if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
            yield Damage(start=0, end=min(len(MCAP0_MAGIC), end), what="it does not begin like an MCAP file")
        at = min(len(MCAP0_MAGIC), end)
    stop = end
    if last and data[end - len(MCAP0_MAGIC) : end] == MCAP0_MAGIC and end - len(MCAP0_MAGIC) >= at:
        stop = end - len(MCAP0_MAGIC)
    footer = False
    while at + RECORD.size <= stop:
        opcode, length = RECORD.unpack_from(data, at)
        if opcode not in _OUTSIDE or at + RECORD.size + length > stop:
            break
        footer = opcode == Opcode.FOOTER
        at += RECORD.size + length
    if at < stop:
        yield Damage(start=at, end=end, what=_what(data, at, stop, last=last))
    elif last and not (footer and stop < end):
        yield Damage(start=at, end=end, what="the file ends before its index: it was cut off or never finished")


def _what(data: Bytes, at: int, stop: int, *, last: bool) -> str:
    """Return the fault of the record at a byte."""
    if last and stop - at < RECORD.size:
        return "the file ends within a record"
    opcode, length = RECORD.unpack_from(data, at) if stop - at >= RECORD.size else (0, 0)
    cut = last and at + RECORD.size + length > stop
    if opcode == Opcode.CHUNK:
        return "the file ends within a chunk" if cut else "a chunk whose checksum is wrong"
    return "the file ends within a record" if cut and opcode in _OUTSIDE else "no readable record"
