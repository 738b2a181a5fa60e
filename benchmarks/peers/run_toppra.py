"""Toppra as a reference: the shortest duration on a motion's geometric path within velocity and acceleration limits.

It has no jerk limits, so a motion with limited jerk takes longer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import toppra
from _serve import Answer, serve, unpack
from toppra.algorithm import TOPPRA
from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

SPACING_RAD = 0.01
VELOCITY = np.array([2.175] * 4 + [2.61] * 3)
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])


def make() -> Callable[[dict[str, Any]], Answer]:
    """Set up."""
    toppra.setup_logging("ERROR")
    limits = [JointVelocityConstraint(VELOCITY), JointAccelerationConstraint(ACCELERATION)]

    def handle(request: dict[str, Any]) -> Answer:
        begun = time.perf_counter()
        positions = unpack(request["positions"])
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
        places = np.linspace(0.0, lengths[-1], max(20, int(lengths[-1] / SPACING_RAD)))
        kept = np.append(True, np.diff(lengths) > 1e-12)
        points = np.stack([np.interp(places, lengths[kept], column[kept]) for column in positions.T], axis=1)
        path = toppra.SplineInterpolator(places, points)
        found = TOPPRA(limits, path, gridpoints=np.linspace(0.0, lengths[-1], 2 * len(places))).compute_trajectory()
        ms = 1e3 * (time.perf_counter() - begun)
        return {"ms": ms, "error": "" if found else "toppra failed", "duration_s": found.duration if found else 0.0}

    return handle


if __name__ == "__main__":
    serve(make)
