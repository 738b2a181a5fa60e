from __future__ import annotations

import threading

import pytest
from control_msgs.action import GripperCommand
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError
from roboxim_ros.actions import ActionCall
from roboxim_ros.clients import Clients
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


class Gripper(Node):
    """A gripper that waits for cancellation on a position below 0 and rejects one above 1."""

    executor_threads = 3

    def __init__(self, context) -> None:
        super().__init__("gripper", context=context)
        self.cancelled = threading.Event()
        self.server = ActionServer(
            self, GripperCommand, "grip", self._execute, result_timeout=10,
            goal_callback=lambda goal: GoalResponse.REJECT if goal.command.position > 1 else GoalResponse.ACCEPT,
            cancel_callback=self._cancel, callback_group=ReentrantCallbackGroup(),
        )  # fmt: skip

    def _cancel(self, _):
        self.cancelled.set()
        return CancelResponse.ACCEPT

    def _execute(self, goal):
        position = goal.request.command.position
        if position < 0:
            self.cancelled.wait(PATIENCE_S)
            goal.canceled()
        else:
            goal.publish_feedback(GripperCommand.Feedback(position=position))
            goal.succeed()
        return GripperCommand.Result(position=position)


@pytest.fixture
def gripper(graph_host):
    return graph_host.add(Gripper)


@pytest.fixture
def grip(graph_host, gripper):
    with (
        Clients("clients", context=graph_host.context) as clients,
        ActionCall(clients, GripperCommand, "grip") as action,
    ):
        yield action


def _goal(position):
    goal = GripperCommand.Goal()
    goal.command.position = position
    return goal


def test_result_comes_back(grip):
    answer = grip.run(_goal(0.5), timeout_s=PATIENCE_S)
    assert (answer.status, answer.result.position) == ("succeeded", 0.5)


def test_giving_up_cancels_the_goal(grip, gripper):
    def check():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grip.run(_goal(-1.0), timeout_s=PATIENCE_S, check=check)
    assert gripper.cancelled.wait(PATIENCE_S)


def test_late_result_is_an_error_and_cancels_the_goal(grip, gripper):
    with pytest.raises(RequestTimeoutError, match="grip"):
        grip.run(_goal(-1.0), timeout_s=0.3)
    assert gripper.cancelled.wait(PATIENCE_S)


def test_rejected_goal_and_absent_server_are_distinguished(grip, graph_host):
    with pytest.raises(InvalidRequestError, match="rejected"):
        grip.run(_goal(2.0), timeout_s=PATIENCE_S)
    with (
        Clients("other", context=graph_host.context) as clients,
        ActionCall(clients, GripperCommand, "no") as absent,
        pytest.raises(UnavailableError, match="'no' is not available"),
    ):
        absent.run(_goal(0.5), wait_s=0.1)


@pytest.mark.thorough
def test_no_answer_is_lost_however_quick(grip):
    for number in range(200):
        goal = GripperCommand.Goal()
        goal.command.position = number / 200
        assert grip.run(goal, timeout_s=PATIENCE_S).result.position == number / 200
