"""Verifies a bag's files without decoding messages: the sections of the MCAP file, and ``metadata.yaml``.

Two checksums cover an MCAP file: one from the file's start to the end of its data section, one from the start of its
summary to its footer. The bytes between and after these ranges are fixed, so no byte of the recorder's files can change
unnoticed. A checksum of 0 means "not available": for files of other programs, which write none,
`roboxim_recorder.integrity.check` can check only the checksums of the chunks and the messages. A file of the recorder
has both.

Source: MCAP format specification, version 0.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from roboxim_core.plain_data.differences import differences
from roboxim_recorder.bag_writer import LIBRARY, METADATA_FILE, metadata_text

_FOOTER = struct.Struct("<BQQQI")
"""Opcode, length, start of the summary, start of its offsets, checksum."""
_DATA_END = struct.Struct("<BQI")
"""Opcode, length, checksum."""
LONGEST_METADATA = 256 << 10
"""Largest ``metadata.yaml`` that is parsed [B]."""


def container_problems(data: memoryview) -> Iterator[str]:
    """Yield the faults of an MCAP file's sections; without faults every byte is as it was written.

    Args:
        data: The whole file.
    """
    magic, size = len(MCAP0_MAGIC), len(data)
    if data[:magic] != MCAP0_MAGIC:
        yield "it does not begin like an MCAP file"
        return
    footer = size - magic - _FOOTER.size
    if footer < magic or data[size - magic :] != MCAP0_MAGIC:
        yield "it does not end like an MCAP file: it is cut off, or something was appended"
        return
    opcode, length, start, _, crc = _FOOTER.unpack_from(data, footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - 9):
        yield "it has no footer"
        return
    if not magic + _DATA_END.size <= start <= footer and (start or _library(data) == LIBRARY.encode()):
        yield f"its footer says that the summary begins at byte {start}, which is impossible"
        return
    own = _library(data) == LIBRARY.encode()
    if not start and not own:  # written without a summary
        return
    if (crc or own) and zlib.crc32(data[start : footer + _FOOTER.size - 4]) != crc:
        yield "its summary does not have the checksum that its footer names"
    data_end = start - _DATA_END.size
    opcode, length, crc = _DATA_END.unpack_from(data, data_end)
    if (opcode, length) != (Opcode.DATA_END, _DATA_END.size - 9):
        yield "its data section has no end"
    elif (crc or own) and zlib.crc32(data[:data_end]) != crc:
        yield "its data section does not have the checksum that its end names"


def _library(data: memoryview) -> bytes:
    """Return the program that a file's header names as its writer; empty: there is no header."""
    at = len(MCAP0_MAGIC) + 9
    for _ in range(2):  # profile, library
        if at + 4 > len(data):
            return b""
        size = int.from_bytes(data[at : at + 4], "little")
        found = bytes(data[at + 4 : at + 4 + size]) if size < 1000 else b""
        at += 4 + size
    return found


def metadata_problems(folder: Path, expected: Mapping[str, Any]) -> Iterator[str]:
    """Yield differences between a bag's ``metadata.yaml`` and its MCAP file.

    Args:
        folder: The bag's folder.
        expected: Expected content of the file, as plain data.
    """
    path = folder / METADATA_FILE
    try:
        content = path.read_bytes()
    except OSError as error:
        yield f"its {METADATA_FILE} cannot be read: {error.strerror or error}"
        return
    if content == metadata_text(expected).encode():
        return
    if len(content) > LONGEST_METADATA:
        yield f"its {METADATA_FILE} has {len(content)} bytes, which cannot be"
        return
    try:
        found = yaml.safe_load(content)  # not the C parser, which crashes on deep nesting
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        yield f"its {METADATA_FILE} is not readable YAML ({str(error).splitlines()[0] if str(error) else 'too deep'})"
        return
    if not isinstance(found, dict):
        yield f"its {METADATA_FILE} is no mapping"
    elif what := differences(found, expected, words=("stored", "expected")):
        yield f"its {METADATA_FILE}: {what}"
