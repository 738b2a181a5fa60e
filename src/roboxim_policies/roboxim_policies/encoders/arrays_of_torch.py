"""Reads the arrays of a PyTorch checkpoint of the old format (before torch 1.6) without PyTorch.

Such a file is a series of pickles, which may call any function. This reader accepts only the five names that a
dictionary of tensors needs, and refuses all others before they are called. It creates only NumPy arrays.

Source: ``torch.serialization._legacy_save`` of PyTorch 2.0.
"""

from __future__ import annotations

import collections
import io
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError

MAGIC, PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
"""First two numbers of the file."""
MAX_NUMBERS = 1 << 28
"""Largest number of elements of an array."""
KINDS = {"FloatStorage": np.dtype("<f4"), "LongStorage": np.dtype("<i8")}
"""Element types by the names of PyTorch's storages."""

Arrays = dict[str, npt.NDArray[Any]]


@dataclass
class _Storage:
    """Numbers that tensors show a part of; their values follow the pickles in the file."""

    kind: np.dtype[Any]
    count: int
    values: npt.NDArray[Any] | None = None


@dataclass(frozen=True)
class _Tensor:
    """A tensor: which part of a storage it shows."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def array(self) -> npt.NDArray[Any]:
        """Return a copy as an array.

        Raises:
            ValueError: When it reaches beyond its storage.
        """
        last = self.offset + sum((n - 1) * s for n, s in zip(self.shape, self.strides, strict=True))
        sound = all(n > 0 and s >= 0 for n, s in zip(self.shape, self.strides, strict=True))
        if self.storage.values is None or self.offset < 0 or not sound or last >= self.storage.count:
            raise ValueError("a tensor reaches beyond its numbers")
        steps = [s * self.storage.kind.itemsize for s in self.strides]
        return np.lib.stride_tricks.as_strided(self.storage.values[self.offset :], self.shape, steps).copy()


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    return _Tensor(storage, int(offset), tuple(map(int, shape)), tuple(map(int, strides)))


class _Reader(pickle.Unpickler):
    """An unpickler that makes plain values and the descriptions of tensors."""

    def __init__(self, file: io.BufferedIOBase) -> None:
        super().__init__(file)
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return what a name of the file means here; the file's own choice is never imported."""
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch" and name in KINDS:
            return KINDS[name]
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is not allowed")

    def persistent_load(self, pid: Any) -> _Storage:
        """Return the storage that an entry refers to."""
        what, kind, key, _, count, *_ = pid
        if what != "storage" or not isinstance(kind, np.dtype) or not 0 <= count <= MAX_NUMBERS:
            raise pickle.UnpicklingError(f"it refers to {what!r}, which is not allowed")
        return self.storages.setdefault(str(key), _Storage(kind, int(count)))


def read_arrays(path: Path) -> Arrays:
    """Return the arrays of a checkpoint by name.

    Args:
        path: The ``.pth`` file: a dictionary of tensors of 32-bit floats or 64-bit integers.

    Raises:
        ConfigError: When it is missing, damaged, of another format, or holds anything but arrays.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None
    except Exception as error:  # a pickle that is damaged raises anything
        raise ConfigError(f"{path} is no checkpoint of arrays alone: {error}; install the package again") from None


def _read(file: io.BufferedReader) -> Arrays:
    for wanted in (MAGIC, PROTOCOL):
        if _Reader(file).load() != wanted:
            raise ValueError("it does not begin as torch.save's old format does")
    if _Reader(file).load().get("little_endian") is not (sys.byteorder == "little"):
        raise ValueError("its numbers have another byte order")
    reader = _Reader(file)
    tensors = reader.load()
    for key in _Reader(file).load():
        storage = reader.storages[key]
        if int.from_bytes(file.read(8), "little") != storage.count:
            raise ValueError("a storage's length differs from its declaration")
        size = storage.count * storage.kind.itemsize
        if len(content := file.read(size)) != size:
            raise ValueError("it ends early")
        storage.values = np.frombuffer(content, storage.kind)
    if not isinstance(tensors, dict) or not all(isinstance(tensor, _Tensor) for tensor in tensors.values()):
        raise ValueError("it holds more than named arrays")
    return {str(name): tensor.array() for name, tensor in tensors.items()}
