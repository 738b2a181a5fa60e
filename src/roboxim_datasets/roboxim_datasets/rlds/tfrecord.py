"""TFRecord files of ``tf.train.Example`` messages without TensorFlow.

It supports only what datasets need: length-prefixed records with masked CRC32C, and the three list types of an Example.

Source: the record format of TensorFlow's ``io/record_writer.h``; ``core/example/{example,feature}.proto``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import google_crc32c
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, RecorderError

Feature = Sequence[bytes] | npt.NDArray[np.float32] | npt.NDArray[np.int64]
"""One feature of an Example: byte strings, a float32 array or an int64 array, flat."""

SMALLEST = 16
"""Size of a record without payload [B]."""
_BYTES_LIST, _FLOAT_LIST, _INT64_LIST = 1, 2, 3


def _masked_crc(data: bytes) -> int:
    crc: int = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def write_record(file: BinaryIO, payload: bytes) -> None:
    """Append one record."""
    length = struct.pack("<Q", len(payload))
    file.write(length + struct.pack("<I", _masked_crc(length)))
    file.write(payload)
    file.write(struct.pack("<I", _masked_crc(payload)))


def read_records(path: Path) -> Iterator[bytes]:
    """Yield the payloads of a file's records.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the file ends within a record or a checksum is wrong.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        index = 0
        while header := file.read(12):
            if len(header) < 12 or _masked_crc(header[:8]) != struct.unpack("<I", header[8:])[0]:
                raise _damaged(path, index)
            payload = file.read(min(struct.unpack("<Q", header[:8])[0], size))
            crc = file.read(4)
            if len(crc) < 4 or _masked_crc(payload) != struct.unpack("<I", crc)[0]:
                raise _damaged(path, index)
            yield payload
            index += 1


def record_positions(path: Path) -> list[int]:
    """Return the position of every record of a file [B], from the lengths alone.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when a length is wrong or the file ends within a record.
    """
    size = path.stat().st_size
    found: list[int] = []
    with path.open("rb") as file:
        at = 0
        while at < size:
            file.seek(at)
            header = file.read(12)
            if len(header) < 12 or _masked_crc(header[:8]) != struct.unpack("<I", header[8:])[0]:
                raise _damaged(path, len(found))
            found.append(at)
            at += 16 + int(struct.unpack("<Q", header[:8])[0])
    if at != size:
        raise _damaged(path, len(found) - 1)
    return found


def read_record(path: Path, position: int, index: int) -> bytes:
    """Return the payload of one record.

    Args:
        path: The file.
        position: Position of the record [B].
        index: Its number, for the message.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the file ends within the record or its checksum is wrong.
    """
    with path.open("rb") as file:
        file.seek(position)
        header = file.read(12)
        length = struct.unpack("<Q", header[:8])[0] if len(header) == 12 else 0
        payload = file.read(min(length, path.stat().st_size))
        crc = file.read(4)
    if len(crc) < 4 or _masked_crc(payload) != struct.unpack("<I", crc)[0]:
        raise _damaged(path, index)
    return payload


def _damaged(path: Path, index: int) -> RecorderError:
    return RecorderError(f"{path}: record {index} is damaged; the file is not as it was written", ErrorCode.BAG_DAMAGED)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _message(field: int, payload: bytes) -> bytes:
    """Return a length-delimited field (wire type 2)."""
    return _varint(field << 3 | 2) + _varint(len(payload)) + payload


def _encode_feature(feature: Feature) -> bytes:
    if not isinstance(feature, np.ndarray):
        return _message(_BYTES_LIST, b"".join(_message(1, bytes(value)) for value in feature))
    flat = feature.reshape(-1)
    if flat.dtype == np.float32:
        return _message(_FLOAT_LIST, _message(1, flat.astype("<f4").tobytes()))
    if flat.dtype == np.int64:
        return _message(_INT64_LIST, _message(1, b"".join(_varint(int(v) & (1 << 64) - 1) for v in flat)))
    raise TypeError(f"an Example holds byte strings, float32 or int64, got {flat.dtype}")


def encode_example(features: Mapping[str, Feature]) -> bytes:
    """Serialise an Example, keys sorted, so that equal features give equal bytes."""
    entries = (
        _message(1, _message(1, key.encode()) + _message(2, _encode_feature(features[key]))) for key in sorted(features)
    )
    return _message(1, b"".join(entries))


def _read_varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield (field number, payload) of the length-delimited fields of a message; others do not occur."""
    at = 0
    while at < len(data):
        tag, at = _read_varint(data, at)
        if tag & 7 != 2:
            raise ValueError(f"wire type {tag & 7} in an Example; only packed lists are read")
        length, at = _read_varint(data, at)
        if at + length > len(data):
            raise ValueError("a field reaches beyond its message")
        yield tag >> 3, data[at : at + length]
        at += length


def _decode_feature(data: memoryview) -> Feature:
    for kind, values in _fields(data):
        if kind == _BYTES_LIST:
            return [bytes(value) for _, value in _fields(values)]
        packed = b"".join(bytes(part) for _, part in _fields(values))
        if kind == _FLOAT_LIST:
            return np.frombuffer(packed, "<f4").astype(np.float32)
        numbers, at, view = [], 0, memoryview(packed)
        while at < len(view):
            number, at = _read_varint(view, at)
            numbers.append(number - (1 << 64) if number >> 63 else number)
        return np.array(numbers, np.int64)
    return []


def example_keys(payload: bytes) -> list[str]:
    """Return the names of the features of an Example.

    Raises:
        ValueError: When the payload is not an Example.
    """
    entries = (entry for _, container in _fields(memoryview(payload)) for _, entry in _fields(container))
    return [bytes(dict(_fields(entry)).get(1, b"")).decode() for entry in entries]


def decode_example(payload: bytes, keys: Iterable[str] | None = None) -> dict[str, Feature]:
    """Read an Example.

    Args:
        payload: A record's payload.
        keys: Features to decode; the others are skipped at no cost. None: all.

    Raises:
        ValueError: When the payload is not an Example.
    """
    wanted = None if keys is None else set(keys)
    features: dict[str, Feature] = {}
    for _, container in _fields(memoryview(payload)):
        for _, entry in _fields(container):
            parts = dict(_fields(entry))
            key = bytes(parts.get(1, b"")).decode()
            if wanted is None or key in wanted:
                features[key] = _decode_feature(parts.get(2, memoryview(b"")))
    return features
