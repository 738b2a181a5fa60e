"""Values survive the policy boundary unchanged; the client also refuses invalid answers."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from roboxim_interfaces.srv import Act

from roboxim_core.errors import ErrorCode, PolicyError
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.poses import IDENTITY
from roboxim_core.proprioception import Proprioception
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec
from roboxim_core.state import RobotState, StateRecord
from roboxim_ros.policy_service import (
    decode_answer,
    decode_start,
    decode_window,
    encode_start,
    encode_window,
    fill_answer,
)

pytestmark = pytest.mark.ros

STATE = StateRecord(
    episode_id="e", seq=3, stamp_ns=300,
    robot=RobotState(
        joint_names=("a",), joint_positions=(0.1,), joint_velocities=(0.2,), joint_commands=(0.3,),
        pose_tcp_measured=IDENTITY, pose_tcp_commanded=IDENTITY, gripper_opening=0.5, gripper_command=1.0,
    ),
)  # fmt: skip
DESCRIPTION = PolicyDescription(name="p", horizon=3)


def window():
    image = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    first = Observation(seq=2, stamp_ns=200, images={"wrist": image}, proprio=Proprioception.of(STATE), state=STATE)
    newest = Observation(seq=3, stamp_ns=300, images={"wrist": 255 - image}, proprio=Proprioception.of(STATE))
    return ObservationWindow(
        instruction="Pick up the red cube", observations=[first, first, newest], pad_mask=(False, True, True),
        episode_id="e", seq=3,
    )  # fmt: skip


def test_a_window_comes_out_as_it_went_in():
    sent = window()
    request = encode_window(sent)
    assert request.observations[0] is request.observations[1], "a repeated frame is converted once"
    got = decode_window(request, privileged=True)
    assert (got.instruction, got.pad_mask, got.episode_id, got.seq) == (
        sent.instruction, sent.pad_mask, sent.episode_id, sent.seq,
    )  # fmt: skip
    for a, b in zip(got.observations, sent.observations, strict=True):
        assert (a.seq, a.stamp_ns, a.proprio, a.state) == (b.seq, b.stamp_ns, b.proprio, b.state)
        assert np.array_equal(a.images["wrist"], b.images["wrist"])
        assert not a.images["wrist"].flags.writeable
    assert decode_window(request, privileged=False).observations[0].state is None


@pytest.mark.parametrize("opening", [None, 0.0, 0.3])
def test_the_command_that_was_executed_comes_out_as_it_went_in(opening):
    request = encode_window(replace(window(), commanded_opening=opening))
    assert decode_window(request, privileged=False).commanded_opening == opening


def test_a_start_comes_out_as_it_went_in():
    task = TaskSpec(
        skill="pick_up", objects={"target": PhysicalObject(entity="target", model="cube", name="cube")},
        instruction="Pick up the red cube",
    )  # fmt: skip
    start = EpisodeStart(episode_id="e", instruction="x", seed=2**63, task=task, scene=SceneSpec())
    request = encode_start(start)
    assert decode_start(request, privileged=True) == start
    hidden = decode_start(request, privileged=False)
    assert (hidden.task, hidden.scene, hidden.seed) == (None, None, 2**63)


def answer(chunk: ActionChunk) -> Act.Response:
    response = Act.Response()
    fill_answer(response, chunk)
    return response


def test_an_answer_comes_out_as_it_went_in():
    actions = np.random.default_rng(0).normal(size=(3, 7)).astype(np.float32)
    got = decode_answer(answer(ActionChunk(actions=actions, done=True, phases=("free", "", "grasp"))), DESCRIPTION)
    assert np.array_equal(got.actions, actions)
    assert (got.done, got.phases) == (True, ("free", "", "grasp"))


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"horizon": 0}, "horizon 0 with 14 numbers"),
        ({"horizon": 3}, "horizon 3 with 14 numbers"),
        ({"horizon": 1}, r"got \(1, 14\)"),
        ({"horizon": 2, "actions": []}, "shape"),
        ({"horizon": 2**32 - 1}, "14 numbers"),
        ({"horizon": 4, "actions": [0.0] * 28}, "horizon of at most 3"),
        ({"actions": [0.0] * 13 + [float("nan")]}, "finite, got nan at step 1, component 6"),
        ({"phases": ["free"]}, "phases"),
        ({"phases": ["free", "x" * 1000]}, "phase"),
    ],
)
def test_a_peer_that_does_not_check_itself_is_checked_here(fields, word):
    response = answer(ActionChunk(actions=np.zeros((2, 7), np.float32)))
    for name, value in fields.items():
        setattr(response, name, value)
    with pytest.raises(PolicyError, match=word) as caught:
        decode_answer(response, DESCRIPTION)
    assert caught.value.code == ErrorCode.INVALID_ACTION
