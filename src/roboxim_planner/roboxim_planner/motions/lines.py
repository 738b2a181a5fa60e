"""One straight line of the TCP, timed and verified.

The plain search follows the line with one configuration. Only if it ends early, the wide search uses the redundancy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Pose
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.motions.cartesian import LinePath, follow_line, follow_line_widely, time_line
from roboxim_planner.motions.paths import Watch
from roboxim_planner.motions.timing import Motion, MotionLimits
from roboxim_planner.motions.verify import LIMIT_PERIOD_S, at_fault, between, verify_motion
from roboxim_planner.robot import PlannerRobot

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """The executable part of a straight line."""

    motion: Motion
    """Its verified motion."""
    part: float
    """Fraction of the line that the motion covers, 0..1."""
    end: Array
    """Arm configuration at its end, shape (dof,) [rad]."""
    reason: str
    """Why the line ends early; empty when it does not."""


def plan_line(
    robot: PlannerRobot,
    sweep: Sweep | None,
    start: Array,
    target: Pose,
    limits: MotionLimits,
    watch: Watch,
    *,
    wide: bool = True,
) -> Line:
    """Plan a straight line of the TCP.

    Args:
        robot: The robot.
        sweep: Checks the robot among the obstacles; none: collisions are not checked.
        start: Arm configuration at the start, shape (dof,) [rad].
        target: The TCP at the end, in the robot's base.
        limits: Limits of the motion.
        watch: Called regularly; ends the request by raising.
        wide: Whether to search widely (see `follow_line_widely`) if the plain line ends early; takes about a hundred
            times as long.
    """
    plain = _line(robot, sweep, follow_line(robot, start, target), limits, watch)
    if plain.part == 1.0 or not wide:
        return plain
    world = None if sweep is None else sweep.exact
    wider = _line(robot, sweep, follow_line_widely(robot, start, target, world, watch), limits, watch)
    return wider if wider.part > plain.part + 1e-9 else plain


def _line(robot: PlannerRobot, sweep: Sweep | None, path: LinePath, limits: MotionLimits, watch: Watch) -> Line:
    count, reason = _free_part(sweep, path.joints)
    reason = reason or path.reason
    while True:
        motion: Motion = time_line(path.cut(count), limits)
        finding = verify_motion(sweep, robot, motion, limits)
        if finding.valid or count < 2:
            return Line(motion=motion, part=path.part(count), end=path.joints[count - 1], reason=reason)
        # only the curve between the configurations breaks a limit: end before the place where it does
        reason = f"the timed motion is not valid: {finding}"
        watch("verify", count)
        count = max(1, min(count - 1, _nearest(path.joints, motion, finding.index)))


def _nearest(path: Array, motion: Motion, index: int) -> int:
    """Return the index of the configuration that is nearest to a motion at a millisecond, the last one for -1."""
    if index < 0:
        return len(path) - 1
    there = motion.evaluate(np.array([LIMIT_PERIOD_S * index]))[0][0]
    return int(np.argmin(np.abs(path - there).max(axis=1)))


def _free_part(sweep: Sweep | None, path: Array) -> tuple[int, str]:
    """Return the number of leading free configurations, edges between them included, and the reason for the end."""
    hit = -1.0 if sweep is None else sweep.exact.first_hit(path)
    if sweep is None or hit < 0.0:
        return len(path), ""
    contacts, broken = at_fault(sweep.exact, between(path, hit))
    causes = "; ".join([*(str(contact) for contact in contacts[:3]), *broken])
    return max(1, math.ceil(hit)), causes
