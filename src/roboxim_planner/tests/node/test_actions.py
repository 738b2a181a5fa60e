"""Sequences of motions, and planning as cancellable actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from planner_graph import FOLDED, HOME, Graph, divided, result_of, sequence, target, wait_for
from rclpy.action import ActionClient
from roboxim_interfaces.action import PlanMotion
from roboxim_interfaces.action import PlanSequence as PlanSequenceAction
from roboxim_interfaces.msg import MotionStage
from roboxim_interfaces.srv import PlanSequence
from sensor_msgs.msg import JointState

from roboxim_core.errors import ErrorCode
from roboxim_ros.testing import PATIENCE_S, eventually

pytestmark = pytest.mark.ros


def test_action_plans_and_can_be_cancelled(graph: Graph) -> None:
    client = ActionClient(graph.clients.node, PlanMotion, "planner/plan_motion")
    try:
        assert client.wait_for_server(PATIENCE_S)
        goal = PlanMotion.Goal(kind=PlanMotion.Goal.POSE, waypoints=[target()])
        goal.request.start_state = JointState(position=HOME)
        assert result_of(graph.clients, client, goal).plan.route == "direct"
        goal.waypoints.append(target(frame=""))
        assert result_of(graph.clients, client, goal).error_code == ErrorCode.OK, "an empty frame is the world too"
        goal.kind = 9
        assert result_of(graph.clients, client, goal).error_code == ErrorCode.INVALID_REQUEST
        assert result_of(graph.clients, client, endless(), cancel=True).error_code == ErrorCode.CANCELLED
    finally:
        client.destroy()


def endless() -> PlanMotion.Goal:
    """Return a goal whose planning ends only when it is cancelled."""
    goal = PlanMotion.Goal(kind=PlanMotion.Goal.JOINTS, joint_target=JointState(position=[-1.2, *FOLDED]))
    goal.request.start_state = JointState(position=[1.2, *FOLDED])
    goal.request.scene.objects = divided()
    goal.request.timeout = PATIENCE_S
    return goal


def test_goals_that_wait_leave_the_planner_able_to_cancel(graph: Graph) -> None:
    client = ActionClient(graph.clients.node, PlanMotion, "planner/plan_motion")
    running: list[int] = []

    def send(number: int) -> Any:
        return client.send_goal_async(endless(), feedback_callback=lambda _: running.append(number))

    try:
        assert client.wait_for_server(PATIENCE_S)
        goals = [wait_for(graph.clients.in_thread(lambda number=number: send(number))) for number in range(4)]
        eventually(lambda: running)
        for goal in reversed(goals):
            wait_for(graph.clients.in_thread(goal.cancel_goal_async))
        codes = [wait_for(graph.clients.in_thread(goal.get_result_async)).result.error_code for goal in goals]
        assert codes == [ErrorCode.CANCELLED] * 4
        assert set(running) == {0}, "the others were cancelled before their turn"
    finally:
        client.destroy()


def test_sequence_grasps_and_lifts(graph: Graph) -> None:
    answer = graph.call(PlanSequence, "plan_sequence", sequence())
    assert list(answer.goal_indices) == [0, -1, -1]
    heights = [plan.tcp_poses[-1].position.z for plan in answer.plans]
    assert heights == pytest.approx([0.12, 0.02, 0.14], abs=1e-4)
    for before, after in zip(answer.plans, answer.plans[1:], strict=False):
        end = np.array(before.trajectory.points[-1].positions)
        assert np.abs(end - np.array(after.trajectory.points[0].positions)).max() < 1e-6
    moved = sequence()
    moved.stages[1].relative = True
    moved.stages[1].goals[0].pose.orientation.x = moved.stages[1].goals[0].pose.orientation.w = 0.0
    lines = graph.call(PlanSequence, "plan_sequence", moved).plans
    assert lines[1].tcp_poses[-1].position.z == pytest.approx(heights[1], abs=1e-4), "a displacement without rotation"
    far = sequence()
    far.stages[0].goals[0].pose.position.x = 1.6
    error = graph.refused(PlanSequence, "plan_sequence", far)
    assert error.code == ErrorCode.GOAL_UNREACHABLE
    assert "stage 'approach' (1 of 3)" in str(error)


def test_sequence_as_an_action_can_be_cancelled(graph: Graph) -> None:
    client = ActionClient(graph.clients.node, PlanSequenceAction, "planner/plan_sequence")
    try:
        assert client.wait_for_server(PATIENCE_S)
        asked = sequence()
        goal = PlanSequenceAction.Goal(request=asked.request, stages=asked.stages)
        assert len(result_of(graph.clients, client, goal).plans) == 3
        divide = PlanSequenceAction.Goal()
        divide.request.start_state = JointState(position=[1.2, *FOLDED])
        divide.request.scene.objects = divided()
        divide.request.timeout = PATIENCE_S
        divide.stages = [MotionStage(kind=MotionStage.JOINTS, joint_target=JointState(position=[-1.2, *FOLDED]))]
        assert result_of(graph.clients, client, divide, cancel=True).error_code == ErrorCode.CANCELLED
    finally:
        client.destroy()
