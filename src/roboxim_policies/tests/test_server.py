"""Faults of a policy become specific errors, and a policy never receives data that it must not see."""

import pickle
import sys
from dataclasses import fields

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, PolicyError, UnavailableError
from roboxim_core.policies import CameraRequirement, EpisodeStart, Observation, ObservationWindow
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.poses import IDENTITY
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec
from roboxim_core.state import RobotState, StateRecord
from roboxim_policies import BasePolicy

TASK = TaskSpec(
    skill="pick_up",
    objects={"target": PhysicalObject(entity="target", model="cube", name="cube")},
    instruction="Pick up the red cube",
)
STATE = StateRecord(
    episode_id="e",
    seq=0,
    stamp_ns=0,
    robot=RobotState(
        joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=IDENTITY,
        pose_tcp_commanded=IDENTITY, gripper_opening=1.0, gripper_command=1.0,
    ),
)  # fmt: skip


def start(**kwargs) -> EpisodeStart:
    return EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=3, **kwargs)


def window(images=None, **kwargs) -> ObservationWindow:
    observation = Observation(seq=0, stamp_ns=0, images=images or {}, **kwargs)
    return ObservationWindow(
        instruction="Pick up the red cube", observations=[observation], pad_mask=(True,), episode_id="e", seq=0
    )


class Answers(BasePolicy):
    """A policy that returns or raises a given value and stores its inputs."""

    def __init__(self, answer=None, *, privileged: bool = False):
        self.answer, self.privileged, self.seen = answer, privileged, []

    def reset(self, start):
        self.seen.append(start)

    def act(self, window):
        self.seen.append(window)
        if isinstance(self.answer, BaseException):
            raise self.answer
        return np.zeros(7) if self.answer is None else self.answer


def guarded(policy, log=lambda text: None) -> GuardedPolicy:
    guard = GuardedPolicy(policy, log=log)
    guard.reset(start(task=TASK, scene=SceneSpec()))
    return guard


@pytest.mark.parametrize(
    ("answer", "word"),
    [
        (np.zeros(6), "shape"),
        (np.zeros((2, 7)), "horizon of at most 1"),
        (np.zeros((0, 7)), "shape"),
        ([0, 0, float("nan"), 0, 0, 0, 1], "step 0, component 2"),
        ([np.inf] * 7, "finite"),
        ("nonsense", "not numbers"),
        ([[1, 2], [3]], "not numbers"),
        ({"actions": 1}, "not numbers"),
    ],
)
def test_wrong_answers_are_invalid_actions_by_name(answer, word):
    with pytest.raises(PolicyError, match=word) as caught:
        guarded(Answers(answer)).act(window())
    assert caught.value.code == ErrorCode.INVALID_ACTION
    assert "Answers" in str(caught.value)


@pytest.mark.parametrize("error", [ValueError("boom"), SystemExit(3), InvalidRequestError("mine"), MemoryError()])
def test_what_a_policy_raises_is_its_fault_and_logged_with_its_traceback(error):
    logged = []
    with pytest.raises(PolicyError) as caught:
        guarded(Answers(error), logged.append).act(window())
    assert caught.value.code == ErrorCode.POLICY_FAULT
    assert type(error).__name__ in str(caught.value)
    assert "in act" in logged[0]
    assert "raise self.answer" in logged[0]


def test_after_a_fault_the_policy_goes_on():
    policy = Answers(ValueError("boom"))
    guard = guarded(policy)
    with pytest.raises(PolicyError):
        guard.act(window())
    policy.answer = None
    assert guard.act(window()).actions.shape == (1, 7)


def test_a_user_interrupt_is_not_swallowed():
    with pytest.raises(KeyboardInterrupt):
        guarded(Answers(KeyboardInterrupt())).act(window())


def test_only_a_privileged_policy_gets_task_scene_and_state():
    plain, privileged = Answers(), Answers(privileged=True)
    for policy in (plain, privileged):
        guarded(policy).act(window(state=STATE))
    began, saw = plain.seen
    assert (began.task, began.scene, saw.newest.state) == (None, None, None)
    began, saw = privileged.seen
    assert (began.task, began.scene, saw.newest.state) == (TASK, SceneSpec(), STATE)


def test_a_privileged_policy_without_a_scene_is_refused():
    with pytest.raises(InvalidRequestError, match="privileged"):
        GuardedPolicy(Answers(privileged=True)).reset(start())


def test_a_missing_or_wrongly_sized_camera_is_named():
    policy = Answers()
    policy.cameras = (CameraRequirement(name="wrist", width=32, height=24),)
    guard = guarded(policy)
    with pytest.raises(InvalidRequestError, match="wrist") as caught:
        guard.act(window({"workspace": np.zeros((24, 32, 3), np.uint8)}))
    assert caught.value.code == ErrorCode.OBSERVATION_MISSING
    with pytest.raises(InvalidRequestError, match="32x24 px, got 64x64"):
        guard.act(window({"wrist": np.zeros((64, 64, 3), np.uint8)}))
    guard.act(window({"wrist": np.zeros((24, 32, 3), np.uint8)}))


def test_an_episode_that_was_not_started_is_refused():
    with pytest.raises(InvalidRequestError, match="reset_policy"):
        GuardedPolicy(Answers()).act(window())


def test_a_policy_that_does_not_describe_itself_is_refused():
    policy = Answers()
    policy.describe = lambda: {"name": "x"}
    with pytest.raises(PolicyError, match="PolicyDescription"):
        GuardedPolicy(policy)
    policy = Answers()
    policy.window = 0
    with pytest.raises(PolicyError, match="window"):
        GuardedPolicy(policy)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.float32), np.zeros((4, 6), np.uint16)]
)
def test_an_image_that_is_not_rgb_does_not_reach_the_policy(image):
    """A depth image under the name of a camera would be taken for colours."""
    policy = Answers()
    guard = guarded(policy)
    with pytest.raises(InvalidRequestError, match="RGB images.*camera 'wrist'"):
        guard.act(window({"wrist": image}))
    guard.act(window({"wrist": np.zeros((4, 6, 3), np.uint8)}))


def test_a_policy_is_loaded_from_a_module_and_from_a_file(tmp_path, monkeypatch):
    from roboxim_policies import load_policy

    (tmp_path / "my_policy_module.py").write_text(
        "from roboxim_policies import BasePolicy\n"
        "class Mine(BasePolicy):\n"
        "    cameras = ('wrist',)\n"
        "    def __init__(self, gain=1.0):\n        self.gain = gain\n"
        "    def act(self, window):\n        return [0, 0, -0.01 * self.gain, 0, 0, 0, 1]\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for spec in ("my_policy_module:Mine", f"{tmp_path}/my_policy_module.py:Mine"):
        policy = load_policy(spec, gain=2.0)
        assert policy.describe().cameras[0].name == "wrist"
        assert policy.act(window())[2] == -0.02
    with pytest.raises(ConfigError, match="did you mean 'Mine'"):
        load_policy("my_policy_module:Mien")
    with pytest.raises(ConfigError, match="gian"):
        load_policy("my_policy_module:Mine", gian=1)
    with pytest.raises(ConfigError, match="no_such_module"):
        load_policy("no_such_module:Mine")
    with pytest.raises(ConfigError, match="did you mean 'random'"):
        load_policy("randm")


def test_policies_of_two_files_of_one_name_keep_their_modules(tmp_path):
    from roboxim_policies import load_policy

    policies = {}
    for place, more in {"a": "", "b": "from typing import ClassVar\n"}.items():
        (tmp_path / place).mkdir()
        (tmp_path / place / "twins.py").write_text(
            f"from __future__ import annotations\nfrom dataclasses import dataclass\n{more}"
            "from roboxim_policies import BasePolicy\n"
            "@dataclass\nclass Mine(BasePolicy):\n"
            f"    shared: {'ClassVar[int]' if more else 'int'} = 1\n"
            "    def act(self, window):\n        return [0] * 7\n"
        )
        policies[place] = load_policy(f"{tmp_path / place}/twins.py:Mine")
    assert [field.name for field in fields(policies["b"])] == [], "its annotations are read in the other's module"
    for policy in policies.values():
        assert type(pickle.loads(pickle.dumps(policy))) is type(policy)
    for name in [name for name in sys.modules if name.startswith("twins")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("code", "complaint"),
    [
        ("def broken(:", "cannot be imported: SyntaxError.*line 1"),
        ("import no_such_library", "it needs 'no_such_library', which is not installed"),
        ("raise SystemExit(2)", r"cannot be imported: SystemExit: 2 \(raised at .*theirs.py:1\)"),
        (
            "class Theirs:\n    def __init__(self):\n        raise RuntimeError('weights are gone')",
            r"cannot be made: RuntimeError: weights are gone \(raised at .*theirs.py:3\)",
        ),
    ],
)
def test_a_policy_that_cannot_be_made_says_where(tmp_path, code, complaint):
    from roboxim_policies import load_policy

    path = tmp_path / "theirs.py"
    path.write_text(code)
    with pytest.raises((PolicyError, UnavailableError), match=complaint):
        load_policy(f"{path}:Theirs")
    sys.modules.pop("theirs", None)
