"""The expert's planner port, served by the planner node."""

from __future__ import annotations

import numpy as np
from roboxim_interfaces.srv import CheckTrajectory, PlanToPose

from roboxim_core.poses import Array, Pose
from roboxim_ros.clients import Clients
from roboxim_tasks.conversions import motion_request, pose_stamped, trajectory
from roboxim_tasks.planning import Surroundings

SAMPLE_PERIOD_S = 0.02


class PlannerClient:
    """Asks ``planner/*``; see `roboxim_tasks.planning.PlannerPort`."""

    def __init__(self, clients: Clients, timeout_s: float) -> None:
        """Use a set of clients.

        Args:
            clients: The node's clients.
            timeout_s: Longest wait for an answer [s].
        """
        self._clients = clients
        self._timeout_s = timeout_s

    def plan_to_pose(self, joints: Array, pose_tcp_in_world: Pose, around: Surroundings, seed: int) -> Array:
        """Return a collision-free joint path to a pose.

        Raises:
            PlannerError: When there is none.
            UnavailableError: When the planner is not there.
            RequestTimeoutError: When it answers late.
        """
        request = PlanToPose.Request(target=pose_stamped(pose_tcp_in_world))
        request.request = motion_request(around.scene.robot.model, joints, around, seed)
        request.request.sample_period = SAMPLE_PERIOD_S
        answer = self._clients.call(PlanToPose, "planner/plan_to_pose", request, timeout_s=self._timeout_s)
        return np.array([list(point.positions) for point in answer.plan.trajectory.points])

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return what is wrong with a joint path, or an empty text.

        Raises:
            PlannerError: When the planner cannot say, e.g. ``STALE_SCENE``.
            UnavailableError: When the planner is not there.
            RequestTimeoutError: When it answers late.
        """
        request = CheckTrajectory.Request(trajectory=trajectory(path, period_s))
        request.request = motion_request(around.scene.robot.model, path[0], around, 0)
        answer = self._clients.call(CheckTrajectory, "planner/check_trajectory", request, timeout_s=self._timeout_s)
        if answer.valid:
            return ""
        touching = [f"{pair.body_a} touches {pair.body_b}" for pair in answer.contacts]
        return "; ".join([*touching, *answer.violations]) or "the planner refuses the path"
