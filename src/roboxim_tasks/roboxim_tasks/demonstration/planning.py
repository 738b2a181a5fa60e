"""The expert's port to the planner, served by ROS clients or, without a node graph, by the planner's core."""

from __future__ import annotations

from typing import Protocol

from roboxim_core.poses import Array, Pose
from roboxim_core.surroundings import Surroundings


class PlannerPort(Protocol):
    """Interface of the planner to the expert."""

    def plan_to_pose(self, joints: Array, pose_tcp_in_world: Pose, around: Surroundings, seed: int) -> Array:
        """Return a collision-free joint path from joints to a pose, shape (n, joints) [rad].

        Raises:
            PlannerError: When there is no such path.
        """
        ...

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return the violations of a joint path of shape (n, joints) [rad], or an empty text.

        Args:
            path: Joint positions, joined by straight lines in joint space.
            period_s: Time between two positions [s]; the joints' speed limits apply.
            around: Obstacles to avoid.
        """
        ...
