"""Two arm configurations, and an obstacle at a problem's start."""

from __future__ import annotations

from typing import Any

import numpy as np

START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.7, 0.8])
END = np.array([0.9, -0.2, 0.2, -2.0, 0.1, 1.9, 0.5])


def ball_at_the_start(problem: Any) -> Any:
    from benchmarks.planner._referee import Solid

    pose = problem.referee().tcp(np.array(problem.start))
    x, y, z = pose.translation.tolist()
    return Solid(kind="sphere", size=(0.05,), position=(x, y, z))
