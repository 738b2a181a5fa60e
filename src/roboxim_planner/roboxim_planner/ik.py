"""Inverse kinematics of the TCP: damped least squares from many starts, in the native kernel.

The result is deterministic: the starts come from the caller's seed and the budget is a number of iterations. Any serial
arm of revolute and prismatic joints is supported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose
from roboxim_planner.native import native
from roboxim_planner.robot import PlannerRobot, pose_matrix

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """Budget and accuracy of the search."""

    position_tolerance_m: float = 1e-6
    """Largest position error of a solution [m]."""
    rotation_tolerance_rad: float = 1e-5
    """Largest rotation error of a solution [rad]."""
    iterations: int = 24
    """Iterations per start."""
    starts: int = 100
    """Number of starts: the reference, some near it, the rest uniform within the limits."""
    enough: int = 16
    """Number of converged starts after which `IkSolver.solve` ends; many converge to the same solution."""
    thorough: int = 8
    """Factor on ``starts`` and ``enough`` for a thorough search, used when no solution was free of collisions."""
    same_rad: float = 0.05
    """Solutions closer than this in every joint count as one [rad]."""


class IkSolver:
    """Finds arm configurations that put the TCP at a pose in the robot's base."""

    def __init__(self, robot: PlannerRobot, config: IkConfig | None = None) -> None:
        """Create a solver for an arm.

        Args:
            robot: The robot.
            config: Budget and accuracy; none: the defaults.
        """
        self.robot = robot
        self.config = config or IkConfig()

    def nearest(self, target: Pose, reference: Array) -> Array | None:
        """Return the solution that a descent from a reference reaches, or none if it does not converge.

        Args:
            target: The TCP in the robot's base.
            reference: Arm configuration to start from, shape (dof,) [rad].
        """
        found, _, _ = self._run(target, reference, seed=0, starts=1, enough=1)
        return found[0] if len(found) else None

    def any(self, target: Pose, reference: Array, *, seed: int = 0) -> Array:
        """Return the first solution found, starting at the reference; arguments and errors as `solve`."""
        return np.asarray(self._found(target, reference, seed=seed, starts=self.config.starts, enough=1)[0])

    def solve(self, target: Pose, reference: Array, *, seed: int, thorough: bool = False) -> Array:
        """Return the distinct solutions found, nearest to the reference first.

        Args:
            target: The TCP in the robot's base.
            reference: Arm configuration to measure distances from, shape (dof,) [rad].
            seed: Seed of the starts.
            thorough: Whether to look for `IkConfig.thorough` times as many solutions.

        Returns:
            Shape (N, dof), N >= 1.

        Raises:
            PlannerError: ``GOAL_UNREACHABLE``; the message says how close the TCP came.
        """
        times = self.config.thorough if thorough else 1
        starts, enough = times * self.config.starts, times * self.config.enough
        return self.distinct(self._found(target, reference, seed=seed, starts=starts, enough=enough), reference)

    def _found(self, target: Pose, reference: Array, *, seed: int, starts: int, enough: int) -> Array:
        """Return solutions; search longer before giving up, because a few poses at the edge of reach need it."""
        found, off, turned = self._run(target, reference, seed=seed, starts=starts, enough=enough)
        if not len(found):
            found, off, turned = self._run(target, reference, seed=seed + 1, starts=4 * starts, enough=enough, longer=4)
        if not len(found):
            raise _unreachable(target, off, turned, self.robot.description)
        return found

    def _run(
        self, target: Pose, reference: Array, *, seed: int, starts: int, enough: int, longer: int = 1
    ) -> tuple[Array, float, float]:
        config = self.config
        return self.robot.arm.ik(
            pose_matrix(target),
            reference,
            seed=seed,
            starts=starts,
            enough=enough,
            iterations=longer * config.iterations,
            position_tolerance=config.position_tolerance_m,
            rotation_tolerance=config.rotation_tolerance_rad,
        )

    def distinct(self, found: Array, reference: Array) -> Array:
        """Return solutions of shape (N, dof) without repeats (`IkConfig.same_rad`), nearest to a reference first."""
        return native.distinct(found, reference, self.config.same_rad)


def _unreachable(target: Pose, off: float, turned: float, robot: RobotModel) -> PlannerError:
    position, quat = (np.round(part, 4).tolist() for part in (target.position, target.quat_xyzw))
    few = (
        f" (its {len(robot.joint_names)} joints turn the tool in {robot.rotations} directions, so ask for a tool that "
        "points down, or one that leans within the plane of the arm)"
        if robot.rotations < 3
        else ""
    )
    return PlannerError(
        f"goal unreachable: the TCP came within {1000.0 * off:.1f} mm and {turned:.3f} rad of position "
        f"{position}, quaternion {quat} in the robot's base; move or turn the goal{few}",
        ErrorCode.GOAL_UNREACHABLE,
    )
