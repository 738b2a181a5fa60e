"""Options of a motion request and the resulting plan, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, one_of
from roboxim_planner.constraint import Upright
from roboxim_planner.motions.paths import FINDERS, IMPROVERS
from roboxim_planner.motions.points import Trajectory, controller_points, sample
from roboxim_planner.motions.timing import Motion, MotionLimits

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """Options of a motion request."""

    velocity_scaling: float = 1.0
    """Fraction of the joints' velocity limits, in (0, 1]."""
    acceleration_scaling: float = 1.0
    """Fraction of the joints' acceleration and jerk limits, in (0, 1]."""
    max_tcp_speed_m_s: float = np.inf
    """Limit of the TCP's speed [m/s]."""
    max_tcp_rot_speed_rad_s: float = np.inf
    """Limit of the TCP's angular speed [rad/s]."""
    padding_m: float | None = None
    """Distance that searches keep from obstacles if start and goal allow it, at least 1 mm [m]; none: the planner's."""
    upright: Upright | None = None
    """Path constraint; none: the tool may turn freely."""
    planner: str = "RRTConnect"
    """Path planner to begin with; one of `paths.IMPROVERS` continues from the first path to shorter ones."""
    improve_iterations: int | None = None
    """Iterations of a planner that improves; none: `SearchConfig.improve_iterations`."""
    seed: int = 0
    """Seed of the search, >= 0; the same request and seed give the same plan."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a value that is not a number or out of range, or an unknown planner.
        """
        for name in ("velocity_scaling", "acceleration_scaling"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidRequestError(f"{name} must be in (0, 1], got {getattr(self, name)}")
        for name in ("max_tcp_speed_m_s", "max_tcp_rot_speed_rad_s"):
            if not getattr(self, name) > 0.0:
                raise InvalidRequestError(f"{name} must be positive, got {getattr(self, name)}")
        if self.padding_m is not None and not 0.0 <= self.padding_m <= 0.1:
            raise InvalidRequestError(f"padding must be 0..0.1 m, got {self.padding_m}")
        if self.planner not in (*FINDERS, *IMPROVERS):
            raise InvalidRequestError(
                f"unknown planner '{self.planner}'; {one_of((*FINDERS, *IMPROVERS), self.planner)}"
            )
        if self.improve_iterations is not None:
            limits.require_range("improve_iterations", self.improve_iterations, 1, limits.IMPROVE_ITERATIONS)
        if self.seed < 0:
            raise InvalidRequestError(f"seed must be >= 0, got {self.seed}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A verified motion."""

    motion: Motion
    """The motion as a function of time."""
    limits: MotionLimits
    """Limits that the motion keeps."""
    route: str
    """How the motion was found: ``still``, ``direct``, ``sampled``, ``cartesian`` or ``retimed``."""
    goal_index: int = -1
    """Index of the goal reached; -1 if the request has a single goal."""
    fraction: float = 1.0
    """Fraction of a straight line that the motion covers, 0..1."""
    waypoints: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Joint path that was timed, shape (N, dof) [rad]."""

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self.motion.duration

    @property
    def end(self) -> Array:
        """Arm configuration at the end, shape (dof,) [rad]."""
        return np.asarray(self.motion.evaluate(np.array([self.duration]))[0][0])

    def sample(self, period_s: float) -> Trajectory:
        """Sample the motion at a period [s], its end included."""
        count = max(1, int(np.ceil(self.duration / period_s - 1e-9)))
        return sample(self.motion, np.append(np.arange(count) * period_s, self.duration))

    def points(self, period_s: float) -> Trajectory:
        """Return points for a controller at a period [s]; see `controller_points` for the errors."""
        return controller_points(self.motion, self.limits, period_s)


class PathIncompleteError(PlannerError):
    """A straight line can only be followed in part; ``partial`` is the verified plan of that part."""

    code = ErrorCode.PATH_INCOMPLETE

    def __init__(self, message: str, partial: Plan) -> None:
        """Create the error with the plan of the executable part."""
        super().__init__(message)
        self.partial = partial
