"""Arrays of a foreign message, checked before memory is taken for them.

A message comes from an untrusted server. Its data type must be a plain number, its shape must have few axes, and shape,
data type and number of bytes must agree. Only then an array is made, as a view of the message's own bytes. Nothing is
unpickled: object arrays, structured types and complex numbers are refused.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.limits import echo
from roboxim_policies.wires.errors import invalid, unreadable

MESSAGE_BYTES = 64 * 2**20
"""Largest message that is sent or received [bytes]: dozens of large pictures."""
MAX_ROWS = 1_000
"""Largest number of actions in an answer."""
AXES = 8
"""Largest number of axes of an array."""
NPY_HEADER_BYTES = 4096
"""Largest header of an array in the ``.npy`` format."""
_DTYPE = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f[248])")


def checked_dtype(name: Any) -> np.dtype[Any]:
    """Return the data type with a name, e.g. ``<f4``.

    Raises:
        PolicyError: When it is not a boolean, an integer or a real number.
    """
    if isinstance(name, bytes):
        name = name.decode("ascii", "replace")
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise unreadable(f"an array's data type must be a plain number such as '<f4' or '|u1', got {echo(name)}")
    return np.dtype(name)


def checked_shape(shape: Any) -> tuple[int, ...]:
    """Return a shape as a tuple.

    Raises:
        PolicyError: When it is not a list of at most `AXES` sizes.
    """
    if not isinstance(shape, list | tuple) or len(shape) > AXES:
        raise unreadable(f"an array's shape must be a list of at most {AXES} sizes, got {echo(shape)}")
    if any(isinstance(size, bool) or not isinstance(size, int) or size < 0 for size in shape):
        raise unreadable(f"an array's sizes must be whole numbers >= 0, got {echo(shape)}")
    return tuple(shape)


def array_from(data: Any, dtype: Any, shape: Any, *, fortran: bool = False) -> npt.NDArray[Any]:
    """Return an array that shares the memory of its bytes; read-only.

    Args:
        data: The bytes.
        dtype: Name of the data type.
        shape: The shape.
        fortran: Whether the bytes are in column-major order.

    Raises:
        PolicyError: When the three do not fit each other.
    """
    kind, sizes = checked_dtype(dtype), checked_shape(shape)
    if not isinstance(data, bytes | bytearray | memoryview):
        raise unreadable(f"an array's data must be bytes, got {type(data).__name__}")
    needed = kind.itemsize
    for size in sizes:
        needed *= size
    if needed != len(data) or needed > MESSAGE_BYTES:
        raise unreadable(
            f"an array of shape {echo(list(sizes))} and type '{kind.str}' has {needed} bytes "
            f"(at most {MESSAGE_BYTES} are allowed), its data has {len(data)}"
        )
    array = np.frombuffer(data, kind).reshape(sizes, order="F" if fortran else "C")
    array.flags.writeable = False
    return array


def array_from_npy(data: Any) -> npt.NDArray[Any]:
    """Return an array in the ``.npy`` format; ``numpy.load`` would reserve what the header claims.

    Raises:
        PolicyError: When the format is damaged, or the header does not fit the data.
    """
    try:
        stream = io.BytesIO(data)
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, kind = read(stream, max_header_size=NPY_HEADER_BYTES)
    except Exception as error:  # numpy parses what the server sent and may raise anything
        raise unreadable(f"a .npy header cannot be read: {str(error)[:200]}") from None
    return array_from(data[stream.tell() :], kind.str, shape, fortran=fortran)


def npy_bytes(array: npt.NDArray[Any]) -> bytes:
    """Return an array in the ``.npy`` format, version 1."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def rows_of(value: Any, what: str) -> npt.NDArray[np.float64]:
    """Return a server's actions as rows.

    Args:
        value: Its answer: an array of shape (n, D), (D,) or (1, n, D), or nested lists of numbers.
        what: What it is, for messages, e.g. ``"actions"``.

    Returns:
        float64, shape (n, D).

    Raises:
        PolicyError: With code ``INVALID_ACTION`` when they are not finite numbers of such a shape.
    """
    if not isinstance(value, np.ndarray):
        value = _array_of_lists(value, what)
    if value.dtype.kind not in "iuf":
        raise invalid(f"{what} must be numbers, got type '{value.dtype.str}'")
    if value.ndim == 3 and value.shape[0] == 1:
        value = value[0]
    rows = np.asarray(value[None] if value.ndim == 1 else value, np.float64)
    if rows.ndim != 2 or not 1 <= rows.shape[0] <= MAX_ROWS or not 1 <= rows.shape[1] <= 256:
        raise invalid(
            f"{what} must have shape (n, D) with n from 1 to {MAX_ROWS}, or (D,); got {echo(list(value.shape))}"
        )
    if not np.isfinite(rows).all():
        row, column = np.argwhere(~np.isfinite(rows))[0].tolist()
        raise invalid(f"{what} must be finite, got {rows[row, column]} in step {row}, component {column}")
    return rows


def _array_of_lists(value: Any, what: str) -> npt.NDArray[Any]:
    try:
        if not isinstance(value, Sequence) or isinstance(value, str | bytes):
            raise ValueError(f"it is {type(value).__name__}")
        return np.array(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise invalid(f"{what} must be an array of numbers: {error}") from None
