"""Opens Parquet files, and refuses those that would unpack to far more than their size.

Run lengths, dictionaries and zstd let a file of a kilobyte hold gigabytes of equal values. The footer of a file states
the unpacked size, so it is checked before anything is unpacked.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_datasets.files import file_in

if TYPE_CHECKING:
    import pyarrow.parquet as pq

FREE_BYTES = 2**28
"""Unpacked size that is believed of any file [B]."""
MAX_TIMES = 1100
"""Beyond it, largest ratio of the unpacked size to the file's."""
_VALUE_BYTES = 8


def open_parquet(folder: Path, name: Path | str) -> pq.ParquetFile:
    """Open a Parquet file of a dataset.

    Args:
        folder: The dataset's folder.
        name: Path relative to it; an absolute one must lie in it.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it lies elsewhere or holds more than its size allows.
    """
    import pyarrow.parquet as pq

    place = file_in(folder, name)
    file, stored = pq.ParquetFile(place), place.stat().st_size
    try:
        unpacked = _unpacked_bytes(place)
    except (LookupError, ValueError, TypeError, AttributeError, struct.error, RecursionError) as error:
        raise RecorderError(f"{place}: its footer cannot be read: {error!r}", ErrorCode.BAG_DAMAGED) from None
    if unpacked > max(FREE_BYTES, MAX_TIMES * stored):
        raise RecorderError(
            f"{place} has {stored} bytes and unpacks to {unpacked}; at most {MAX_TIMES} times its size is read. Leave "
            "the file out, or take the dataset from its source again",
            ErrorCode.BAG_DAMAGED,
        )
    return file


def _unpacked_bytes(place: Path) -> int:
    """Return the unpacked size of all columns, as the footer says it.

    pyarrow's ``RowGroupMetaData.column`` ends the process at some damaged footers (26.0.1), so this module reads them
    itself.
    Source: apache/parquet-format, parquet.thrift (FileMetaData 4, RowGroup 1, ColumnChunk 3, ColumnMetaData 5 and 6).
    """
    with place.open("rb") as file:
        file.seek(-8, 2)
        (length,) = struct.unpack("<I4x", file.read(8))
        file.seek(-8 - length, 2)
        footer = _Compact(file.read(length)).struct()
    chunks = [chunk[3] for group in footer.get(4, ()) for chunk in group.get(1, ()) if 3 in chunk]
    return sum(max(chunk.get(6, 0), _VALUE_BYTES * chunk.get(5, 0)) for chunk in chunks)


class _Compact:
    """Reads Thrift's compact protocol. Source: apache/thrift, doc/specs/thrift-compact-protocol.md."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def struct(self) -> dict[int, Any]:
        """Return the fields of a struct by their numbers."""
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._signed()
            fields[number] = self._value(head & 15)
        return fields

    def _byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def _unsigned(self) -> int:
        value = shift = 0
        while True:
            byte = self._byte()
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)

    def _value(self, kind: int) -> Any:
        if kind in (1, 2):  # a boolean field, whose value is its type
            return kind == 1
        if kind == 3:
            return self._byte()
        if kind in (4, 5, 6):
            return self._signed()
        if kind in (7, 8):
            length = 8 if kind == 7 else self._unsigned()
            self._at += length
            return self._data[self._at - length : self._at]
        if kind in (9, 10):
            return self._list()
        if kind == 11:
            count = self._unsigned()
            kinds = self._byte() if count else 0
            return [(self._item(kinds >> 4), self._item(kinds & 15)) for _ in range(count)]
        if kind == 12:
            return self.struct()
        raise ValueError(f"no type {kind} at byte {self._at}")

    def _list(self) -> list[Any]:
        head = self._byte()
        count = head >> 4 if head >> 4 < 15 else self._unsigned()
        return [self._item(head & 15) for _ in range(count)]

    def _item(self, kind: int) -> Any:
        return self._byte() if kind in (1, 2) else self._value(kind)
