"""How a contender talks to the benchmark: a JSON object a line in, a JSON object a line out; needs numpy only.

A request is ``{"problem": {...}, "seed": n, "limit_s": t}`` with the fields of ``_problems.Problem``. An answer has
``ms`` (from the request's values to the timed motion, without setting up the scene where that is apart), ``setup_ms``,
``error`` (empty when there is a motion), ``positions`` (a sample per millisecond, one at the end) and ``duration_s``.
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
    """Turn an array into JSON's types, bit for bit."""
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
    """Answer requests until the input ends; what libraries print goes to the standard error.

    Args:
        make: Makes the function that answers; called once.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    handle = make()
    answers.write(json.dumps({"ready": True}) + "\n")
    answers.flush()
    for line in sys.stdin:
        answers.write(json.dumps(handle(json.loads(line))) + "\n")
        answers.flush()
