"""Trajectory points for a controller: cubic and quintic splines through them keep the limits.

A joint trajectory controller receives only the points. It interpolates them by cubic splines through positions and
velocities, or by quintic splines through accelerations as well. Such a spline reproduces the motion where the motion's
polynomial does not change between two points. Where the jerk jumps in between, the spline overshoots: it reaches 1.6
times the acceleration limit at 10 ms, since a Panda reaches its full acceleration within 2 ms. So there are points at
the period, points where the jerk jumps, and further points wherever a spline still breaks a limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_planner.motions.timing import Motion, MotionLimits

Array = npt.NDArray[np.float64]
TOLERANCE = 0.01
"""Fraction of a limit by which a spline may exceed it."""
CHECK_PERIOD_S = 1e-3
"""Largest spacing at which splines are checked; segments are divided evenly."""
MIN_GAP_S = 5e-6
"""A jump of the jerk that is nearer than this to another point gets no point [s]."""
_ROUNDS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Samples of a motion."""

    times: Array
    """Times from 0, shape (N,) [s]."""
    positions: Array
    """Shape (N, dof) [rad]."""
    velocities: Array
    """Shape (N, dof) [rad/s]."""
    accelerations: Array
    """Shape (N, dof) [rad/s^2]."""


def sample(motion: Motion, times: Array) -> Trajectory:
    """Return a motion's samples at increasing times, shape (N,) [s]."""
    q, v, a, _ = motion.evaluate(times)
    return Trajectory(times=times, positions=q, velocities=v, accelerations=a)


def controller_points(motion: Motion, limits: MotionLimits, period_s: float) -> Trajectory:
    """Return points whose cubic and quintic splines keep the velocity and acceleration limits.

    All times are whole nanoseconds, as messages have them.

    Args:
        motion: The motion, which keeps the limits itself.
        limits: Limits of the joints.
        period_s: Longest time between two points [s]; its multiples are among the points.

    Raises:
        PlannerError: ``TRAJECTORY_INVALID`` if no points are found that keep the limits.
    """
    times = _times(motion, period_s)
    for _ in range(_ROUNDS):
        points = _sampled(motion, times)
        broken = spline_excess(points, limits) > 1.0 + TOLERANCE
        if not broken.any():
            return points
        middles = 0.5 * (times[:-1] + times[1:])[broken]
        times = np.union1d(times, _whole(middles))
    worst = float(spline_excess(points, limits).max())
    raise PlannerError(
        f"no points of the motion keep the limits when a controller interpolates them: a spline reaches {worst:.3f} of "
        "a limit; ask for less speed",
        ErrorCode.TRAJECTORY_INVALID,
    )


def _sampled(motion: Motion, times: Array) -> Trajectory:
    """Return a motion's samples; the last one is its exact end, less than a nanosecond from the last time."""
    q, v, a, _ = motion.evaluate(np.append(times[:-1], motion.duration))
    return Trajectory(times=times, positions=q, velocities=v, accelerations=a)


def _times(motion: Motion, period_s: float) -> Array:
    """Return the multiples of the period, the end, and the times of jerk jumps, in whole nanoseconds."""
    period = float(_whole(np.array(period_s)))
    duration = float(_whole(np.array(motion.duration)))
    count = max(1, int(np.ceil(duration / period - 1e-9)))
    grid = np.append(np.arange(count) * period, duration)
    jumps = np.unique(_whole(motion.breaks))
    after = np.searchsorted(grid, jumps).clip(1, count)
    gaps = np.minimum(np.abs(jumps - grid[after - 1]), np.abs(grid[after] - jumps))
    jumps = jumps[gaps > MIN_GAP_S]
    if len(jumps):
        jumps = jumps[np.concatenate([[True], np.diff(jumps) > MIN_GAP_S])]
    return np.sort(np.concatenate([grid, jumps]))


def _whole(times: Array) -> Array:
    return np.asarray(np.round(times * 1e9) / 1e9)


def spline_excess(points: Trajectory, limits: MotionLimits) -> Array:
    """Return the largest velocity or acceleration between neighbouring points as a fraction of its limit, (N - 1,).

    It is the larger of two splines: the cubic Hermite spline through positions and velocities, and the quintic one
    through accelerations as well.
    """
    spans = np.diff(points.times)[:, None]
    count = 1 + int(np.ceil(spans.max() / CHECK_PERIOD_S - 1e-6))
    places = np.linspace(0.0, 1.0, max(count, 3))
    worst = np.zeros(len(spans))
    for coefficients in _splines(points, spans):
        order = len(coefficients)
        powers = np.arange(1, order + 1)
        rates = coefficients * powers[:, None, None] / (spans * limits.velocity)
        turns = (coefficients * (powers * (powers - 1))[:, None, None] / (spans**2 * limits.acceleration))[1:]
        for values in (rates, turns):
            basis = places[:, None] ** np.arange(len(values))
            reached = np.abs(basis @ values.reshape(len(values), -1)).max(axis=0)
            worst = np.maximum(worst, reached.reshape(spans.shape[0], -1).max(axis=1))
    return worst


def _splines(points: Trajectory, spans: Array) -> tuple[Array, Array]:
    """Return coefficients of the cubic and the quintic over a segment scaled to 0..1, from the first power on."""
    moved = np.diff(points.positions, axis=0)
    v0, v1 = points.velocities[:-1] * spans, points.velocities[1:] * spans
    a0, a1 = 0.5 * points.accelerations[:-1] * spans**2, 0.5 * points.accelerations[1:] * spans**2
    cubic = np.stack([v0, 3.0 * moved - 2.0 * v0 - v1, v0 + v1 - 2.0 * moved])
    quintic = np.stack(
        [
            v0,
            a0,
            10.0 * moved - 6.0 * v0 - 4.0 * v1 - 3.0 * a0 + a1,
            -15.0 * moved + 8.0 * v0 + 7.0 * v1 + 3.0 * a0 - 2.0 * a1,
            6.0 * moved - 3.0 * v0 - 3.0 * v1 - a0 + a1,
        ]
    )
    return cubic, quintic
