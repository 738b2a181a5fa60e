"""Joint trajectories of external requests: validated on arrival, then sampled at the physics rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.poses import Array

SPEED_MARGIN = 1.2
"""Allowed excess over the joints' velocity limits between points; faster trajectories are rejected as a mistake."""
START_TOLERANCE_RAD = 0.01
BETWEEN_POINTS_RAD = 1e-3
"""Allowed excess over the joint limits between points, for splines through points at a limit."""
CHECK_S = 1 / 240
"""Time between the positions that are checked between points [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrajectory:
    """A trajectory that starts at the arm's commanded position."""

    times_s: Array
    """Increasing times from 0, shape (m,) [s]."""
    positions: Array
    """Arm joint positions, shape (m, n) [rad]."""
    velocities: Array | None
    """Arm joint velocities, shape (m, n) [rad/s]; none: straight lines between the points."""
    accelerations: Array | None = None
    """Arm joint accelerations, shape (m, n) [rad/s^2]; none: cubic splines, else quintic ones."""

    @property
    def duration_s(self) -> float:
        """Time of the last point [s]."""
        return float(self.times_s[-1])

    def sample(self, times_s: npt.ArrayLike) -> Array:
        """Return the joint positions at the given times [s], shape (k, n) [rad]; after the end: the last point."""
        return self._sample(times_s, 0)

    def sample_velocities(self, times_s: npt.ArrayLike) -> Array:
        """Return the joint velocities at the given times [s], shape (k, n) [rad/s]; after the end: 0."""
        times = np.asarray(times_s, dtype=float)
        return np.where((times < self.duration_s)[:, None], self._sample(times, 1), 0.0)

    def _sample(self, times_s: npt.ArrayLike, order: int) -> Array:
        at = np.minimum(np.asarray(times_s, dtype=float), self.duration_s)
        if len(self.times_s) == 1:
            return np.tile(self.positions if order == 0 else 0.0 * self.positions, (len(at), 1))
        return np.asarray(self._curve(at, order))

    @cached_property
    def _curve(self) -> Any:
        """Interpolation between the points, a function of the times and the order of the derivative."""
        from scipy.interpolate import BPoly, CubicHermiteSpline, make_interp_spline

        if self.velocities is None:
            return make_interp_spline(self.times_s, self.positions, k=1)
        if self.accelerations is None:
            return CubicHermiteSpline(self.times_s, self.positions, self.velocities)
        derivatives = np.stack([self.positions, self.velocities, self.accelerations], axis=1)
        return BPoly.from_derivatives(self.times_s, derivatives)


def checked_trajectory(
    arm: ArmKinematics,
    commanded: Sequence[float],
    times_s: Sequence[float],
    positions: npt.ArrayLike,
    velocities: npt.ArrayLike | None,
    accelerations: npt.ArrayLike | None = None,
) -> JointTrajectory:
    """Check a trajectory and let it start at the commanded joint positions.

    Args:
        arm: The arm.
        commanded: Commanded joint positions [rad].
        times_s: Times from the start, shape (m,) [s]; if the first is above 0 the arm moves to the first point by then.
        positions: Arm joint positions, shape (m, n) [rad].
        velocities: Arm joint velocities, shape (m, n) [rad/s], or none.
        accelerations: Arm joint accelerations, shape (m, n) [rad/s^2], or none.

    Raises:
        InvalidRequestError: With code ``TRAJECTORY_INVALID`` on a wrong shape, NaN, times that do not increase,
            positions beyond the limits (also between the points), a start that differs from the arm's position, jumps
            that no motor can follow, or accelerations without velocities.
    """
    times, points = np.asarray(times_s, dtype=float), np.asarray(positions, dtype=float)
    speeds = None if velocities is None else np.asarray(velocities, dtype=float)
    turns = None if accelerations is None else np.asarray(accelerations, dtype=float)
    rates = [array for array in (speeds, turns) if array is not None]
    shape = (len(times), len(arm.model.joint_names))
    if not len(times) or points.shape != shape or any(array.shape != shape for array in rates):
        raise _invalid(f"needs positions (and velocities) of shape {shape}, at least one point, got {points.shape}")
    if not all(np.isfinite(array).all() for array in (times, points, *rates)):
        raise _invalid("holds a number that is not finite")
    if turns is not None and speeds is None:
        raise _invalid("has accelerations but no velocities")
    if times[0] < 0 or np.any(np.diff(times) <= 0):
        raise _invalid(f"needs increasing times from 0, got {limits.echo(times.tolist())}")
    if times[-1] > limits.MOTION_S:
        raise _invalid(f"may last {limits.MOTION_S:g} s, got {times[-1]:g}")
    outside = [index for index, point in enumerate(points) if not arm.within_limits(point, -1e-6)]
    if outside:
        raise _invalid(f"leaves the joint limits at point {outside[0]}: {points[outside[0]].tolist()}")
    if times[0] > 0:
        times, points = np.append(0.0, times), np.vstack([commanded, points])
        speeds = None if speeds is None else np.vstack([np.zeros(shape[1]), speeds])
        turns = None if turns is None else np.vstack([np.zeros(shape[1]), turns])
    elif np.abs(points[0] - commanded).max() > START_TOLERANCE_RAD:
        raise _invalid(f"starts at {points[0].round(3).tolist()}, but the arm is at {np.round(commanded, 3).tolist()}")
    mean_speed = np.abs(np.diff(points, axis=0)) / np.diff(times)[:, None]
    if np.any(mean_speed > SPEED_MARGIN * arm.velocity):
        raise _invalid(f"is faster than the joints' velocity limits {arm.model.limits.velocity}")
    if speeds is not None and np.any(np.abs(speeds) > SPEED_MARGIN * arm.velocity):
        raise _invalid(f"has velocities beyond the joints' limits {arm.model.limits.velocity}")
    made = JointTrajectory(times_s=times, positions=points, velocities=speeds, accelerations=turns)
    if speeds is not None:
        moments = np.arange(0.0, times[-1], CHECK_S)
        passed = made.sample(moments)
        excess = np.maximum(arm.lower - passed, passed - arm.upper).max(axis=1)
        if len(beyond := np.flatnonzero(excess > BETWEEN_POINTS_RAD)):
            raise _invalid(
                f"leaves the joint limits between its points: {moments[beyond[0]]:.3f} s after its start the spline is "
                f"at {passed[beyond[0]].round(3).tolist()}; add points or lower the velocities"
            )
    return made


def _invalid(problem: str) -> InvalidRequestError:
    return InvalidRequestError(f"the trajectory {problem}", ErrorCode.TRAJECTORY_INVALID)
