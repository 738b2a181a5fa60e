"""A user's policy class, served by a node."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

from roboxim_interfaces.msg import CameraImage
from roboxim_interfaces.msg import Observation as ObservationMsg
from roboxim_interfaces.msg import Proprioception as ProprioceptionMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import Act, DescribePolicy, ResetPolicy
from sensor_msgs.msg import Image

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, PolicyError
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.proprioception import Proprioception
from roboxim_policies import BasePolicy
from roboxim_policies.node import PolicyNode
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import fill_image, from_msg, to_msg
from roboxim_ros.policy_service import PolicyClient
from roboxim_ros.testing import PATIENCE_S, graph_host

pytestmark = pytest.mark.ros
__all__ = ["graph_host"]

PROPRIO = Proprioception(
    tcp_position=(0.5, -0.1, 0.3), tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0), joint_names=("a", "b"),
    joint_positions=(0.1, 0.2), joint_velocities=(0.3, -0.4), gripper_opening=0.25,
)  # fmt: skip


class RequiresGrad:
    """A tensor of another library that cannot be converted to an array implicitly."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad")


BAD_ANSWERS = {
    "requires a gradient": RequiresGrad(),
    "huge integer": [10**400] * 7,
    "complex": np.zeros(7, complex),
    "masked": np.ma.array(np.zeros(7), mask=True),
    "strings": ["0"] * 7,
    "a boolean": [0.0] * 6 + [True],
    "NaN": [np.nan] * 7,
    "too large for float32": [1e39] * 7,
    "six numbers": np.zeros(6),
    "ragged": [[0.0] * 7, [0.0]],
    "none": None,
    "three rows": np.zeros((3, 7)),
    "phases none": ActionChunk(actions=np.zeros((1, 7)), phases=None),
    "phases that no message can hold": ActionChunk(actions=np.zeros((1, 7)), phases=("\ud800",)),
    "done a number": ActionChunk(actions=np.zeros((1, 7)), done=1),
}


class Users(BasePolicy):
    cameras = ("workspace",)
    window = 2
    horizon = 2

    def __init__(self):
        self.seen = []
        self.fail = False
        self.answer = [[0.01, 0, 0, 0, 0, 0, 1], [0.02, 0, 0, 0, 0, 0, 0]]

    def act(self, window):
        self.seen.append(window)
        if self.fail:
            raise ZeroDivisionError("the user's bug")
        return self.answer


class Traced(BasePolicy):
    def __init__(self, *, any_thread, delay_s=0.0):
        self.any_thread, self.delay_s = any_thread, delay_s
        self.threads = []

    def act(self, window):
        self.threads.append(threading.current_thread())
        time.sleep(self.delay_s)
        return [0.0] * 7


def ask(host, policy, timeout_s=PATIENCE_S):
    """Serve a policy from a node and ask it from this thread."""
    host.add(lambda context: PolicyNode(policy, context=context, namespace="mine"))
    with Clients("test_clients", context=host.context) as clients:
        PolicyClient(clients, "mine", PATIENCE_S).reset(EpisodeStart(episode_id="e", instruction="", seed=1))
        observation = Observation(seq=0, stamp_ns=0, images={}, proprio=PROPRIO)
        return PolicyClient(clients, "mine", timeout_s).act(
            ObservationWindow(instruction="", observations=[observation], pad_mask=(True,), episode_id="e", seq=0)
        )


@pytest.mark.parametrize("any_thread", [False, True])
def test_a_policy_is_asked_in_the_callers_thread_only_if_it_says_so(graph_host, any_thread):
    policy = Traced(any_thread=any_thread)
    ask(graph_host, policy)
    assert (policy.threads == [threading.current_thread()]) is any_thread


@pytest.mark.parametrize("any_thread", [False, True])
def test_a_late_answer_is_refused_in_whichever_thread_the_policy_was_asked(graph_host, any_thread):
    with pytest.raises(PolicyError, match=r"did not answer within 0\.1 s") as caught:
        ask(graph_host, Traced(any_thread=any_thread, delay_s=0.5), timeout_s=0.1)
    assert caught.value.code == ErrorCode.POLICY_LATE


@pytest.fixture
def served(graph_host: NodeHost):
    policy = Users()
    graph_host.add(lambda context: PolicyNode(policy, context=context, namespace="mine"))
    with Clients("test_clients", context=graph_host.context) as clients:
        yield policy, clients


def call(clients, kind, name, request):
    """Call without turning the code into an exception."""
    return clients.client(kind, name).call(request, timeout_sec=PATIENCE_S)


def act_request(image: np.ndarray) -> Act.Request:
    picture = CameraImage(camera="workspace", image=fill_image(Image(), image, "rgb8"))
    observation = ObservationMsg(
        seq=4, stamp_ns=400, images=[picture], proprio=to_msg(PROPRIO, ProprioceptionMsg), state=[StateRecordMsg()]
    )
    return Act.Request(
        episode_id="e", seq=4, instruction="Pick up the red cube", observations=[observation, observation],
        pad_mask=[False, True],
    )  # fmt: skip


def test_a_users_class_is_served(served):
    policy, clients = served
    said = clients.call(DescribePolicy, "mine/describe_policy", DescribePolicy.Request()).description
    description = from_msg(said, PolicyDescription)
    assert (description.name, description.window, description.horizon) == ("Users", 2, 2)
    assert description.cameras[0].name == "workspace"
    assert description.semantics == ActionSemantics()
    clients.call(ResetPolicy, "mine/reset_policy", ResetPolicy.Request(episode_id="e", seed=1))
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    answer = clients.call(Act, "mine/act", act_request(image))
    assert answer.horizon == 2
    assert np.allclose(np.reshape(answer.actions, (2, 7))[:, 0], [0.01, 0.02])
    newest = policy.seen[0].newest
    assert np.array_equal(newest.images["workspace"], image)
    assert not newest.images["workspace"].flags.writeable
    assert newest.proprio == PROPRIO
    assert policy.seen[0].pad_mask == (False, True)
    assert newest.state is None  # sent, but the policy is not privileged


def test_a_users_exception_is_an_answer_and_the_node_lives_on(served):
    policy, clients = served
    clients.call(ResetPolicy, "mine/reset_policy", ResetPolicy.Request(episode_id="e"))
    request = act_request(np.zeros((20, 30, 3), np.uint8))
    policy.fail = True
    clients.client(Act, "mine/act").wait_for_service(PATIENCE_S)
    answer = call(clients, Act, "mine/act", request)
    assert answer.error_code == ErrorCode.POLICY_FAULT
    assert "ZeroDivisionError" in answer.error_msg
    assert "the user's bug" in answer.error_msg
    policy.fail = False
    assert call(clients, Act, "mine/act", request).error_code == ErrorCode.OK


def test_whatever_a_policy_returns_is_an_invalid_action_and_the_node_lives_on(served):
    policy, clients = served
    clients.call(ResetPolicy, "mine/reset_policy", ResetPolicy.Request(episode_id="e"))
    request = act_request(np.zeros((20, 30, 3), np.uint8))
    clients.client(Act, "mine/act").wait_for_service(10.0)
    good = policy.answer
    for name, policy.answer in BAD_ANSWERS.items():
        answer = call(clients, Act, "mine/act", request)
        assert answer.error_code == ErrorCode.INVALID_ACTION, (name, answer.error_msg)
        assert "policy 'Users' in act at tick 4" in answer.error_msg
        assert (answer.horizon, len(answer.actions)) == (0, 0)
    policy.answer = good
    assert call(clients, Act, "mine/act", request).horizon == 2


def test_a_damaged_image_is_refused(served):
    _, clients = served
    clients.call(ResetPolicy, "mine/reset_policy", ResetPolicy.Request(episode_id="e"))
    request = act_request(np.zeros((20, 30, 3), np.uint8))
    request.observations[1].images[0].image.height = 21
    clients.client(Act, "mine/act").wait_for_service(PATIENCE_S)
    assert call(clients, Act, "mine/act", request).error_code == ErrorCode.INVALID_REQUEST
