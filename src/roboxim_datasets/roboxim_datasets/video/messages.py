"""Messages between a video worker and its client: a JSON header, then raw bytes.

A message is the header's length (4 bytes, little-endian), the header in UTF-8, and as many bytes as the header's
``bytes`` says.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import IO, Any

Header = dict[str, Any]
_LENGTH = struct.Struct("<I")


def write_message(stream: IO[bytes], header: Header, parts: Sequence[Any] = ()) -> None:
    """Write a message.

    Args:
        stream: Binary stream.
        header: Header without ``bytes``.
        parts: Objects with contiguous memory, e.g. arrays; together they are the message's bytes.

    Raises:
        OSError: When the other side has closed the stream.
    """
    views = [memoryview(part).cast("B") for part in parts]
    text = json.dumps({**header, "bytes": sum(len(view) for view in views)}).encode()
    stream.write(_LENGTH.pack(len(text)) + text)
    for view in views:
        stream.write(view)
    stream.flush()


def read_message(stream: IO[bytes]) -> tuple[Header, bytearray] | None:
    """Read a message; None at the end of the stream.

    Raises:
        EOFError: When the stream ends within a message.
    """
    start = stream.read(_LENGTH.size)
    if not start:
        return None
    header: Header = json.loads(_exactly(stream, _LENGTH.unpack(start)[0]))
    return header, _exactly(stream, header["bytes"])


def _exactly(stream: IO[bytes], count: int) -> bytearray:
    data = bytearray(count)
    view, at = memoryview(data), 0
    while at < count:
        got = stream.readinto(view[at:])  # type: ignore[attr-defined] # buffered streams have it
        if not got:
            raise EOFError(f"the stream ended after {at} of {count} bytes")
        at += got
    return data
