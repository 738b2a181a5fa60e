"""Final verification of a motion: the timed trajectory is sampled densely and every guarantee is checked on samples.

Verification is independent of the way in which the motion was made:

- Collisions are checked on the exact geometry, by the native kernel all along the motion and by coal at some states.
- Limits are checked every millisecond.
- The end is checked against the goal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_planner.collisions.checker import TOUCH_M, CollisionWorld, ContactPair
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.motions.paths import Watch
from roboxim_planner.motions.timing import Motion, MotionLimits
from roboxim_planner.native import native
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
    limited = list(_limited(robot, limits, q, v, a, j))
    violations = tuple(text for one in limited for text in one.violations())
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
    index = _first_beyond(limited) if violations and explain else -1
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
    limited = list(_limited(robot, limits, positions, velocities, accelerations, None))
    violations = tuple(text for one in limited for text in one.violations())
    first = _first_beyond(limited) if violations else -1
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Limited:
    """A quantity along a trajectory, with its limits."""

    values: Array
    """Shape (N, K)."""
    lower: Array
    """Least allowed values, tolerance included, shape (K,)."""
    upper: Array
    """Greatest allowed values, tolerance included, shape (K,)."""
    sentence: Callable[[int, float], str]
    """Says that a component reaches a value."""
    every: bool = False
    """Whether every component beyond its limits is named, rather than the one that is furthest beyond."""

    def violations(self) -> Iterator[str]:
        """Yield what breaks the limits, as sentences."""
        lows, highs = native.extremes(self.values)
        worst = np.where(self.lower - lows > highs - self.upper, lows, highs)
        beyond = np.flatnonzero((lows < self.lower) | (highs > self.upper))
        if len(beyond) and not self.every:
            beyond = beyond[[np.argmax(np.abs(worst[beyond]) / self.upper[beyond])]]
        yield from (self.sentence(int(i), float(worst[i])) for i in beyond)

    def beyond(self) -> npt.NDArray[np.bool_]:
        """Return whether each point breaks a limit, shape (N,)."""
        return np.asarray(((self.values < self.lower) | (self.values > self.upper)).any(axis=1))


def _limited(
    robot: PlannerRobot,
    limits: MotionLimits,
    positions: Array,
    velocities: Array | None,
    accelerations: Array | None,
    jerks: Array | None,
) -> Iterator[_Limited]:
    """Yield the limited quantities of a trajectory, each of shape (N, dof); none: not checked."""
    names, low, high = robot.description.joint_names, robot.lower, robot.upper
    yield _Limited(
        values=positions, lower=low - 1e-6, upper=high + 1e-6, every=True,
        sentence=lambda i, value: f"{names[i]} reaches {value:.4f} rad, outside [{low[i]:.4f}, {high[i]:.4f}]",
    )  # fmt: skip
    for what, unit, values, limit in (
        ("velocity", "rad/s", velocities, limits.velocity),
        ("acceleration", "rad/s^2", accelerations, limits.acceleration),
        ("jerk", "rad/s^3", jerks, limits.jerk),
    ):
        if values is not None:
            yield _at_most([f"{what} of {name}" for name in names], unit, values, limit, _SLACK)
    if limits.limits_tcp and velocities is not None:
        speeds = robot.arm.tcp_speeds(positions, velocities)
        for column, (what, unit, most) in enumerate(
            (("speed", "m/s", limits.tcp_speed), ("angular speed", "rad/s", limits.tcp_rot_speed))
        ):
            yield _at_most([f"{what} of the TCP"], unit, speeds[:, [column]], np.array([most]), _SLACK + 0.01)


def _at_most(names: Sequence[str], unit: str, values: Array, limit: Array, slack: float) -> _Limited:
    """Return a quantity of either sign with the greatest sizes of its components."""
    return _Limited(
        values=values, lower=-slack * limit, upper=slack * limit,
        sentence=lambda i, value: f"{names[i]} reaches {abs(value):.4g} {unit}, its limit is {limit[i]:.4g}",
    )  # fmt: skip


def _first_beyond(limited: Sequence[_Limited]) -> int:
    """Return the index of the first point that breaks a limit; -1: none."""
    beyond = np.any([one.beyond() for one in limited], axis=0)
    return int(np.argmax(beyond)) if beyond.any() else -1
