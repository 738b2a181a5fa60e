"""A time law for a given joint path: simplified and blended within a tolerance, or exact with a stop at each point.

A time law that follows a dense path point by point could hardly gain speed between two points. So the path is first
replaced by fewer lines that stay within half the tolerance. The blends at their corners get the other half.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError
from roboxim_planner.checks import no_watch
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.motions.paths import SAME_RAD, Watch, without_repeats
from roboxim_planner.motions.timing import still, time_path
from roboxim_planner.motions.verify import Finding, verify_motion
from roboxim_planner.pipeline import MotionOptions, Plan, Planner
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]
DEFAULT_TOLERANCE_RAD = 0.1
_SHRINK = (1.0, 0.3, 0.1)
_BLEND_DEPTH = 0.1875
"""A blend that begins at distance ``d`` before a corner passes it at this factor times ``d`` times the turn."""


def retime(
    planner: Planner,
    path: npt.ArrayLike,
    options: MotionOptions | None = None,
    *,
    tolerance_rad: float = DEFAULT_TOLERANCE_RAD,
    stop_at_points: bool = False,
    scene: PlanningScene | None = None,
    watch: Watch = no_watch,
) -> Plan:
    """Give a joint path a time law within the limits.

    Args:
        planner: Planner of the robot.
        path: Arm configurations, shape (N, dof), N >= 2 [rad].
        options: Limits; none: the defaults.
        tolerance_rad: Largest distance of the motion from the path, in any joint [rad].
        stop_at_points: Whether to pass exactly through each point, stopping there.
        scene: Obstacles to avoid; none: collisions are not checked.
        watch: Called now and then; ends the request by raising.

    Returns:
        The verified motion; its route is ``retimed``.

    Raises:
        InvalidRequestError: On a malformed path or tolerance.
        PlannerError: ``TRAJECTORY_INVALID`` if the path itself leaves the limits or collides.
    """
    options = options or MotionOptions()
    points = _checked(planner, path)
    if not 0.0 < tolerance_rad <= 1.0:
        raise InvalidRequestError(f"path_tolerance must be in (0, 1] rad, got {tolerance_rad}")
    points = without_repeats(points)
    limits = planner.limits(options)
    if len(points) < 2 or float(np.abs(points - points[0]).max()) < 1e-9:
        return Plan(motion=still(points[0]), limits=limits, route="retimed", waypoints=points)
    sweep = None if scene is None else Sweep(planner.robot, scene)
    finding = Finding()
    for factor in (*(() if stop_at_points else _SHRINK), 0.0):
        half = 0.5 * factor * tolerance_rad
        line = simplified(points, half, watch) if half else points
        watch("timing", 0)
        motion = time_path(line, _corners(line, half), limits, planner.robot.kinematics.jacobian)
        watch("verify", 0)
        finding = verify_motion(sweep, planner.robot, motion, limits, points[-1])
        if finding.valid:
            return Plan(motion=motion, limits=limits, route="retimed", waypoints=line)
    raise PlannerError(f"the path cannot be executed as it is: {finding}", ErrorCode.TRAJECTORY_INVALID)


def _checked(planner: Planner, path: npt.ArrayLike) -> Array:
    points = np.asarray(path, dtype=float)
    robot = planner.robot
    if points.ndim != 2 or len(points) < 2 or points.shape[1] != robot.dof or not np.isfinite(points).all():
        raise InvalidRequestError(
            f"a path needs at least 2 finite points of {robot.dof} joints, got an array of shape {points.shape}"
        )
    for i, point in enumerate(points):
        broken = robot.limit_violations(point)
        if broken:
            raise PlannerError(f"point {i} of the path: {'; '.join(broken)}", ErrorCode.TRAJECTORY_INVALID)
    return np.asarray(np.clip(points, robot.lower, robot.upper))


def simplified(path: Array, tolerance: float, watch: Watch = no_watch) -> Array:
    """Return a path of fewer points that stays within a tolerance in every joint (Douglas and Peucker, 1973).

    Args:
        path: Arm configurations, shape (N, dof), N >= 2 [rad].
        tolerance: Largest distance, in any joint, of an omitted point from the line that replaces it [rad].
        watch: Called now and then; ends the request by raising.

    Returns:
        Shape (M, dof), both ends included.
    """
    kept = {0, len(path) - 1}
    pending = [(0, len(path) - 1)]
    while pending:
        first, last = pending.pop()
        watch("simplify", len(kept))
        if last - first < 2:
            continue
        chord = path[last] - path[first]
        inner = path[first + 1 : last] - path[first]
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-18), 0.0, 1.0)
        away = np.abs(inner - along[:, None] * chord).max(axis=1)
        worst = int(np.argmax(away))
        if away[worst] > tolerance or np.abs(chord).max() <= SAME_RAD:  # a closed path keeps its farthest point
            middle = first + 1 + worst
            kept.add(middle)
            pending += [(first, middle), (middle, last)]
    return np.asarray(path[sorted(kept)])


def _corners(path: Array, tolerance: float) -> Array:
    """Return the distance from each inner point at which its blend begins, so that it stays within the tolerance."""
    deltas = np.diff(path, axis=0)
    lengths = np.linalg.norm(deltas, axis=1)
    directions = deltas / lengths[:, None]
    turns = np.abs(np.diff(directions, axis=0)).max(axis=1, initial=0.0)
    room = 0.499 * np.minimum(lengths[:-1], lengths[1:])
    return np.asarray(np.minimum(room, tolerance / (_BLEND_DEPTH * np.maximum(turns, 1e-9))))
