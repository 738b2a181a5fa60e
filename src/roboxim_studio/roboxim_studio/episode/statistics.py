"""What episodes look like together: lengths, start positions, how jerky they are, how their actions are distributed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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


BINS = 40
"""Bins of a histogram."""


@dataclass(frozen=True, kw_only=True)
class Distribution:
    """Distribution of one component of the actions of many episodes."""

    name: str
    """Name of the component."""
    counts: npt.NDArray[np.int64]
    """Number of actions in each bin, shape (BINS,)."""
    edges: npt.NDArray[np.float64]
    """Ends of the bins, shape (BINS + 1,)."""
    mean: float
    """Mean."""
    deviation: float
    """Standard deviation."""
    lowest: float
    """Smallest value."""
    highest: float
    """Largest value."""

    @property
    def outline(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Outline of the histogram as a curve: x ascending, and counts; shape (2 * BINS,) each."""
        return np.repeat(self.edges, 2)[1:-1], np.repeat(self.counts, 2).astype(np.float64)


def distributions(actions: npt.NDArray[np.float64], names: Sequence[str]) -> tuple[Distribution, ...]:
    """Return the distribution of every component of actions.

    Args:
        actions: Actions of all episodes together, shape (actions, components); not finite ones are left out.
        names: Name of each component.
    """
    found = []
    for name, column in zip(names, actions.T, strict=True):
        values = column[np.isfinite(column)]
        if len(values):
            counts, edges = np.histogram(values, bins=BINS)
            found.append(
                Distribution(
                    name=name,
                    counts=counts,
                    edges=edges,
                    mean=float(values.mean()),
                    deviation=float(values.std()),
                    lowest=float(values.min()),
                    highest=float(values.max()),
                )  # fmt: skip
            )
    return tuple(found)
