"""Bags that claim to hold more than they do, or that decompress to far more than they weigh, are refused in time."""

from __future__ import annotations

import io
import struct

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from traced_memory import peak_below

from roboxim_core.errors import RecorderError
from roboxim_recorder.bag import BagReader
from roboxim_recorder.chunks import LARGEST_CHUNK, refuse_bombs
from roboxim_recorder.integrity.salvage import salvage

HUGE = 40 * 2**30
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def chunk(data, *, claims, compression="zstd"):
    """A file with one chunk of some bytes."""
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, claims, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(data)) + data
    start = io.BytesIO()
    writer = Writer(start, compression=CompressionType.NONE)
    writer.start()
    return start.getvalue() + bytes([Opcode.CHUNK]) + struct.pack("<Q", len(body)) + body


def zstd_frame_of(size):
    """A frame whose header claims a size, with one run-length block of zeros."""
    return ZSTD_MAGIC + b"\xe0" + struct.pack("<Q", size) + ((128 << 10 << 3) | 0b011).to_bytes(3, "little") + b"\0"


def lz4_frame_of(size):
    """The header of a frame that claims a size."""
    return b"\x04\x22\x4d\x18\x68\x40" + struct.pack("<Q", size) + b"\0" * 5


BOMBS = {
    "the chunk claims it": chunk(b"x", claims=HUGE),
    "its zstd frame claims it": chunk(zstd_frame_of(HUGE), claims=100),
    "its lz4 frame claims it": chunk(lz4_frame_of(HUGE), claims=100, compression="lz4"),
    "a frame of zeros, compressed honestly": chunk(
        zstandard.ZstdCompressor().compress(bytes(LARGEST_CHUNK // 16)), claims=LARGEST_CHUNK + 1
    ),
    "an attachment claims it": chunk(b"", claims=0) + bytes([Opcode.ATTACHMENT]) + struct.pack("<Q", HUGE) + b"x",
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_by_its_claim_before_memory_is_taken(name, tmp_path):
    (tmp_path / "bag").mkdir()
    file = tmp_path / "bag" / "bag.mcap"
    file.write_bytes(BOMBS[name])
    refused = pytest.raises(RecorderError, match=f"claims to hold .* bytes; at most {LARGEST_CHUNK} are read")
    with peak_below(2**24), refused:
        BagReader(file)
    with peak_below(2**26):
        list(salvage(BOMBS[name]))


def test_an_ordinary_bag_is_no_bomb(fake, tmp_path):
    with next(fake().record(tmp_path).glob("*.mcap")).open("rb") as stream:
        refuse_bombs(stream)
        assert stream.tell() == 0
