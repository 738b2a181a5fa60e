"""HDF5 files on disks that may be full.

The HDF5 library cannot close a file that it cannot write: the process ends with a segmentation fault. So the library
writes into an object of Python. This object stores the first error of the disk and drops all further data, so that the
library closes its file normally; then the error is raised.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[Any]:
    """Write a new HDF5 file in the block.

    Raises:
        OSError: When the disk is full, or another error of it; an incomplete file remains.
    """
    import h5py

    with open(path, "w+b", buffering=0) as raw:
        disk = _Disk(cast("BinaryIO", raw))
        try:
            with h5py.File(disk, "w") as file:
                yield file
        except Exception:  # of the library, which reads what was dropped
            if disk.error is None:
                raise
        if disk.error is not None:
            raise disk.error


class _Disk(io.RawIOBase):
    """A file that stores its first error and then drops all writes."""

    def __init__(self, raw: BinaryIO) -> None:
        super().__init__()
        self._raw = raw
        self.error: OSError | None = None

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        return self._raw.tell()

    def readinto(self, buffer: Any) -> int:
        data = self._raw.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        written = 0
        while self.error is None and written < len(view):
            try:
                written += self._raw.write(view[written:])
            except OSError as error:
                self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                return self._raw.truncate(size)
            except OSError as error:
                self.error = error
        return size or 0
