"""No callback ends its node: every exception becomes an answer or a line in the log."""

from __future__ import annotations

import struct
import threading

import pybullet
import pytest
from control_msgs.action import FollowJointTrajectory, GripperCommand
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from roboxim_interfaces.msg import MotionStage
from roboxim_interfaces.srv import PlanSequence, Tick
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Result
from simulation_interfaces.srv import DeleteEntity
from std_msgs.msg import String
from std_srvs.srv import Empty, Trigger

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_ros import qos
from roboxim_ros.actions import ActionCall
from roboxim_ros.bounds import check_message
from roboxim_ros.clients import Clients, wait_until
from roboxim_ros.direct_calls import DirectClient
from roboxim_ros.node import RoboximNode
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros

RAISED = [
    ValueError("no"), MemoryError(), RecursionError("deep"), OverflowError("large"), struct.error("bytes"),
    pybullet.error("bullet"), SystemExit(3), KeyError("\ud800"), AssertionError("x" * 5_000),
]  # fmt: skip


class Faulty(RoboximNode):
    """A node whose handlers all raise ``error``."""

    def __init__(self, context):
        super().__init__("faulty", context=context)
        self.error = ValueError("no")
        self.heard, self.ticked = threading.Event(), threading.Event()
        for kind, name in ((Tick, "ours"), (Trigger, "trigger"), (DeleteEntity, "delete"), (Empty, "empty")):
            self.serve(kind, name, self._raise)
        self.serve(Trigger, "coroutine", self._raise_later, callback_group=ReentrantCallbackGroup())
        self.serve(Trigger, "surrogate", self._surrogate)
        self.serve_action(SimulateSteps, "steps", self._raise)
        self.serve_action(FollowJointTrajectory, "follow", self._raise_later)
        self.serve_action(GripperCommand, "grip", self._raise)
        self.subscribe(String, "words", self._on_words, qos.STATE)
        self.create_timer(0.01, self._on_timer)
        self.declare_parameter("number", 1)
        self.add_on_set_parameters_callback(self._raise)

    def _raise(self, *_):
        raise self.error

    async def _raise_later(self, *_):
        raise self.error

    def _surrogate(self, _, response):
        response.message = "\ud800"

    def _on_words(self, _):
        self.heard.set()
        raise self.error

    def _on_timer(self):
        if not self.ticked.is_set():
            self.ticked.set()
            raise self.error


@pytest.fixture
def faulty(graph_host):
    node = graph_host.add(Faulty)
    with Clients("test", context=graph_host.context) as clients:
        yield node, clients
        assert graph_host.alive()


def test_every_exception_of_a_service_is_an_answer(faulty):
    node, clients = faulty
    for error in RAISED:
        node.error = error
        ours = clients.call(Tick, "ours", Tick.Request(), check=False)
        assert ours.error_code == ErrorCode.INTERNAL
        assert type(error).__name__ in ours.error_msg
        assert len(ours.error_msg) <= limits.ERROR_CHARACTERS
        for name in ("trigger", "coroutine"):
            answer = clients.call(Trigger, name, Trigger.Request())
            assert not answer.success
            assert "INTERNAL" in answer.message
        assert clients.call(DeleteEntity, "delete", DeleteEntity.Request()).result.result == (
            Result.RESULT_OPERATION_FAILED
        )
        clients.call(Empty, "empty", Empty.Request())
    node.error = SimError("gone", ErrorCode.UNKNOWN_ENTITY)
    assert clients.call(Tick, "ours", Tick.Request(), check=False).error_code == ErrorCode.UNKNOWN_ENTITY
    answer = clients.call(DeleteEntity, "delete", DeleteEntity.Request()).result
    assert (answer.result, answer.error_message) == (Result.RESULT_NOT_FOUND, "UNKNOWN_ENTITY: gone")


def test_an_answer_that_cannot_be_sent_is_an_error(faulty):
    client = DirectClient(faulty[1].node, Trigger, "surrogate")  # as from another process
    assert wait_until(client.client.service_is_ready, PATIENCE_S)
    answer = client.receive(client.send(Trigger.Request()), PATIENCE_S)
    assert not answer.success
    assert "INTERNAL" in answer.message


def test_every_exception_of_an_action_is_a_result(faulty):
    node, clients = faulty
    for error in RAISED:
        node.error = error
        for kind, name in ((SimulateSteps, "steps"), (FollowJointTrajectory, "follow"), (GripperCommand, "grip")):
            with ActionCall(clients, kind, name) as call:
                ended = call.run(kind.Goal(), timeout_s=20)
            assert ended.status == "aborted"
            if name == "steps":
                assert ended.result.result.result == Result.RESULT_OPERATION_FAILED
            elif name == "follow":
                assert ended.result.error_code == FollowJointTrajectory.Result.INVALID_GOAL
                assert type(error).__name__ in ended.result.error_string


def test_subscriptions_timers_and_parameters_raise_nothing(faulty):
    node, clients = faulty
    talker = clients.node.create_publisher(String, "words", qos.STATE)
    talker.publish(String(data="hello"))
    assert node.heard.wait(10)
    assert node.ticked.wait(10)
    number = Parameter("number", value=2).to_parameter_msg()
    several = clients.call(SetParameters, "faulty/set_parameters", SetParameters.Request(parameters=[number]))
    assert [(result.successful, "INTERNAL" in result.reason) for result in several.results] == [(False, True)]
    at_once = SetParametersAtomically.Request(parameters=[number])
    answer = clients.call(SetParametersAtomically, "faulty/set_parameters_atomically", at_once).result
    assert not answer.successful
    assert "INTERNAL" in answer.reason
    assert node.get_parameter("number").value == 1


def test_messages_beyond_their_bounds_are_refused():
    check_message(Tick.Request(episode_id="e" * limits.SHORT_TEXT_CHARACTERS, action=[0.0] * 7))
    with pytest.raises(InvalidRequestError, match=r"episode_id may have 10000 characters, got 10001"):
        check_message(Tick.Request(episode_id="e" * (limits.SHORT_TEXT_CHARACTERS + 1)))
    goal = FollowJointTrajectory.Goal()
    goal.trajectory.joint_names = ["j" * 20_000]
    with pytest.raises(InvalidRequestError, match=r"trajectory\.joint_names may have"):
        check_message(goal)
    goal.trajectory.joint_names = [""] * (limits.ITEMS + 1)
    with pytest.raises(InvalidRequestError, match=r"trajectory\.joint_names may have 10000 elements"):
        check_message(goal)


def test_what_sequences_inside_of_sequences_hold_is_counted_together():
    stage = MotionStage(goals=[PoseStamped()] * 1_000, attach=["x"] * 9_000)
    check_message(PlanSequence.Request(stages=[stage] * 40))
    with pytest.raises(InvalidRequestError, match=r"500000 elements together; stages\.attach exceeds"):
        check_message(PlanSequence.Request(stages=[stage] * 100))
    with pytest.raises(InvalidRequestError, match="stages may have 100 elements, got 101"):
        check_message(PlanSequence.Request(stages=[MotionStage()] * 101))
    text = MotionStage(attach=["x" * 10_000] * 100)
    with pytest.raises(InvalidRequestError, match="characters together"):
        check_message(PlanSequence.Request(stages=[text] * 40))
