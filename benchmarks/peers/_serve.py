"""Protocol between a contender and the benchmark: one JSON object per line in each direction; needs numpy only.

A request is ``{"problem": {...}, "seed": n, "limit_s": t}`` with the fields of ``_problems.Problem``. A response has:

- ``ms``: time from the request's values to the timed motion, without the scene's set-up if that is measured separately;
- ``setup_ms``: time of the scene's set-up;
- ``error``: empty if there is a motion;
- ``positions``: a sample per millisecond and one at the end;
- ``duration_s``.
"""

from __future__ import annotations

import base64
import json
import os
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

Answer = dict[str, Any]


def pack(array: np.ndarray) -> dict[str, Any]:
    """Convert an array to JSON types without loss."""
    plain = np.ascontiguousarray(array, dtype=np.float64)
    return {"shape": list(plain.shape), "data": base64.b64encode(plain.tobytes()).decode()}


def unpack(value: dict[str, Any]) -> np.ndarray:
    """Undo `pack`."""
    return np.frombuffer(base64.b64decode(value["data"])).reshape(value["shape"])


def sample_times(duration: float) -> np.ndarray:
    """Return 0, 1, 2, ... ms and the end [s]."""
    count = max(1, int(np.ceil(duration / 1e-3 - 1e-9)))
    return np.append(np.arange(count) * 1e-3, duration)


def serve(make: Callable[[], Callable[[dict[str, Any]], Answer]]) -> None:
    """Serve requests until the input ends; redirect the output of libraries to standard error.

    Args:
        make: Creates the request handler; called once.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    handle = make()
    answers.write(json.dumps({"ready": True}) + "\n")
    answers.flush()
    for line in sys.stdin:
        answers.write(json.dumps(handle(json.loads(line))) + "\n")
        answers.flush()
