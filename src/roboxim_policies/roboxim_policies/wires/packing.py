"""MessagePack with bounds. Each wire supplies two functions that encode and decode its arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from roboxim_core.errors import InvalidRequestError, PolicyError
from roboxim_policies.wires.arrays import MESSAGE_BYTES
from roboxim_policies.wires.errors import unreadable

ITEMS = 100_000
"""Largest number of items of a list or a map in a message; arrays are bytes, so that few are needed."""


def pack(value: Any, encode: Callable[[Any], Any]) -> bytes:
    """Encode a value.

    Args:
        value: Maps, lists, texts, numbers and NumPy arrays.
        encode: Returns the wire's form of an array.

    Raises:
        InvalidRequestError: When the value has a part that the wire does not carry.
    """
    import msgpack

    def default(part: Any) -> Any:
        if isinstance(part, np.ndarray):
            if part.dtype.kind not in "biuf":
                raise InvalidRequestError(f"arrays of type '{part.dtype.str}' cannot be sent; convert them to numbers")
            return encode(part)
        if isinstance(part, np.bool_ | np.integer | np.floating):
            return part.item()
        raise InvalidRequestError(f"a value of type {type(part).__name__} cannot be sent to a policy server")

    data = msgpack.packb(value, default=default, use_bin_type=True)
    assert isinstance(data, bytes)
    if len(data) > MESSAGE_BYTES:
        raise InvalidRequestError(
            f"a request has {len(data)} bytes, at most {MESSAGE_BYTES} are sent; use smaller images"
        )
    return data


def unpack(data: bytes, decode: Callable[[dict[Any, Any]], Any]) -> Any:
    """Decode a message.

    Args:
        data: The message.
        decode: Called with each map; returns the array that it describes, or the map itself.

    Raises:
        PolicyError: With code ``POLICY_FAULT`` when the message is damaged or larger than the bounds.
    """
    import msgpack

    if len(data) > MESSAGE_BYTES:
        raise unreadable(f"it has {len(data)} bytes, at most {MESSAGE_BYTES} are allowed")
    try:
        return msgpack.unpackb(
            data, object_hook=decode, raw=False, strict_map_key=False, ext_hook=_refuse_extension,
            max_array_len=ITEMS, max_map_len=ITEMS, max_str_len=MESSAGE_BYTES, max_bin_len=MESSAGE_BYTES,
            max_ext_len=64,
        )  # fmt: skip
    except PolicyError:
        raise
    except Exception as error:  # the format's reader raises a dozen kinds
        text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise unreadable(f"it is not valid MessagePack ({text[:200]})") from None


def _refuse_extension(code: int, data: bytes) -> Any:
    raise unreadable(f"it has a MessagePack extension of type {code}, which no policy server needs")
