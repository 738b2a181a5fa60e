"""Whether a sweep, a finely sampled path, touches anything, also between the samples that are looked at.

A state with a free margin m around the robot vouches for every state that differs by less than m of motion. So sparse
states are checked with a margin of half their spacing, and only where one of them is within the margin of something are
all samples checked exactly. Far from obstacles that costs little, and near them nothing slips through.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from roboxim_planner.collision import CollisionWorld
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]
MARGIN_M = 0.005
FINE_STEP_M = 0.002


class Sweep:
    """Checks sweeps of one robot in one scene."""

    def __init__(self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0) -> None:
        """Prepare; the geometry is built when first needed.

        Args:
            robot: The robot.
            scene: What is around it.
            padding: Distance that must be kept from everything [m].
        """
        self.robot = robot
        self.scene = scene
        self.padding = padding

    @cached_property
    def exact(self) -> CollisionWorld:
        """The robot in the scene."""
        return CollisionWorld(self.robot, self.scene, padding=self.padding)

    @cached_property
    def guard(self) -> CollisionWorld:
        """The same with a margin."""
        return CollisionWorld(self.robot, self.scene, padding=self.padding + MARGIN_M)

    def first_hit(self, samples: Array) -> int:
        """Return the index of the first colliding sample of a sweep of shape (N, dof), or -1."""
        moved = np.abs(np.diff(samples, axis=0)) @ self.exact.reach
        travel = np.concatenate([[0.0], np.cumsum(moved)])
        marks = np.searchsorted(travel, np.arange(0.0, travel[-1], 1.8 * MARGIN_M))
        marks = np.unique(np.append(marks, len(samples) - 1))
        done = 0
        for k, mark in enumerate(marks):
            if self.guard.is_free(samples[mark]):
                continue
            begin = max(done, int(marks[k - 1]) + 1 if k else 0)
            end = int(marks[k + 1]) if k + 1 < len(marks) else len(samples)
            hit = self.exact.first_collision(samples[begin:end])
            if hit >= 0:
                return begin + hit
            done = end
        return -1
