"""Time laws: turn a path into a motion within velocity, acceleration and jerk limits.

Straight joint lines follow a one-degree-of-freedom Ruckig profile. Corners are blends, whose velocity turns smoothly
from the direction of one line to that of the next. The motion thus leaves the lines only in blends, which are checked
for collisions, and never exceeds a limit. The motion is one piecewise polynomial in time, evaluated in one call.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from ruckig import InputParameter, Result, Ruckig, Trajectory

from roboxim_core import limits as bounds
from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_planner.native import native

Array = npt.NDArray[np.float64]
_SAME = 1e-9
_PARTS = 12
_PART_RAD = 0.15
"""With a limit of the TCP's speed, a line is split into up to `_PARTS` parts of at least this length."""


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of a motion, scaling applied."""

    velocity: Array
    """Velocity limit of each arm joint, shape (dof,) [rad/s]."""
    acceleration: Array
    """Acceleration limit of each arm joint, shape (dof,) [rad/s^2]."""
    jerk: Array
    """Jerk limit of each arm joint, shape (dof,) [rad/s^3]."""
    tcp_speed: float = np.inf
    """Speed limit of the TCP [m/s]."""
    tcp_rot_speed: float = np.inf
    """Angular speed limit of the TCP [rad/s]."""

    @property
    def limits_tcp(self) -> bool:
        """Whether the TCP's speed is limited."""
        return bool(np.isfinite(self.tcp_speed) or np.isfinite(self.tcp_rot_speed))


class Motion(Protocol):
    """A timed joint motion."""

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""

    @property
    def breaks(self) -> Array:
        """Times at which the jerk may jump, increasing, shape (M,) [s]."""

    def evaluate(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Return positions, velocities, accelerations, jerks at times of shape (N,); each of shape (N, dof)."""


class PolynomialMotion:
    """A motion that is a piecewise polynomial in time."""

    def __init__(self, breaks: Array, coefficients: Array) -> None:
        """Make the motion.

        Args:
            breaks: Times between pieces, from 0, shape (M + 1,) [s].
            coefficients: Highest power first, shape (order + 1, M, dof).
        """
        self._breaks = np.ascontiguousarray(breaks)
        self._coefficients = np.ascontiguousarray(coefficients)

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self._breaks[-1])

    @property
    def breaks(self) -> Array:
        """Times at which the jerk may jump [s]."""
        return self._breaks

    def evaluate(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Return positions, velocities, accelerations, jerks."""
        q, v, a, j = native.sample_polynomial(self._breaks, self._coefficients, times)
        return q, v, a, j


class MotionSequence:
    """Motions in sequence, with rest in between."""

    def __init__(self, motions: list[Motion]) -> None:
        """Join motions; there is at least one.

        Raises:
            PlannerError: ``TRAJECTORY_INVALID`` when they take too long together.
        """
        self._motions = motions
        self._starts = np.concatenate([[0.0], np.cumsum([m.duration for m in motions])])
        require_duration(float(self._starts[-1]))

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self._starts[-1])

    @property
    def breaks(self) -> Array:
        """Times at which the jerk may jump [s]."""
        return np.concatenate([m.breaks + start for m, start in zip(self._motions, self._starts, strict=False)])

    def evaluate(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Return positions, velocities, accelerations, jerks."""
        which = np.clip(np.searchsorted(self._starts, times, side="right") - 1, 0, len(self._motions) - 1)
        parts = [m.evaluate(times[which == i] - self._starts[i]) for i, m in enumerate(self._motions)]
        q, v, a, j = (np.concatenate([part[k] for part in parts]) for k in range(4))
        return q, v, a, j


def require_duration(duration_s: float) -> None:
    """Refuse a motion that takes too long: it is sampled every millisecond, and its samples are held in memory.

    Args:
        duration_s: Duration of the motion [s].

    Raises:
        PlannerError: ``TRAJECTORY_INVALID``.
    """
    if not duration_s <= bounds.MOTION_S:
        raise PlannerError(
            f"the motion would take {duration_s:.4g} s, a motion may take {bounds.MOTION_S:g} s; allow more speed or "
            "acceleration",
            ErrorCode.TRAJECTORY_INVALID,
        )


def still(joints: Array) -> PolynomialMotion:
    """Return a motion at rest of one millisecond, for a goal equal to the start."""
    return PolynomialMotion(np.array([0.0, 1e-3]), joints[None, None, :].copy())


_own = threading.local()
_FACTORIALS = np.array([[6.0], [2.0], [1.0], [1.0]])


def _ruckig() -> tuple[Ruckig, InputParameter, Trajectory]:
    """Return this thread's Ruckig objects for one degree of freedom; creating them takes ten times as long as a use."""
    if not hasattr(_own, "ruckig"):
        _own.ruckig = Ruckig(1), InputParameter(1), Trajectory(1)
    made: tuple[Ruckig, InputParameter, Trajectory] = _own.ruckig
    return made


def line_profile(
    length: float, speed_in: float, speed_out: float, velocity: float, acceleration: float, jerk: float
) -> tuple[Array, Array]:
    """Return the time law of a line: durations (M,) [s] and cubic coefficients (4, M) of the distance travelled.

    Acceleration is zero at both ends.

    Args:
        length: Length of the line.
        speed_in: Speed at its start.
        speed_out: Speed at its end.
        velocity: Speed limit.
        acceleration: Acceleration limit.
        jerk: Jerk limit.

    Raises:
        PlannerError: If Ruckig finds no profile.
    """
    ruckig, request, result = _ruckig()
    request.current_position, request.target_position = [0.0], [length]
    request.current_velocity, request.target_velocity = [speed_in], [speed_out]
    request.max_velocity, request.max_acceleration, request.max_jerk = [velocity], [acceleration], [jerk]
    outcome = ruckig.calculate(request, result)
    if outcome not in (Result.Working, Result.Finished):
        raise PlannerError(f"no time law for a line of {length:.4g} from {speed_in:.4g} to {speed_out:.4g}: {outcome}")
    profile = result.profiles[0][0]
    durations = np.array(profile.t)
    kept = durations > 1e-12
    coefficients = np.array([profile.j, profile.a[:7], profile.v[:7], profile.p[:7]]) / _FACTORIALS
    return durations[kept], coefficients[:, kept]


class TcpRates:
    """Speed of the TCP per unit of joint path, to apply limits of its speed."""

    def __init__(self, jacobian: Callable[[Array], Array], limits: MotionLimits) -> None:
        """Store the TCP's Jacobian as a function of the arm configuration, and the limits."""
        self._jacobian = jacobian
        self._limits = limits

    def speed_limit(self, points: Array, directions: Array) -> float:
        """Return the largest path speed at which the TCP keeps its limits at points with directions (N, dof)."""
        if not self._limits.limits_tcp:
            return np.inf
        limit = np.inf
        for point, direction in zip(points, directions, strict=True):
            rate = self._jacobian(point) @ direction
            linear, angular = float(np.linalg.norm(rate[:3])), float(np.linalg.norm(rate[3:]))
            limit = min(
                limit,
                self._limits.tcp_speed / max(linear, 1e-12),
                self._limits.tcp_rot_speed / max(angular, 1e-12),
            )
        return 0.995 * limit


BLEND_SAMPLES = np.linspace(0.0, 1.0, 9)
_PLACES = np.linspace(0.0, 1.0, 17)[:, None]


def blend_points(before: Array, corner: Array, after: Array, distance: float) -> Array:
    """Return points on a corner's blend, shape (N, dof).

    Args:
        before: Waypoint before the corner.
        corner: The corner.
        after: Waypoint after it.
        distance: Distance from the corner at which the blend leaves and joins the lines [rad].
    """
    u, w = _direction(before, corner), _direction(corner, after)
    start = corner - distance * u
    ahead = BLEND_SAMPLES[:, None]
    turned = ahead**3 - 0.5 * ahead**4
    return start + 2.0 * distance * (u * ahead + (w - u) * turned)


def time_path(
    path: Array, corners: Array, limits: MotionLimits, jacobian: Callable[[Array], Array]
) -> PolynomialMotion:
    """Compute the time law of a polyline with blended corners.

    Args:
        path: Waypoints, shape (N, dof), N >= 2, neighbours distinct.
        corners: Distance from each inner waypoint at which its blend begins and ends, shape (N - 2,) [rad]; 0: stop.
        limits: Limits.
        jacobian: The TCP's Jacobian at an arm configuration, for limits of its speed.

    Raises:
        PlannerError: ``TRAJECTORY_INVALID`` when the motion would take too long.
    """
    rates = TcpRates(jacobian, limits)
    passed = np.zeros(len(corners), dtype=bool)
    if limits.limits_tcp:
        path, corners, passed = _split_lines(path, corners)
    deltas = np.diff(path, axis=0)
    lengths = np.linalg.norm(deltas, axis=1)
    directions = deltas / lengths[:, None]
    ends = np.concatenate([[0.0], corners, [0.0]])
    rest = np.maximum(lengths - ends[:-1] - ends[1:], 0.0)
    caps = _line_limits(path, directions, limits, rates)
    speeds = np.zeros(len(path))
    if len(corners):
        speeds[1:-1] = np.minimum(caps[:-1, 0], caps[1:, 0])
        turns = _corner_speeds(path, corners, directions, limits, rates)
        blended = corners > _SAME
        speeds[1:-1] = np.where(blended, np.minimum(turns, speeds[1:-1]), np.where(passed, speeds[1:-1], 0.0))
    rows = [(velocity, acceleration, jerk) for velocity, acceleration, jerk in caps.tolist()]
    _make_reachable(speeds, rest, rows)
    durations, pieces = [], []
    for i in range(len(lengths)):
        start = path[i] + ends[i] * directions[i]
        if rest[i] > _SAME:
            times, law = line_profile(rest[i], speeds[i], speeds[i + 1], *rows[i])
            durations.append(times)
            piece = np.zeros((5, len(times), path.shape[1]))
            piece[1:] = law[:, :, None] * directions[i]
            piece[4] += start
            pieces.append(piece)
        if i < len(corners) and corners[i] > _SAME:
            time, piece = _blend_piece(path[i + 1], corners[i], speeds[i + 1], directions[i], directions[i + 1])
            durations.append(np.array([time]))
            pieces.append(piece)
    if not durations:
        return still(path[-1])
    breaks = np.concatenate([[0.0], np.cumsum(np.concatenate(durations))])
    require_duration(float(breaks[-1]))
    return PolynomialMotion(breaks, np.concatenate(pieces, axis=1))


def _split_lines(path: Array, corners: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Split the lines between blends by points, so that each part of a line can have its own speed.

    Returns:
        The path, the blends of its inner points, and which inner points are passed straight, without blend or stop.
    """
    ends = np.concatenate([[0.0], corners, [0.0]])
    points, blends, passed = [path[0]], [], []
    for i in range(len(path) - 1):
        delta = path[i + 1] - path[i]
        length = float(np.linalg.norm(delta))
        rest = length - ends[i] - ends[i + 1]
        count = max(1, min(_PARTS, int(rest / _PART_RAD)))
        for k in range(1, count):
            points.append(path[i] + (ends[i] + rest * k / count) / length * delta)
            blends.append(0.0)
            passed.append(True)
        points.append(path[i + 1])
        if i < len(corners):
            blends.append(corners[i])
            passed.append(False)
    return np.array(points), np.array(blends), np.array(passed, dtype=bool)


def _direction(start: Array, end: Array) -> Array:
    delta = end - start
    return np.asarray(delta / np.linalg.norm(delta))


def _line_limits(path: Array, directions: Array, limits: MotionLimits, rates: TcpRates) -> Array:
    """Return the largest velocity, acceleration and jerk along each line of a path, shape (N - 1, 3)."""
    share = np.maximum(np.abs(directions), 1e-12)
    caps = np.stack([(limit / share).min(axis=1) for limit in (limits.velocity, limits.acceleration, limits.jerk)], 1)
    if limits.limits_tcp:
        for i, direction in enumerate(directions):
            points = path[i] + _PLACES * (path[i + 1] - path[i])
            caps[i, 0] = min(caps[i, 0], rates.speed_limit(points, np.broadcast_to(direction, points.shape)))
    return np.asarray(caps)


def _corner_speeds(path: Array, corners: Array, directions: Array, limits: MotionLimits, rates: TcpRates) -> Array:
    """Return the speed v through each blend.

    A blend takes 2 d / v, and its velocity turns by the smoothstep 3 s^2 - 2 s^3. Its acceleration peaks at
    0.75 v^2 |turn| / d and its jerk at 1.5 v^3 |turn| / d^2.
    """
    before, after = directions[:-1], directions[1:]
    turn = np.maximum(np.abs(after - before), 1e-12)
    largest = np.maximum(np.maximum(np.abs(before), np.abs(after)), 1e-12)
    distance = corners[:, None]
    speeds = (limits.velocity / largest).min(axis=1)
    speeds = np.minimum(speeds, np.sqrt(limits.acceleration * distance / (0.75 * turn)).min(axis=1))
    speeds = np.minimum(speeds, np.cbrt(limits.jerk * distance**2 / (1.5 * turn)).min(axis=1))
    if limits.limits_tcp:
        s = BLEND_SAMPLES[:, None]
        for i in np.flatnonzero(corners > _SAME):
            velocities = before[i] + (after[i] - before[i]) * (3.0 * s**2 - 2.0 * s**3)
            points = blend_points(path[i], path[i + 1], path[i + 2], corners[i])
            speeds[i] = min(speeds[i], rates.speed_limit(points, velocities))
    return np.asarray(speeds)


def _blend_piece(corner: Array, distance: float, speed: float, before: Array, after: Array) -> tuple[float, Array]:
    time = 2.0 * distance / speed
    turn = speed * (after - before)
    piece = np.zeros((5, 1, len(corner)))
    piece[0, 0] = -0.5 * turn / time**3
    piece[1, 0] = turn / time**2
    piece[3, 0] = speed * before
    piece[4, 0] = corner - distance * before
    return time, piece


def _make_reachable(speeds: Array, rest: Array, caps: list[tuple[float, float, float]]) -> None:
    """Lower corner speeds in place until every line is long enough for its change of speed."""
    for i in range(len(rest)):
        speeds[i + 1] = _reachable(speeds[i], speeds[i + 1], rest[i], caps[i])
    for i in reversed(range(len(rest))):
        speeds[i] = _reachable(speeds[i + 1], speeds[i], rest[i], caps[i])


def _reachable(low: float, high: float, length: float, cap: tuple[float, float, float]) -> float:
    """Return the largest speed, at most ``high``, that is reachable from ``low`` on a line of a length."""
    if high <= low or _change_distance(low, high, cap) <= length:
        return high
    bottom, top = low, high
    for _ in range(40):
        middle = 0.5 * (bottom + top)
        if _change_distance(low, middle, cap) <= 0.999 * length:
            bottom = middle
        else:
            top = middle
    return bottom


def _change_distance(low: float, high: float, cap: tuple[float, float, float]) -> float:
    _, acceleration, jerk = cap
    change = high - low
    time = (
        2.0 * np.sqrt(change / jerk)
        if change <= acceleration**2 / jerk
        else change / acceleration + acceleration / jerk
    )
    return 0.5 * (low + high) * float(time)
