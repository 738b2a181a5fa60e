"""The last word on a motion: the timed trajectory is sampled densely and every promise is checked on the samples.

Nothing here trusts how the motion was made: collisions are checked on the exact geometry, by the native kernel all
along the motion and by coal at some states of it; limits are checked at a millisecond's spacing, the end against the
goal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_planner.collision import CollisionWorld, ContactPair
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.sweep import Sweep
from roboxim_planner.timing import Motion, MotionLimits

Array = npt.NDArray[np.float64]
LIMIT_PERIOD_S = 1e-3
WITNESSED_STATES = 32
_SLACK = 1.0 + 1e-3


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a check found; empty means valid."""

    contacts: tuple[ContactPair, ...] = ()
    """Pairs that touch at the first colliding place, deepest first."""
    violations: tuple[str, ...] = ()
    """Broken limits, as sentences."""
    time_s: float = -1.0
    """Time of the first collision [s]; negative: none."""
    index: int = -1
    """For a sampled trajectory: its first point at or after which something is wrong; -1: none."""

    @property
    def valid(self) -> bool:
        """Whether nothing was found."""
        return not self.contacts and not self.violations

    def __str__(self) -> str:
        """Say it for an error message."""
        when = f" at {self.time_s:.3f} s" if self.time_s >= 0 else ""
        return "; ".join([*(f"{contact}{when}" for contact in self.contacts), *self.violations]) or "valid"


def verify_motion(
    sweep: Sweep | None,
    robot: PlannerRobot,
    motion: Motion,
    limits: MotionLimits,
    goal: Array | None = None,
) -> Finding:
    """Check a timed motion.

    Args:
        sweep: Checks the robot among the obstacles; none: collisions are not checked.
        robot: The robot.
        motion: The motion.
        limits: What it must keep within.
        goal: Arm configuration that it must end at; none: not checked.
    """
    times = np.append(np.arange(0.0, motion.duration, LIMIT_PERIOD_S), motion.duration)
    q, v, a, j = motion.evaluate(times)
    violations = _limit_violations(robot, times, q, limits, velocities=v, accelerations=a, jerks=j)
    if goal is not None and float(np.abs(q[-1] - goal).max()) > 1e-6:
        violations += (f"the motion ends {np.abs(q[-1] - goal).max():.2g} rad from its goal",)
    if float(np.abs(v[[0, -1]]).max()) > 1e-6:
        violations += ("the motion does not start and end at rest",)
    hit = -1 if sweep is None else sweep.first_hit(q)
    if sweep is not None and hit < 0:
        hit = _witnessed_hit(sweep, q)
    if sweep is None or hit < 0:
        return Finding(violations=violations)
    contacts, broken = at_fault(sweep.exact, q[hit])
    if not contacts and not broken:  # a graze lies before this sample
        contacts, broken = at_fault(sweep.exact, q[max(0, hit - 1)])
    if not contacts and not broken:
        broken = (f"the arm grazes something just before {times[hit]:.3f} s",)
    return Finding(contacts=contacts, violations=violations + broken, time_s=float(times[hit]))


def _witnessed_hit(sweep: Sweep, path: Array) -> int:
    """Return the first of some states, spread evenly over a path, at which coal finds a collision, or -1.

    The native kernel has proven the whole path by then; this is a second opinion, which no fault in it can share.
    """
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).sum(axis=1))])
    places = np.searchsorted(travel, np.linspace(0.0, travel[-1], WITNESSED_STATES))
    for place in np.unique(np.minimum(places, len(path) - 1)):
        if not sweep.exact.coal.is_free(path[place]):
            return int(place)
    return -1


def verify_samples(
    sweep: Sweep,
    limits: MotionLimits,
    positions: Array,
    times: Array | None = None,
    velocities: Array | None = None,
    accelerations: Array | None = None,
) -> Finding:
    """Check a joint path or sampled trajectory, straight lines between its points.

    Args:
        sweep: Checks the robot among the obstacles.
        limits: What it must keep within.
        positions: Arm configurations, shape (N, dof), N >= 1 [rad].
        times: Times of the points, strictly increasing, shape (N,) [s]; none: a path without speed.
        velocities: Velocities at the points, shape (N, dof) [rad/s]; none: those between points follow from the times.
        accelerations: Accelerations at the points, shape (N, dof) [rad/s^2]; none: not checked.
    """
    robot = sweep.robot
    if times is not None and velocities is None and len(positions) > 1:
        velocities = np.diff(positions, axis=0) / np.diff(times)[:, None]
        velocities = np.concatenate([velocities[:1], velocities])
    violations = _limit_violations(
        robot, times, positions, limits, velocities=velocities, accelerations=accelerations, jerks=None
    )
    inside = (positions >= robot.lower - 1e-6) & (positions <= robot.upper + 1e-6)
    first = int(np.argmin(inside.all(axis=1))) if not inside.all() else -1
    hit = sweep.exact.first_hit(positions)
    if hit < 0.0:
        hit = float(_witnessed_hit(sweep, positions))
    if hit < 0.0:
        return Finding(violations=violations, index=first if first >= 0 else (0 if violations else -1))
    index = int(hit)
    contacts, broken = at_fault(sweep.exact, between(positions, hit))
    if not contacts and not broken:
        broken = (f"the arm grazes something near point {index}",)
    return Finding(
        contacts=contacts,
        violations=violations + broken,
        time_s=-1.0 if times is None else float(times[index]),
        index=index if first < 0 else min(first, index),
    )


def at_fault(world: CollisionWorld, joints: Array) -> tuple[tuple[ContactPair, ...], tuple[str, ...]]:
    """Return what is wrong at an arm configuration that is not free: what touches, and whether the tool is tilted."""
    tilt = world.tilt(joints)
    if world.upright is None or tilt <= world.upright.tolerance_rad:
        return world.contacts(joints), ()
    return world.contacts(joints), (
        f"the tool is tilted by {tilt:.3f} rad, {world.upright.tolerance_rad:g} rad allowed",
    )


def between(path: Array, place: float) -> Array:
    """Return the configuration at a place on a polyline of shape (N, dof), in units of its points."""
    i = min(int(place), len(path) - 1)
    following = path[min(i + 1, len(path) - 1)]
    return np.asarray(path[i] + (place - i) * (following - path[i]))


def _limit_violations(
    robot: PlannerRobot,
    times: Array | None,
    positions: Array,
    limits: MotionLimits,
    *,
    velocities: Array | None,
    accelerations: Array | None,
    jerks: Array | None,
) -> tuple[str, ...]:
    names = robot.description.joint_names
    found = []
    for i, name in enumerate(names):
        low, high = float(positions[:, i].min()), float(positions[:, i].max())
        if low < robot.lower[i] - 1e-6 or high > robot.upper[i] + 1e-6:
            worst = low if robot.lower[i] - low > high - robot.upper[i] else high
            found.append(f"{name} reaches {worst:.4f} rad, outside [{robot.lower[i]:.4f}, {robot.upper[i]:.4f}]")
    for what, unit, values, limit in (
        ("velocity", "rad/s", velocities, limits.velocity),
        ("acceleration", "rad/s^2", accelerations, limits.acceleration),
        ("jerk", "rad/s^3", jerks, limits.jerk),
    ):
        if values is not None:
            ratio = np.abs(values).max(axis=0) / limit
            worst = int(np.argmax(ratio))
            if ratio[worst] > _SLACK:
                peak = np.abs(values[:, worst]).max()
                found.append(f"{what} of {names[worst]} reaches {peak:.4g} {unit}, its limit is {limit[worst]:.4g}")
    if limits.limits_tcp and velocities is not None:
        found.extend(_tcp_violations(robot, positions, velocities, limits))
    return tuple(found)


def _tcp_violations(robot: PlannerRobot, positions: Array, velocities: Array, limits: MotionLimits) -> list[str]:
    rates = robot.arm.tcp_speeds(positions, velocities)
    found = []
    for what, unit, speeds, limit in (
        ("speed", "m/s", rates[:, 0], limits.tcp_speed),
        ("angular speed", "rad/s", rates[:, 1], limits.tcp_rot_speed),
    ):
        if speeds.max() > limit * (_SLACK + 0.01):
            found.append(f"{what} of the tcp reaches {speeds.max():.4g} {unit}, its limit is {limit:.4g}")
    return found
