"""Straight-line motions of the TCP: position linear, rotation along the shortest arc, one speed law for both.

The joint path comes from inverse kinematics at dense places along the line, each started from the solution before it.
Where this ends early, the search uses the arm's redundancy to continue. The motion is a smooth spline through the joint
path, driven by a one-degree-of-freedom Ruckig profile. The profile is stretched in time until every joint limit holds.
Stretching is exact: velocity, acceleration and jerk fall with the factor, its square and its cube.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Pose, distance
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.motions.paths import Watch
from roboxim_planner.motions.timing import Motion, MotionLimits, line_profile, require_duration, still
from roboxim_planner.robot import PlannerRobot, pose_matrix

Array = npt.NDArray[np.float64]
_NODE_M = 0.004
_NODE_RAD = 0.02
_MIN_NODES = 8
_JUMP_RAD = 0.15
_SWING_RAD = 0.06
_LAYER = 24
_SMOOTHING = 8
_LINE_RESOLUTION_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class LinePath:
    """Joint path of a straight line of the TCP."""

    joints: Array
    """Arm configurations at evenly spaced places from the start to where the line could be followed, (N, dof) [rad]."""
    fraction: float
    """Fraction of the line that the configurations cover, 0..1."""
    length_m: float
    """Length of the whole line [m]."""
    angle_rad: float
    """Angle that the whole line turns by [rad]."""
    reason: str = ""
    """Reason why the path ends early; empty if it covers the whole line."""

    def part(self, count: int) -> float:
        """Return the fraction of the line that the first ``count`` configurations cover, 0..1."""
        return self.fraction * (count - 1) / max(1, len(self.joints) - 1)

    def cut(self, count: int) -> LinePath:
        """Return the line up to its first ``count`` configurations."""
        return replace(self, joints=self.joints[:count], fraction=self.part(count))


def follow_line(robot: PlannerRobot, start: Array, target: Pose) -> LinePath:
    """Follow a straight line by inverse kinematics from a configuration, moving each joint as little as possible.

    Args:
        robot: The robot.
        start: Arm configuration at the start, shape (dof,) [rad].
        target: The TCP at the end of the line, in the robot's base.
    """
    begin = robot.fk(start)
    length, angle = distance(begin, target)
    poses = _matrices(line_poses(begin, target, _count(length, angle)))
    path, reason = [start], ""
    previous = start
    for i, pose in enumerate(poses[1:], start=1):
        joints, error = _near(robot, pose, path[-1] + (path[-1] - previous))
        jump = float(np.abs(joints - path[-1]).max())
        if error > 0.0 or jump > _JUMP_RAD:
            reason = _why(robot, joints, jump, error, (i - 1) / (len(poses) - 1), length)
            break
        previous = path[-1]
        path.append(joints)
    fraction = (len(path) - 1) / (len(poses) - 1)
    return LinePath(joints=np.array(path), fraction=fraction, length_m=length, angle_rad=angle, reason=reason)


def follow_line_widely(
    robot: PlannerRobot, start: Array, target: Pose, world: CollisionWorld | None, watch: Watch
) -> LinePath:
    """Follow a straight line, using the arm's redundancy to get past limits, singularities and obstacles.

    At each place along the line many configurations are kept. Each is reached from one at the place before, with the
    elbow unchanged or swung slightly to either side. Of the chains that get farthest the smoothest is returned.

    Args:
        robot: The robot.
        start: Arm configuration at the start, shape (dof,) [rad].
        target: The TCP at the end of the line, in the robot's base.
        world: Robot and obstacles; none: collisions are not checked.
        watch: Called at each place; ends the request by raising.
    """
    begin = robot.fk(start)
    length, angle = distance(begin, target)
    poses = _matrices(line_poses(begin, target, _count(length, angle)))
    layers = [[_Knot(joints=start, move=np.zeros(robot.dof), cost=0.0, before=-1)]]
    for place, pose in enumerate(poses[1:]):
        watch("line", place)
        reached = _next_layer(robot, layers[-1], pose, world)
        if not reached:
            break
        layers.append(reached)
    chain, k = [], int(np.argmin([knot.cost for knot in layers[-1]]))
    for layer in reversed(layers):
        chain.append(layer[k].joints)
        k = layer[k].before
    joints = _smoothed(robot, np.array(chain[::-1]), poses, world)
    fraction = (len(joints) - 1) / (len(poses) - 1)
    reason = "" if fraction == 1.0 else f"no position of the elbow continues at {100.0 * fraction:.0f} % of the line"
    return LinePath(joints=joints, fraction=fraction, length_m=length, angle_rad=angle, reason=reason)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Knot:
    joints: Array
    move: Array
    cost: float
    before: int


def _next_layer(robot: PlannerRobot, layer: list[_Knot], pose: Array, world: CollisionWorld | None) -> list[_Knot]:
    reached: list[_Knot] = []
    for before, knot in enumerate(layer):
        swings = np.linalg.svd(robot.kinematics.jacobian(knot.joints))[2][6:]
        for guess in (knot.move, *(sign * _SWING_RAD * swing for swing in swings for sign in (1.0, -1.0))):
            joints, error = _near(robot, pose, knot.joints + guess)
            move = joints - knot.joints
            if error > 0.0 or float(np.abs(move).max()) > _JUMP_RAD:
                continue
            if world is not None and not world.edge_is_free(knot.joints, joints, _LINE_RESOLUTION_M):
                continue
            cost = knot.cost + float(np.square(move - knot.move).sum())
            reached.append(_Knot(joints=joints, move=move, cost=cost, before=before))
    reached.sort(key=lambda knot: knot.cost)
    kept: list[_Knot] = []
    for knot in reached:
        if len(kept) < _LAYER and all(np.abs(knot.joints - other.joints).max() > 0.5 * _SWING_RAD for other in kept):
            kept.append(knot)
    return kept


def _smoothed(robot: PlannerRobot, path: Array, poses: Array, world: CollisionWorld | None) -> Array:
    """Move each inner configuration towards the middle of its neighbours, without moving the TCP."""
    path = path.copy()
    for turn in range(_SMOOTHING):
        for i in range(1 + turn % 2, len(path) - 1, 2):
            joints, error = _near(robot, poses[i], 0.5 * (path[i - 1] + path[i + 1]))
            trial = np.stack([path[i - 1], joints, path[i + 1]])
            if error == 0.0 and (world is None or world.path_is_free(trial, _LINE_RESOLUTION_M)):
                path[i] = joints
    return path


def _near(robot: PlannerRobot, pose: Array, guess: Array) -> tuple[Array, float]:
    """Return the configuration that a descent from a guess reaches for a pose (4, 4), and its position error [m]."""
    guess = np.clip(guess, robot.lower, robot.upper)
    off = 0.0
    for arm in (robot.arm_within_limits, robot.arm):
        found, off, _ = arm.ik(
            pose, guess, seed=0, starts=1, enough=1, iterations=40, position_tolerance=1e-7, rotation_tolerance=1e-6
        )
        if len(found):
            return found[0], 0.0
    return guess, max(off, 1e-9)


def _count(length: float, angle: float) -> int:
    return 1 + max(_MIN_NODES, int(np.ceil(max(length / _NODE_M, angle / _NODE_RAD))))


def _matrices(poses: list[Pose]) -> Array:
    return np.array([pose_matrix(pose) for pose in poses])


def line_poses(begin: Pose, end: Pose, count: int) -> list[Pose]:
    """Return evenly spaced poses of a straight line, both ends included."""
    from scipy.spatial.transform import Rotation

    turn = (end.rotation * begin.rotation.inv()).as_rotvec()
    a, b = np.array(begin.position), np.array(end.position)
    places = np.linspace(0.0, 1.0, count)
    return [Pose.from_arrays(a + s * (b - a), Rotation.from_rotvec(s * turn) * begin.rotation) for s in places]


def _why(robot: PlannerRobot, joints: Array, jump: float, error: float, fraction: float, length: float) -> str:
    at = f"at {100.0 * fraction:.0f} % of the line ({1000.0 * fraction * length:.1f} of {1000.0 * length:.1f} mm)"
    names = robot.description.joint_names
    stopped = [n for n, q, lo, hi in zip(names, joints, robot.lower, robot.upper, strict=True) if not lo < q < hi]
    if stopped:
        return f"{' and '.join(stopped)} at a limit {at}"
    if jump > _JUMP_RAD:
        return f"the arm would have to jump by {jump:.2f} rad {at}, a singularity"
    return f"out of reach {at}, off by {1000.0 * error:.1f} mm"


class LineMotion:
    """Timed motion along a joint path whose configurations are evenly spaced along the TCP's line."""

    def __init__(self, joints: Array, limits: MotionLimits, length_m: float, angle_rad: float) -> None:
        """Time the path.

        Args:
            joints: Arm configurations, shape (N, dof), N >= 2 [rad].
            limits: Limits.
            length_m: Distance that the TCP covers along ``joints`` [m].
            angle_rad: Angle that it turns by [rad].

        Raises:
            PlannerError: ``TRAJECTORY_INVALID`` when the motion would take too long.
        """
        from scipy.interpolate import make_interp_spline

        if len(joints) < 4:  # sample the line or parabola at four places, because a third derivative is needed
            few = make_interp_spline(np.linspace(0.0, 1.0, len(joints)), joints, k=len(joints) - 1)
            joints = few(np.linspace(0.0, 1.0, 4))
        knots = np.linspace(0.0, 1.0, len(joints))
        path = make_interp_spline(knots, joints, k=min(5, len(joints) - 1))
        self._path = [path, *(path.derivative(k) for k in (1, 2, 3))]
        slope = np.maximum(np.abs(self._path[1](np.linspace(0.0, 1.0, 4 * len(joints)))).max(axis=0), 1e-9)
        speed = min(
            float((limits.velocity / slope).min()),
            0.999 * limits.tcp_speed / max(length_m, 1e-12),
            0.999 * limits.tcp_rot_speed / max(angle_rad, 1e-12),
        )
        acceleration, jerk = float((limits.acceleration / slope).min()), float((limits.jerk / slope).min())
        for _ in range(5):  # one pass is enough, except for peaks between the samples
            self._set_law(*line_profile(1.0, 0.0, 0.0, speed, acceleration, jerk))
            factor = self._excess(limits)
            if factor <= 1.0:
                break
            factor *= 1.0005
            speed, acceleration, jerk = speed / factor, acceleration / factor**2, jerk / factor**3

    def _set_law(self, durations: Array, coefficients: Array) -> None:
        from scipy.interpolate import PPoly

        law = PPoly(coefficients, np.concatenate([[0.0], np.cumsum(durations)]))
        require_duration(float(law.x[-1]))
        self._law = [law, *(law.derivative(k) for k in (1, 2, 3))]

    def _excess(self, limits: MotionLimits) -> float:
        """Return the factor by which time must be stretched for every limit to hold (<= 1: they hold)."""
        count = max(400, int(2000.0 * self.duration))
        breaks = self._law[0].x
        times = np.unique(np.concatenate([np.linspace(0.0, self.duration, count), breaks, breaks - 1e-9]))
        _, v, a, j = self.evaluate(times)
        return max(
            float((np.abs(v) / limits.velocity).max()),
            float(np.sqrt((np.abs(a) / limits.acceleration).max())),
            float(np.cbrt((np.abs(j) / limits.jerk).max())),
        )

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self._law[0].x[-1])

    @property
    def breaks(self) -> Array:
        """Times at which the jerk may jump [s]."""
        return np.asarray(self._law[0].x)

    def evaluate(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Return positions, velocities, accelerations, jerks by the chain rule."""
        clipped = np.clip(times, 0.0, self.duration)
        s, ds, dds, ddds = (np.asarray(d(clipped))[:, None] for d in self._law)
        q, q1, q2, q3 = (np.asarray(d(np.clip(s[:, 0], 0.0, 1.0))) for d in self._path)
        return q, q1 * ds, q2 * ds**2 + q1 * dds, q3 * ds**3 + 3.0 * q2 * ds * dds + q1 * ddds


def time_line(path: LinePath, limits: MotionLimits) -> Motion:
    """Return the timed motion along a followed line; a line of no length gives a motion at rest."""
    if len(path.joints) < 2 or float(np.abs(path.joints - path.joints[0]).max()) < 1e-9:
        return still(path.joints[0])
    return LineMotion(path.joints, limits, path.fraction * path.length_m, path.fraction * path.angle_rad)
