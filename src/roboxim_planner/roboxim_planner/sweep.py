"""Whether a sweep, a finely sampled path, touches anything, also between its samples."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_planner.collision import CollisionWorld
from roboxim_planner.constraint import Upright
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]
LEAST_PADDING_M = 1e-3
"""That searches keep, where start and goal do, even if asked for none: what only just clears is slow to prove."""


class Sweep:
    """Checks sweeps of one robot in one scene."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0, upright: Upright | None = None
    ) -> None:
        """Prepare; the geometry is built when first needed.

        Args:
            robot: The robot.
            scene: What is around it.
            padding: Distance that must be kept from obstacles [m].
            upright: What the tool must keep to; none: nothing.
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
        """Tell whether a sweep of shape (N, dof) touches nothing."""
        return self.exact.is_proven(samples)


class PaddedSweep(Sweep):
    """The scene exactly and with the padding that searches keep."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, search_padding: float, upright: Upright | None
    ) -> None:
        """Prepare; arguments as `Sweep`, which checks without padding.

        Args:
            robot: The robot.
            scene: What is around it.
            search_padding: Distance that searches keep from obstacles where they can [m].
            upright: What the tool must keep to; none: nothing.
        """
        super().__init__(robot, scene, upright=upright)
        self.search_padding = search_padding

    def eased(self, begin: Array, goals: Array, part: float = 1.0) -> CollisionWorld:
        """Return the world to search in: with the padding, or less for pairs that are nearer at the start or a goal.

        Args:
            begin: Free arm configuration at the start, shape (dof,) [rad].
            goals: Free arm configurations, shape (N, dof) [rad].
            part: Share of the padding to keep.
        """
        return self.exact.eased(part * max(self.search_padding, LEAST_PADDING_M), np.vstack([begin, goals]))

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
