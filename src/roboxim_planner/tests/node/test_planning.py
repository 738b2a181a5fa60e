"""The planning services: goals, frames, planners, repeatability."""

from __future__ import annotations

import numpy as np
import pytest
from planner_graph import FOLDED, HOME, NAMES, Graph, divided, obstacle, target, to_pose
from roboxim_interfaces.srv import ComputeIK, PlanCartesian, PlanToJoints, PlanToPose
from sensor_msgs.msg import JointState

from roboxim_core import limits
from roboxim_core.errors import ErrorCode
from roboxim_core.poses import Pose
from roboxim_ros.messages.conversions import fill_pose

pytestmark = pytest.mark.ros


def test_plan_to_pose_answers_with_a_trajectory(graph: Graph) -> None:
    request = to_pose(y=-0.3)
    request.request.scene.objects = [obstacle()]
    request.request.with_tcp_poses = True
    response = graph.call(PlanToPose, "plan_to_pose", request)
    trajectory = response.plan.trajectory
    assert (list(trajectory.joint_names), trajectory.header.frame_id) == (NAMES, "panda_base")
    assert list(trajectory.points[0].positions) == HOME
    assert (response.goal_index, response.plan.fraction) == (0, 1.0)
    last = response.plan.tcp_poses[-1].position
    assert (last.x, last.y, last.z) == pytest.approx((0.5, -0.3, 0.25), abs=1e-4)
    assert len(response.plan.tcp_poses) == len(trajectory.points)
    times = [p.time_from_start.sec * 1_000_000_000 + p.time_from_start.nanosec for p in trajectory.points]
    assert 10_000_000 in times
    assert max(np.diff(times)) == 10_000_000


def test_frames_base_and_tcp(graph: Graph) -> None:
    base = to_pose(frame="panda_base")
    fill_pose(base.request.scene.robot_pose_in_world, Pose(position=(1.0, 0.0, 0.0)))
    base.request.with_tcp_poses = True
    assert graph.call(PlanToPose, "plan_to_pose", base).plan.tcp_poses[-1].position.x == pytest.approx(1.5, abs=1e-4)
    up = PlanCartesian.Request(waypoints=[target(frame="tcp")])
    fill_pose(up.waypoints[0].pose, Pose(position=(0.0, 0.0, -0.05)))
    up.request.start_state = JointState(position=HOME)
    up.request.with_tcp_poses = True
    poses = graph.call(PlanCartesian, "plan_cartesian", up).plan.tcp_poses
    assert poses[-1].position.z - poses[0].position.z == pytest.approx(0.05, abs=1e-4)
    wrong = graph.refused(PlanToPose, "plan_to_pose", to_pose(frame="wrold"))
    assert wrong.code == ErrorCode.UNKNOWN_FRAME
    assert "did you mean 'world'" in str(wrong)


def test_joints_by_name_in_any_order(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(name=NAMES[::-1], position=[q + 0.1 for q in HOME][::-1]))
    request.request.start_state = JointState(name=[*NAMES, "panda_finger_joint1"], position=[*HOME, 0.04])
    response = graph.call(PlanToJoints, "plan_to_joints", request)
    assert list(response.plan.trajectory.points[-1].positions) == pytest.approx([q + 0.1 for q in HOME])
    request.target, request.named_state = JointState(), "ready"
    assert graph.call(PlanToJoints, "plan_to_joints", request).plan.route == "direct"
    request.named_state = "redy"
    assert "did you mean 'ready'" in str(graph.refused(PlanToJoints, "plan_to_joints", request))


def test_an_anytime_planner_takes_the_iterations_it_is_given(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(position=[-1.2, *FOLDED]))
    request.request.start_state = JointState(position=[1.2, *FOLDED])
    request.request.scene.objects = divided()[:1]
    request.request.planner_id, request.request.improve_iterations = "BITstar", 20
    assert graph.call(PlanToJoints, "plan_to_joints", request).plan.trajectory.points
    request.request.improve_iterations, request.request.timeout = limits.IMPROVE_ITERATIONS, 0.3
    assert graph.refused(PlanToJoints, "plan_to_joints", request).code == ErrorCode.TIMEOUT


def test_tool_stays_upright_and_a_tilted_goal_is_refused(graph: Graph) -> None:
    request = to_pose(x=0.5, y=-0.35, z=0.4)
    request.request.path_constraints.tilt_tolerance = 0.1
    request.request.with_tcp_poses = True
    request.request.scene.objects = [obstacle()]
    start = graph.call(ComputeIK, "compute_ik", ComputeIK.Request(target=target(0.5, 0.35, 0.4))).solutions[0]
    request.request.start_state = start
    for pose in graph.call(PlanToPose, "plan_to_pose", request).plan.tcp_poses:
        q = pose.orientation
        down = 1.0 - 2.0 * (q.x**2 + q.y**2)  # z of the TCP along z of the world
        assert down < -np.cos(0.101)
    fill_pose(request.target.pose, Pose(position=(0.5, -0.3, 0.4), quat_xyzw=(0.7071068, 0.0, 0.7071068, 0.0)))
    error = graph.refused(PlanToPose, "plan_to_pose", request)
    assert error.code == ErrorCode.CONSTRAINT_VIOLATED
    assert "tilted" in str(error)
    request.request.planner_id = "RRTConect"
    assert "did you mean 'RRTConnect'" in str(graph.refused(PlanToPose, "plan_to_pose", request))


def test_arrays_keep_their_bits(graph: Graph) -> None:
    """Same request, same bytes, through the node."""
    request = to_pose(y=-0.3)
    request.request.scene.objects = [obstacle()]
    rows = [
        np.array([p.positions for p in graph.call(PlanToPose, "plan_to_pose", request).plan.trajectory.points])
        for _ in range(2)
    ]
    assert rows[0].tobytes() == rows[1].tobytes()
