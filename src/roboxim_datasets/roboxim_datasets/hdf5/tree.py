"""Inspects an HDF5 file without following links to other files and without trusting its declared sizes.

A link can lead to another file, a dataset's values can lie in one, and a dataset without any stored value can claim to
be larger than any memory. Each of these is found before a value is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_datasets.files import file_in, reading

_MAX_COMPRESSION = 1100
"""Largest ratio of compression: deflate reaches 1,032."""
_FREE_BYTES = 2**20
"""Size of an array without stored values that is believed [B]."""
_MAX_TEXT_BYTES = 2**24
"""Size of an attribute that is read [B]."""


@contextmanager
def opened(file: Path) -> Iterator[Any]:
    """Open a file that has no link to another one.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it cannot be read, or has such a link.
    """
    import h5py

    place = file_in(file.parent, file.name)
    try:
        handle = h5py.File(place, "r")
    except OSError as error:
        raise RecorderError(f"cannot read {file}: {error}", ErrorCode.BAG_DAMAGED) from None
    with handle:
        yield handle


def require_no_external_links(handle: Any, file: Path) -> None:
    """Refuse a file with a link to another one.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the link.
    """
    import h5py

    def look(name: bytes, about: Any) -> bytes | None:
        return name if about.type == h5py.h5l.TYPE_EXTERNAL else None

    found = handle.id.links.visit(look, info=True)
    if found is not None:
        raise RecorderError(
            f"{file}: '{found.decode(errors='replace')}' is a link to another file; only the file itself is read",
            ErrorCode.BAG_DAMAGED,
        )


def leaves(group: Any) -> dict[str, Any]:
    """Return all arrays below a group by their paths; what is no array and no group is None."""
    import h5py

    found: dict[str, Any] = {}

    def look(inner: Any, prefix: str, seen: frozenset[int]) -> None:
        for name in inner:
            path = f"{prefix}{name}"
            if isinstance(inner.get(name, getlink=True), h5py.SoftLink):
                found[path] = None
                continue
            item = inner[name]
            if isinstance(item, h5py.Group):
                address = h5py.h5o.get_info(item.id).addr
                if address not in seen:
                    look(item, f"{path}/", seen | {address})
            else:
                found[path] = item if isinstance(item, h5py.Dataset) else None

    look(group, "", frozenset())
    return found


def problem_of(array: Any) -> str:
    """Return why the values of an array cannot be read; empty: they can."""
    if array is None:
        return "a link, or no array"
    if array.external:
        return "its values lie in another file"
    if array.shape is None:
        return "it is empty"
    if array.is_virtual:
        return "a view of other arrays"
    if array.dtype.kind not in "fiub":
        return f"values of the type {array.dtype}"
    declared = math.prod(array.shape) * array.dtype.itemsize
    if declared > _FREE_BYTES + _MAX_COMPRESSION * array.id.get_storage_size():
        return f"it claims {declared} bytes, but the file holds {array.id.get_storage_size()}"
    return ""


def numbers(array: Any, where: str, count: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Read the first rows of an array of numbers as float32, shape (count, size).

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it cannot be read or has fewer rows.
    """
    if problem := problem_of(array):
        raise RecorderError(f"{where}: {problem}", ErrorCode.BAG_DAMAGED)
    if array.ndim < 1 or len(array) < count:
        raise RecorderError(f"{where}: shape {array.shape}, expected {count} rows", ErrorCode.BAG_DAMAGED)
    with reading(where), np.errstate(over="ignore"):  # an infinity is found where numbers are checked
        return np.asarray(array[:count], np.float32).reshape(count, math.prod(array.shape[1:]))


def attributes(holder: Any) -> Mapping[str, str]:
    """Return the attributes of a group as text; those that are empty or cannot be read are empty."""
    found = {}
    for name in holder.attrs:
        try:
            about = holder.attrs.get_id(name)
            small = about.get_storage_size() <= _MAX_TEXT_BYTES
            found[name] = text_of(holder.attrs[name]) if small else ""
        except Exception:  # a type that the library cannot turn into a value
            found[name] = ""
    return found


def text_of(value: Any) -> str:
    """Return a value of an attribute or array as text; nothing is empty."""
    import h5py

    if isinstance(value, h5py.Empty):
        return ""
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def array_in(group: Any, key: str, where: object) -> Any:
    """Return an array whose values can be read.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when there is none.
    """
    import h5py

    item = group.get(key)
    problem = problem_of(item) if isinstance(item, h5py.Dataset) else "there is no such array"
    if not problem and item.ndim < 1:
        problem = "a single value"
    if problem:
        raise RecorderError(f"{where}, '{key}': {problem}", ErrorCode.BAG_DAMAGED)
    return item
