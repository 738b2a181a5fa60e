"""Clients of the planner's and the simulator's services."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import CheckTrajectory, PlanToPose, RenderState

from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.surroundings import Surroundings
from roboxim_ros.clients import Clients
from roboxim_ros.messages.conversions import image_from_msg, to_msg
from roboxim_tasks.conversions import motion_request, pose_stamped, trajectory
from roboxim_tasks.sampling.visible import Segmentation

SAMPLE_PERIOD_S = 0.02
_PERIOD_NS = round(SAMPLE_PERIOD_S * 1e9)


class PlannerClient:
    """Client of ``planner/*``; see `roboxim_tasks.demonstration.planning.PlannerPort`."""

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
        return _evenly_timed(answer.plan.trajectory.points)

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return what is wrong with a joint path, or an empty text.

        Raises:
            PlannerError: When the planner cannot check the path, e.g. ``STALE_SCENE``.
            UnavailableError: When the planner is not there.
            RequestTimeoutError: When it answers late.
        """
        call = self._clients.send_local("planner/check_path", path, period_s, around)
        if call is not None:
            return str(self._clients.value_of(call, "planner/check_path", self._timeout_s))
        request = CheckTrajectory.Request(trajectory=trajectory(path, period_s))
        request.request = motion_request(around.scene.robot.model, path[0], around, 0)
        answer = self._clients.call(CheckTrajectory, "planner/check_trajectory", request, timeout_s=self._timeout_s)
        if answer.valid:
            return ""
        touching = [f"{pair.body_a} touches {pair.body_b}" for pair in answer.contacts]
        return "; ".join([*touching, *answer.violations]) or "the planner refuses the path"


class SegmentationClient:
    """Client of ``sim/render_state``; see `roboxim_tasks.sampling.visible.SegmentationPort`."""

    def __init__(self, clients: Clients, renderer: str, timeout_s: float) -> None:
        """Use a set of clients.

        Args:
            clients: The node's clients.
            renderer: Name of the renderer.
            timeout_s: Longest wait for an answer [s].
        """
        self._clients = clients
        self._renderer = renderer
        self._timeout_s = timeout_s

    def segment(self, scene: SceneSpec, state: StateRecord) -> dict[str, Segmentation]:
        """Return the segmentation images of a scene by camera.

        Raises:
            SimError: When the simulator cannot draw the scene, e.g. ``RENDERER_UNAVAILABLE``.
            UnavailableError: When the simulator is not there.
            RequestTimeoutError: When it answers late.
        """
        call = self._clients.send_local("sim/segment", scene, state, self._renderer)
        if call is not None:
            seen: dict[str, Segmentation] = self._clients.value_of(call, "sim/segment", self._timeout_s)
            return seen
        request = RenderState.Request(
            scene=to_msg(scene, SceneSpecMsg), state=to_msg(state, StateRecordMsg), renderer=self._renderer
        )
        answer = self._clients.call(RenderState, "sim/render_state", request, timeout_s=self._timeout_s)
        return {one.camera: image_from_msg(one.image) for one in answer.segmentation}


def _evenly_timed(points: Sequence[Any]) -> Array:
    """Return the positions at multiples of the period and at the end, shape (N, dof) [rad].

    Drop the planner's other points, which only a controller needs.
    """
    even = [p for p in points[:-1] if p.time_from_start.nanosec % _PERIOD_NS == 0]
    return np.array([list(point.positions) for point in [*even, points[-1]]])
