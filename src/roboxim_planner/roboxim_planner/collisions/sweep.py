"""Collision checks of sweeps (finely sampled paths), also between the samples."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.constraint import Upright
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]
MIN_PADDING_M = 1e-3
"""Smallest padding of a search, used even if the request sets none: barely clear paths are slow to prove [m].

Pairs that are nearer at the start or at a goal get less.
"""


class Sweep:
    """Checks sweeps of one robot in one scene."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0, upright: Upright | None = None
    ) -> None:
        """Store the arguments; the geometry is built on first use.

        Args:
            robot: The robot.
            scene: The bodies around it.
            padding: Distance that must be kept from obstacles [m].
            upright: Path constraint on the tool; none: unconstrained.
        """
        self.robot = robot
        self.scene = scene
        self.padding = padding
        self.upright = upright

    @cached_property
    def exact(self) -> CollisionWorld:
        """The robot in the scene."""
        return CollisionWorld(self.robot, self.scene, padding=self.padding, upright=self.upright)

    def first_hit(self, samples: Array) -> int:
        """Return the index of the first sample of a sweep of shape (N, dof) at or after a collision, or -1."""
        return self.exact.first_collision(samples)

    def is_proven(self, samples: Array) -> bool:
        """Return whether a sweep of shape (N, dof) touches nothing."""
        return self.exact.is_proven(samples)


class PaddedSweep(Sweep):
    """A sweep that checks the scene exactly, and provides the same scene with the padding of a search."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, search_padding: float, upright: Upright | None
    ) -> None:
        """Store the arguments; the exact check has no padding.

        Args:
            robot: The robot.
            scene: The bodies around it.
            search_padding: Distance that searches keep from obstacles where start and goal allow it [m].
            upright: Path constraint on the tool; none: unconstrained.
        """
        super().__init__(robot, scene, upright=upright)
        self.search_padding = search_padding

    def eased(self, begin: Array, goals: Array, part: float = 1.0) -> CollisionWorld:
        """Return the world to search in: padded, with less padding for pairs that are nearer at the start or a goal.

        Args:
            begin: Free arm configuration at the start, shape (dof,) [rad].
            goals: Free arm configurations, shape (N, dof) [rad].
            part: Fraction of the padding to keep.
        """
        return self.exact.eased(part * max(self.search_padding, MIN_PADDING_M), np.vstack([begin, goals]))

    def check_upright(self, begin: Array) -> None:
        """Check that the tool is upright at the start.

        Raises:
            PlannerError: ``CONSTRAINT_VIOLATED``.
        """
        if self.upright is not None and (tilt := self.exact.tilt(begin)) > self.upright.tolerance_rad:
            raise PlannerError(
                f"the tool is tilted by {tilt:.3f} rad at the start, {self.upright.tolerance_rad:g} rad allowed",
                ErrorCode.CONSTRAINT_VIOLATED,
            )
