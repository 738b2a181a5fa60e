"""The services that check and retime trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from planner_graph import HOME, Graph, obstacle, to_pose, trajectory
from roboxim_interfaces.srv import CheckTrajectory, PlanToPose, RetimePath
from trajectory_msgs.msg import JointTrajectory

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_ros import qos
from roboxim_ros.messages.conversions import fill_pose
from roboxim_ros.testing import eventually

pytestmark = pytest.mark.ros


def test_check_trajectory_takes_what_was_planned_and_finds_what_is_wrong(graph: Graph) -> None:
    plan = graph.call(PlanToPose, "plan_to_pose", to_pose(y=-0.3)).plan
    request = CheckTrajectory.Request(trajectory=plan.trajectory)
    assert graph.call(CheckTrajectory, "check_trajectory", request).valid
    wall = obstacle()
    fill_pose(wall.pose, Pose(position=(0.5, -0.3, 0.2)))
    request.request.scene.objects = [wall]
    answer = graph.call(CheckTrajectory, "check_trajectory", request)
    assert not answer.valid
    assert 0 < answer.first_invalid_index < len(plan.trajectory.points)
    assert answer.contacts[0].depth > 0.0
    request.trajectory.points[3].positions = [0.0]
    assert "point 3" in str(graph.refused(CheckTrajectory, "check_trajectory", request))


def test_retime_keeps_the_limits_and_the_path(graph: Graph) -> None:
    rows = [HOME, [q + 0.4 for q in HOME], [HOME[0] + 0.8, *HOME[1:]]]
    request = RetimePath.Request(path=trajectory(*rows), stop_at_points=True)
    request.request.max_velocity_scaling_factor = 0.5
    plan = graph.call(RetimePath, "retime_path", request).plan
    assert plan.route == "retimed"
    points = np.array([p.positions for p in plan.trajectory.points])
    assert [np.abs(points - row).max(axis=1).min() < 1e-2 for row in rows] == [True] * 3
    model = ModelLibrary().robot("panda")
    speeds = np.abs([p.velocities for p in plan.trajectory.points]).max(axis=0)
    assert (speeds <= 0.5 * np.array(model.limits.velocity) * 1.001).all()
    request.stop_at_points = False
    assert graph.call(RetimePath, "retime_path", request).plan.trajectory.points[-1].time_from_start.nanosec
    request.check_collisions = True
    request.request.scene.objects = [obstacle()]
    fill_pose(request.request.scene.objects[0].pose, Pose(position=(0.45, 0.3, 0.3)))
    assert "overlap" in str(graph.refused(RetimePath, "retime_path", request))


def test_the_newest_path_is_published_for_viewers_that_come_later(graph: Graph) -> None:
    plan = graph.call(PlanToPose, "plan_to_pose", to_pose(y=-0.3)).plan
    end = plan.trajectory.points[-1]
    found: list[JointTrajectory] = []
    graph.clients.node.create_subscription(JointTrajectory, "planner/last_path", found.append, qos.LATCHED)
    graph.clients.wake()
    path = eventually(lambda: found and found[-1], "the path")
    assert list(path.joint_names) == list(plan.trajectory.joint_names)
    assert path.points[-1].positions.tolist() == pytest.approx(end.positions.tolist(), abs=1e-6)
    starts = [point.time_from_start.sec + point.time_from_start.nanosec / 1e9 for point in path.points]
    assert starts == sorted(starts)
    assert starts[1] == pytest.approx(0.05)
