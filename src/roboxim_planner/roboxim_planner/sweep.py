"""Whether a sweep, a finely sampled path, touches anything, also between its samples."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from roboxim_planner.collision import CollisionWorld
from roboxim_planner.constraint import Upright
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]


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
