"""Measures beside success: force, speed, path, smoothness, what was touched, and volumes to keep out of.

They are recorded in the episodes of tasks that have ``limits``, at each tick for the episode so far. They change a
verdict only if the task demands it.

Non-obvious: a volume is entered by any link of the arm or the gripper, by its collision shapes, or by the origin of an
object that the robot touches. The generator writes into the limits which arm that is; in episodes from before it did,
the tool centre point stands for the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.config import from_json
from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.volumes import link_volumes
from roboxim_core.specs import TaskSpec
from roboxim_core.state import Contact, StateRecord
from roboxim_core.verdicts import LIMIT
from roboxim_tasks.measures import Assessment
from roboxim_tasks.motion import ROBOT
from roboxim_tasks.roles import LIMITS, task_distractors

MOVING = 0.05
"""Share of the peak speed above which the tool counts as moving, as is usual for measures of smoothness."""
SHORTEST = 5
"""Fewest ticks of a motion whose smoothness is measured."""


@dataclass(frozen=True, kw_only=True)
class KeepOut:
    """Box in the world that the robot is to keep out of."""

    lower: tuple[float, float, float]
    """Least x, y, z [m]."""
    upper: tuple[float, float, float]
    """Greatest x, y, z [m]."""

    def __post_init__(self) -> None:
        """Check the corners.

        Raises:
            ConfigError: When the box has no inside.
        """
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ConfigError(f"keep_out: 'lower' must be below 'upper', got {self.lower} and {self.upper}")

    def holds(self, point: npt.ArrayLike) -> bool:
        """Return whether a point [m] in the world is inside."""
        return bool(np.all(np.greater(point, self.lower)) and np.all(np.less(point, self.upper)))


@dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """Limits of a task, besides what its skill asks for; ``limits: {}`` only measures."""

    force_n: float = 0.0
    """Largest force of a contact of the robot [N]; 0: no limit."""
    speed_m_s: float = 0.0
    """Largest speed of the tool centre point [m/s]; 0: no limit."""
    path_m: float = 0.0
    """Longest path of the tool centre point [m]; 0: no limit."""
    distractors: int = -1
    """Most distractors that the robot touches; -1: no limit."""
    keep_out: tuple[KeepOut, ...] = ()
    """Volumes that the robot, and what it touches, keep out of."""
    robot: str = ""
    """Robot of ``config/robots`` whose links keep out; set by the generator."""
    fail: bool = False
    """Whether an episode that crosses a limit has failed; otherwise the crossing is only recorded."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a limit is negative, or there is none to fail by.
        """
        for name in ("force_n", "speed_m_s", "path_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"limits: {name} must be a number of 0 or more, got {value}")
        if self.fail and not (self.force_n or self.speed_m_s or self.path_m or self.keep_out or self.distractors >= 0):
            raise ConfigError("limits: 'fail' needs a limit: force_n, speed_m_s, path_m, distractors or keep_out")


class Limits:
    """Fold of an episode's states into its measures; an evaluator that every task may have besides its skill's."""

    hold_s = 0.0

    def __init__(self, limits: LimitsConfig, task: TaskSpec) -> None:
        """Start at tick 0.

        Args:
            limits: The limits.
            task: The task, which names the distractors.
        """
        self._limits = limits
        self._distractors = {thing.entity for thing in task_distractors(task)}
        self._touched: set[str] = set()
        self._force_n = self._inside_s = 0.0
        self._positions: list[tuple[float, ...]] = []
        self._times: list[float] = []

    def assess(self, state: StateRecord) -> Assessment:
        """Assess the next tick."""
        limits, tcp = self._limits, state.robot.pose_tcp_measured.position
        touching = {c.body_a if c.body_b == ROBOT else c.body_b: c for c in _of_robot(state)}
        self._force_n = max([self._force_n, *(contact.force_max for contact in _of_robot(state))])
        self._touched |= {name for name, contact in touching.items() if contact.force_max > 0} & self._distractors
        places = [tcp, *(entity.pose.position for entity in state.entities if entity.name in touching)]
        inside = any(box.holds(place) for box in limits.keep_out for place in places)
        if limits.robot and not inside:
            robot = state.robot
            where = robot.joint_positions, robot.finger_positions, robot.pose_tcp_measured
            inside = any(link_volumes(limits.robot).inside(*where, box.lower, box.upper) for box in limits.keep_out)
        tick_s = state.stamp_ns / 1e9 - (self._times[-1] if self._times else state.stamp_ns / 1e9)
        self._inside_s += tick_s * inside
        self._positions.append(tuple(tcp))
        self._times.append(state.stamp_ns / 1e9)
        return self._assessment()

    def _assessment(self) -> Assessment:
        limits, found = self._limits, course_of(np.array(self._positions), np.array(self._times))
        values = {
            "force_max_n": self._force_n, "speed_max_m_s": found.speed_m_s, "path_m": found.path_m,
            "smoothness": found.smoothness, "distractors_touched": float(len(self._touched)),
        }  # fmt: skip
        values |= {"keep_out_s": self._inside_s} if limits.keep_out else {}
        crossed = {
            "too_much_force": bool(limits.force_n) and self._force_n > limits.force_n,
            "too_fast": bool(limits.speed_m_s) and found.speed_m_s > limits.speed_m_s,
            "path_too_long": bool(limits.path_m) and found.path_m > limits.path_m,
            "touched_distractors": 0 <= limits.distractors < len(self._touched),
            "in_keep_out": self._inside_s > 0,
        }
        values["crossed"] = float(sum(crossed.values()))
        failed = limits.fail and any(crossed.values())
        return Assessment(
            solved=not failed,
            failed=failed,
            reason=next(name for name, is_so in crossed.items() if is_so) if failed else "",
            predicates={f"{LIMIT}{name}": value for name, value in values.items()},
        )


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What a path of the tool centre point says."""

    speed_m_s: float
    """Largest speed between two ticks [m/s]."""
    path_m: float
    """Length [m]."""
    smoothness: float
    """Log dimensionless jerk, see `log_dimensionless_jerk`; 0: the motion is too short."""


def course_of(positions: npt.NDArray[np.float64], times: npt.NDArray[np.float64]) -> Motion:
    """Return the measures of a path.

    Args:
        positions: Places of the tool centre point [m], shape (T, 3).
        times: Their times [s], equally spaced, shape (T,).
    """
    if len(positions) < 2:
        return Motion(speed_m_s=0.0, path_m=0.0, smoothness=0.0)
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    speeds = lengths / np.diff(times)
    smoothness = log_dimensionless_jerk(positions, float(times[1] - times[0]))
    return Motion(speed_m_s=float(speeds.max()), path_m=float(lengths.sum()), smoothness=smoothness)


def log_dimensionless_jerk(positions: npt.NDArray[np.float64], tick_s: float) -> float:
    """Return the smoothness of a path: higher is smoother; a single minimum-jerk motion has -4.4.

    It is ``-ln(D^3 / v^2 * integral of |jerk|^2)``: D is the motion's duration from the first to the last tick faster
    than 5 % of its peak speed v. It depends on the number of motions, so it compares actors in the same task and rate.

    Args:
        positions: Places [m], shape (T, 3).
        tick_s: Time between two of them [s].

    Returns:
        0 when the motion is shorter than 5 ticks.

    Source:
        Hogan and Sternad, Sensitivity of smoothness measures to movement duration, amplitude, and arrests (J. Motor
        Behavior 41, 2009); the logarithm as in Balasubramanian et al., On the analysis of movement smoothness
        (J. NeuroEng. Rehab. 12:112, 2015).
    """
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / tick_s
    moving = np.flatnonzero(speeds > MOVING * speeds.max(initial=0.0))
    if not len(moving):
        return 0.0
    part = positions[moving[0] : moving[-1] + 2]
    if len(part) < SHORTEST:
        return 0.0
    jerk = np.diff(part, n=3, axis=0) / tick_s**3
    duration = (len(part) - 1) * tick_s
    total = float((jerk**2).sum(axis=1).mean()) * duration
    return -math.log(max(duration**3 / float(speeds.max()) ** 2 * total, 1e-12))


def limits_of(task: TaskSpec) -> LimitsConfig | None:
    """Return the limits of a task; None: it has none, and nothing is measured.

    Raises:
        ConfigError: When its arguments state them in another form.
    """
    if LIMITS not in task.arguments:
        return None
    return from_json(str(task.arguments[LIMITS]), LimitsConfig, source=f"limits of task '{task.instruction}'")


def _of_robot(state: StateRecord) -> list[Contact]:
    return [contact for contact in state.contacts if ROBOT in (contact.body_a, contact.body_b)]
