"""What a folder's episodes look like together: lengths, start positions, how jerky they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.state import StateRecord


@dataclass(frozen=True, kw_only=True)
class Traits:
    """Numbers of one episode."""

    steps: int
    """Number of ticks."""
    jerk_m_s3: float
    """Root mean square of the third derivative of the tool's measured position [m/s^3]."""
    start_m: dict[str, tuple[float, float]]
    """Entity to its position on the table at tick 0 [m]."""


def traits(states: Sequence[StateRecord], tick_s: float) -> Traits:
    """Return the numbers of an episode.

    Args:
        states: Its states from tick 0.
        tick_s: Length of a tick [s].
    """
    path = np.array([state.robot.pose_tcp_measured.position for state in states], dtype=float)
    jerk = np.diff(path, n=3, axis=0) / tick_s**3
    size = float(np.sqrt((jerk**2).sum(axis=1).mean())) if len(jerk) else 0.0
    start = {entity.name: (entity.pose.position[0], entity.pose.position[1]) for entity in states[0].entities}
    return Traits(steps=len(states), jerk_m_s3=size, start_m=start)
