"""Final verification of a motion: the timed trajectory is sampled densely and every guarantee is checked on samples.

Verification is independent of the way in which the motion was made:

- Collisions are checked on the exact geometry, by the native kernel all along the motion and by coal at some states.
- Limits are checked every millisecond.
- The end is checked against the goal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_planner import native
from roboxim_planner.collisions.checker import TOUCH_M, CollisionWorld, ContactPair
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.motions.paths import Watch
from roboxim_planner.motions.timing import Motion, MotionLimits
from roboxim_planner.robot import PlannerRobot

Array = npt.NDArray[np.float64]
LIMIT_PERIOD_S = 1e-3
WITNESSED_STATES = 24
CHECKED_AT_ONCE = 200
"""Number of trajectory points between two calls of the watch."""
_SPREAD = np.linspace(0.0, 1.0, WITNESSED_STATES)
_SLACK = 1.0 + 1e-3
_COLLIDES = "the motion collides"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Findings of a check; empty: valid."""

    contacts: tuple[ContactPair, ...] = ()
    """Pairs that touch at the first collision, deepest first."""
    violations: tuple[str, ...] = ()
    """Broken limits, as sentences."""
    time_s: float = -1.0
    """Time of the first collision [s]; negative: none."""
    index: int = -1
    """The last point of a trajectory, or millisecond of a motion, at or before the first fault; -1: none."""

    @property
    def valid(self) -> bool:
        """Whether the motion is valid."""
        return not self.contacts and not self.violations

    def __str__(self) -> str:
        """Format the finding for an error message."""
        when = f" at {self.time_s:.3f} s" if self.time_s >= 0 else ""
        return "; ".join([*(f"{contact}{when}" for contact in self.contacts), *self.violations]) or "valid"


def verify_motion(
    sweep: Sweep | None,
    robot: PlannerRobot,
    motion: Motion,
    limits: MotionLimits,
    goal: Array | None = None,
    *,
    explain: bool = True,
) -> Finding:
    """Check a timed motion.

    Args:
        sweep: Checks the robot among the obstacles; none: collisions are not checked.
        robot: The robot.
        motion: The motion.
        limits: Limits that the motion must keep.
        goal: Arm configuration that the motion must end at, shape (dof,) [rad]; none: not checked.
        explain: Whether to report where a motion collides, and the touching pairs.
    """
    times = np.append(np.arange(0.0, motion.duration, LIMIT_PERIOD_S), motion.duration)
    q, v, a, j = motion.evaluate(times)
    violations = _limit_violations(robot, q, limits, velocities=v, accelerations=a, jerks=j)
    if goal is not None and float(np.abs(q[-1] - goal).max()) > 1e-6:
        violations += (f"the motion ends {np.abs(q[-1] - goal).max():.2g} rad from its goal",)
    if float(np.abs(v[[0, -1]]).max()) > 1e-6:
        violations += ("the motion does not start and end at rest",)
    if violations and not explain:
        return Finding(violations=violations)
    if sweep is not None and not explain and not sweep.is_proven(q):
        return Finding(violations=(_COLLIDES,))
    hit = -1 if sweep is None or not explain else sweep.first_hit(q)
    if sweep is not None and hit < 0:
        hit = _witnessed_hit(sweep, q)
    index = _first_beyond(robot, q, limits, v, a, j) if violations and explain else -1
    if sweep is None or hit < 0:
        return Finding(violations=violations, index=index)
    if not explain:
        return Finding(violations=(_COLLIDES,))
    contacts, broken = at_fault(sweep.exact, q[hit])
    if not contacts and not broken:  # the graze lies before this sample
        contacts, broken = at_fault(sweep.exact, q[max(0, hit - 1)])
    if not contacts and not broken:
        broken = (f"the arm grazes something just before {times[hit]:.3f} s",)
    index = hit if index < 0 else min(index, hit)
    return Finding(contacts=contacts, violations=violations + broken, time_s=float(times[hit]), index=index)


def _witnessed_hit(sweep: Sweep, path: Array) -> int:
    """Check states spread evenly over a path with coal; return the index of the first that collides, or -1.

    The native kernel has already proven the whole path. coal shares no code with it, so this check is independent.
    """
    stride = 1 + len(path) // (8 * WITNESSED_STATES)
    chosen = np.append(np.arange(0, len(path) - 1, stride), len(path) - 1)
    travel = np.append(0.0, np.cumsum(np.abs(np.diff(path[chosen], axis=0)).sum(axis=1)))
    places = chosen[np.minimum(np.searchsorted(travel, travel[-1] * _SPREAD), len(chosen) - 1)]
    is_free = sweep.exact.coal.is_free
    return next((place for place in dict.fromkeys(places.tolist()) if not is_free(path[place])), -1)


def verify_samples(
    sweep: Sweep,
    limits: MotionLimits,
    positions: Array,
    times: Array | None = None,
    velocities: Array | None = None,
    accelerations: Array | None = None,
    watch: Watch = lambda *_: None,
) -> Finding:
    """Check a joint path or sampled trajectory, with straight lines between its points.

    Args:
        sweep: Checks the robot among the obstacles.
        limits: Limits that the trajectory must keep.
        positions: Arm configurations, shape (N, dof), N >= 1 [rad].
        times: Times of the points, strictly increasing, shape (N,) [s]; none: a path without times.
        velocities: Velocities at the points, shape (N, dof) [rad/s]; none: computed from positions and times.
        accelerations: Accelerations at the points, shape (N, dof) [rad/s^2]; none: not checked.
        watch: Called now and then; ends the check by raising.
    """
    robot = sweep.robot
    if times is not None and velocities is None and len(positions) > 1:
        velocities = np.diff(positions, axis=0) / np.diff(times)[:, None]
        velocities = np.concatenate([velocities, velocities[-1:]])  # of the line after each point
    violations = _limit_violations(
        robot, positions, limits, velocities=velocities, accelerations=accelerations, jerks=None
    )
    first = _first_beyond(robot, positions, limits, velocities, accelerations, None) if violations else -1
    hit = _first_hit(sweep.exact, positions, watch)
    if hit < 0.0:
        hit = float(_witnessed_hit(sweep, positions))
    if hit < 0.0:
        return Finding(violations=violations, index=first)
    index = int(hit)
    contacts, broken = at_fault(sweep.exact, between(positions, hit))
    if not contacts and not broken:
        broken = (f"the arm grazes something near point {index}",)
    return Finding(
        contacts=contacts,
        violations=violations + broken,
        time_s=-1.0 if times is None else float(np.interp(hit, np.arange(len(times)), times)),
        index=index if first < 0 else min(first, index),
    )


def _first_hit(world: CollisionWorld, path: Array, watch: Watch) -> float:
    """Return where a polyline first collides, in units of its points; negative: no collision."""
    for first in range(0, max(1, len(path) - 1), CHECKED_AT_ONCE):
        watch("verify", first)
        hit = world.first_hit(path[first : first + CHECKED_AT_ONCE + 1])
        if hit >= 0.0:
            return first + hit
    return -1.0


def at_fault(world: CollisionWorld, joints: Array) -> tuple[tuple[ContactPair, ...], tuple[str, ...]]:
    """Return why an arm configuration is not free: the pairs that touch, and a sentence if the tool is tilted."""
    tilt = world.tilt(joints)
    contacts = world.contacts(joints)
    if world.upright is None or tilt <= world.upright.tolerance_rad:
        return contacts or world.contacts(joints, 2.0 * TOUCH_M), ()
    return contacts, (f"the tool is tilted by {tilt:.3f} rad, {world.upright.tolerance_rad:g} rad allowed",)


def between(path: Array, place: float) -> Array:
    """Return the configuration at a place on a polyline of shape (N, dof); 1.5 is midway between points 1 and 2."""
    i = min(int(place), len(path) - 1)
    following = path[min(i + 1, len(path) - 1)]
    return np.asarray(path[i] + (place - i) * (following - path[i]))


def _limit_violations(
    robot: PlannerRobot,
    positions: Array,
    limits: MotionLimits,
    *,
    velocities: Array | None,
    accelerations: Array | None,
    jerks: Array | None,
) -> tuple[str, ...]:
    names = robot.description.joint_names
    found = []
    lows, highs = native.extremes(positions)
    for i in np.flatnonzero((lows < robot.lower - 1e-6) | (highs > robot.upper + 1e-6)):
        low, high = lows[i], highs[i]
        worst = low if robot.lower[i] - low > high - robot.upper[i] else high
        found.append(f"{names[i]} reaches {worst:.4f} rad, outside [{robot.lower[i]:.4f}, {robot.upper[i]:.4f}]")
    for what, unit, values, limit in (
        ("velocity", "rad/s", velocities, limits.velocity),
        ("acceleration", "rad/s^2", accelerations, limits.acceleration),
        ("jerk", "rad/s^3", jerks, limits.jerk),
    ):
        if values is not None:
            peaks = np.abs(native.extremes(values)).max(axis=0)
            joint = int(np.argmax(peaks / limit))
            if peaks[joint] > _SLACK * limit[joint]:
                peak, bound = peaks[joint], limit[joint]
                found.append(f"{what} of {names[joint]} reaches {peak:.4g} {unit}, its limit is {bound:.4g}")
    if limits.limits_tcp and velocities is not None:
        found.extend(_tcp_violations(robot, positions, velocities, limits))
    return tuple(found)


def _first_beyond(
    robot: PlannerRobot,
    positions: Array,
    limits: MotionLimits,
    velocities: Array | None,
    accelerations: Array | None,
    jerks: Array | None,
) -> int:
    """Return the index of the first point that breaks a limit; see `_limit_violations`. -1: none."""
    beyond = ((positions < robot.lower - 1e-6) | (positions > robot.upper + 1e-6)).any(axis=1)
    for values, limit in (
        (velocities, limits.velocity),
        (accelerations, limits.acceleration),
        (jerks, limits.jerk),
    ):
        if values is not None:
            beyond |= (np.abs(values) > _SLACK * limit).any(axis=1)
    if limits.limits_tcp and velocities is not None:
        beyond |= (robot.arm.tcp_speeds(positions, velocities) > _tcp_bounds(limits)).any(axis=1)
    return int(np.argmax(beyond)) if beyond.any() else -1


def _tcp_bounds(limits: MotionLimits) -> Array:
    """Return the largest speed [m/s] and angular speed [rad/s] of the TCP, shape (2,), with their slack."""
    return np.array([limits.tcp_speed, limits.tcp_rot_speed]) * (_SLACK + 0.01)


def _tcp_violations(robot: PlannerRobot, positions: Array, velocities: Array, limits: MotionLimits) -> list[str]:
    rates = robot.arm.tcp_speeds(positions, velocities)
    found = []
    linear, angular = _tcp_bounds(limits)
    for what, unit, speeds, limit, bound in (
        ("speed", "m/s", rates[:, 0], limits.tcp_speed, linear),
        ("angular speed", "rad/s", rates[:, 1], limits.tcp_rot_speed, angular),
    ):
        if speeds.max() > bound:
            found.append(f"{what} of the TCP reaches {speeds.max():.4g} {unit}, its limit is {limit:.4g}")
    return found
