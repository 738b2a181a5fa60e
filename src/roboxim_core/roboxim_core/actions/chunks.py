"""Validation of action chunks: a policy's answer must be an array of finite numbers.

Only real numbers are accepted. Booleans, strings, complex numbers, masked arrays and objects are refused, at any depth
of a list; none of them is cast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, printable

ACTION_SIZE = 7
"""Number of components of an action of the default semantics."""
ActionArray = npt.NDArray[np.float32]
"""One action, shape (D,), or a chunk of them, shape (horizon, D); D is 7 by default."""
MAX_ROWS = 1_000_000
"""Largest number of actions in a chunk if no horizon limits it."""


def check_chunk(actions: Any, *, size: int | None = ACTION_SIZE, max_rows: int = MAX_ROWS) -> ActionArray:
    """Validate a chunk of actions.

    Args:
        actions: Array-like of integers or floats, shape (horizon, size) or (size,).
        size: Number of components of an action; None: any, but equal for all actions.
        max_rows: Largest horizon.

    Returns:
        float32 array of shape (horizon, size).

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION``, if the values are not numbers, the shape is wrong, there are
            too many actions, or a value is NaN or infinite (also after the conversion to float32).
    """
    try:
        raw = _numbers(actions, max_rows)
    except InvalidRequestError:
        raise
    except (Exception, SystemExit) as error:  # conversion to an array runs foreign code, which may raise anything
        raise _invalid(f"actions are not numbers: {type(error).__name__}: {printable(error)}") from None
    shown = f"(horizon, {'n' if size is None else size})"
    if raw.ndim not in (1, 2) or raw.size == 0 or (size is not None and raw.shape[-1] != size):
        raise _invalid(f"actions must have shape {shown}, got {raw.shape}")
    if raw.ndim == 2 and raw.shape[0] > max_rows:
        raise _invalid(f"actions must have shape {shown} with a horizon of at most {max_rows}, got {raw.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        chunk = np.atleast_2d(raw).astype(np.float32)
    if not np.isfinite(chunk).all():
        row, column = np.argwhere(~np.isfinite(chunk))[0]
        given = np.atleast_2d(raw)[row, column]
        raise _invalid(f"actions must be finite, got {given} at step {row}, component {column}")
    return chunk


def _numbers(actions: Any, max_rows: int) -> npt.NDArray[Any]:
    """Return the given integers or floats as an array, without casting other types."""
    if isinstance(actions, list | tuple):
        _require_numbers(actions, max_rows, depth=2)
    elif isinstance(actions, np.ma.MaskedArray):
        raise _invalid("actions are not numbers: a masked array; fill its masked values first")
    raw = np.asarray(actions)
    if raw.dtype.kind not in "iuf":
        raise _invalid(f"actions are not numbers: {_kind(actions)} of {raw.dtype}; expected floats")
    return raw


def _require_numbers(values: list[Any] | tuple[Any, ...], max_rows: int, *, depth: int) -> None:
    """Refuse a list that NumPy would cast (booleans, strings, masked parts) or that is too deep or too long."""
    if len(values) > max(max_rows, 1024):
        raise _invalid(f"actions have a horizon of at most {max_rows}, got {len(values)}")
    for value in values:
        if isinstance(value, list | tuple):
            if depth == 1:
                raise _invalid("actions have at most two dimensions, got a deeper list")
            _require_numbers(value, 1024, depth=depth - 1)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            continue
        elif isinstance(value, np.ma.MaskedArray) or np.asarray(value).dtype.kind not in "iuf":
            raise _invalid(f"actions are not numbers: a list with {_kind(value)}")


def _kind(value: Any) -> str:
    name = type(value).__name__
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def _invalid(message: str) -> InvalidRequestError:
    return InvalidRequestError(message, ErrorCode.INVALID_ACTION)


def hold_action(gripper: float) -> ActionArray:
    """Return the hold action of the default semantics: zero delta, gripper as given, 1 = open."""
    action = np.zeros(ACTION_SIZE, dtype=np.float32)
    action[6] = gripper
    return action
