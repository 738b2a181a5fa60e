"""The policy that receives other words."""

import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_policies.base import load_policy
from roboxim_policies.reworded import RewordedPolicy

LISTENER = """
from roboxim_policies import BasePolicy


class Listener(BasePolicy):
    name = "listener"

    def __init__(self, gain: float = 1.0) -> None:
        self.gain, self.heard = gain, []

    def reset(self, start):
        self.heard.append(start.instruction)

    def act(self, window):
        self.heard.append(window.instruction)
        assert self.heard == ["", ""], self.heard
        return [self.gain * 0.001, 0, 0, 0, 0, 0, 1]
"""


def test_a_policy_hears_other_words_and_all_else_is_the_same(tmp_path):
    file = tmp_path / "listener.py"
    file.write_text(LISTENER)
    policy = load_policy("reworded", policy=f"{file}:Listener", instruction="", gain=2.0)
    policy.reset(EpisodeStart(episode_id="a", instruction="Pick up the cube", seed=1))
    window = ObservationWindow(instruction="Pick up the cube", observations=[], pad_mask=(), episode_id="a", seq=0)
    assert policy.act(window)[0] == pytest.approx(0.002)
    assert policy.describe().name == "listener"
    assert "with the instruction ''" in policy.describe().version


def test_a_bag_is_told_what_the_other_policy_was_given_not_what_was_configured(tmp_path):
    file = tmp_path / "listener.py"
    file.write_text(LISTENER.replace("        assert self.heard", "        # assert self.heard"))
    window = ObservationWindow(
        instruction="Pick up the cube", observations=[Observation(seq=0, stamp_ns=0)], pad_mask=(True,),
        episode_id="a", seq=0,
    )  # fmt: skip

    def received(policy):
        guard = GuardedPolicy(policy)
        guard.reset(EpisodeStart(episode_id="a", instruction="Pick up the cube", seed=1))
        guard.act(window)
        return guard.act(window).received

    assert received(load_policy(f"{file}:Listener")) == ("Pick up the cube",)
    blind = load_policy("reworded", policy=f"{file}:Listener", instruction="")
    assert received(blind) == ("",)
    assert received(blind) == ("",), "each episode anew"
    nested = RewordedPolicy(policy="zero", instruction="outer")
    nested._policy.policy = blind
    assert received(nested) == ("",), "the innermost one counts"

    class Broken(RewordedPolicy):
        def act(self, window):
            return self._policy.act(window)

    broken = Broken(policy=f"{file}:Listener", instruction="")
    assert received(broken) == ("", "Pick up the cube"), "it claims no words, and its requests have them"


def test_its_policy_must_exist_and_take_its_arguments():
    with pytest.raises(ConfigError, match="did you mean 'random'"):
        load_policy("reworded", policy="randon")
    with pytest.raises(ConfigError, match="scael"):
        load_policy("reworded", policy="random", scael=1.0)


@pytest.mark.parametrize(("policy", "any_thread"), [("zero", True), ("random", False)])
def test_any_thread_may_call_it_if_any_thread_may_call_the_other_policy(policy, any_thread):
    assert GuardedPolicy(RewordedPolicy(policy=policy)).any_thread is any_thread


def test_a_policy_hears_the_task_in_the_words_of_a_set(tmp_path):
    file = tmp_path / "listener.py"
    file.write_text(LISTENER)
    policy = load_policy("reworded", policy=f"{file}:Listener", wordings="german")
    for seed, said in ((0, "Heb den roten Würfel hoch"), (1, "Nimm den roten Würfel vom Tisch")):
        policy.reset(EpisodeStart(episode_id="a", instruction="Pick up the red cube", seed=seed))
        assert policy.received_instructions() == (said,)
    assert "with the wordings 'german'" in policy.describe().version
    with pytest.raises(ConfigError, match="not both"):
        load_policy("reworded", policy=f"{file}:Listener", wordings="german", instruction="Stop")
    with pytest.raises(ConfigError, match="no wordings have a set 'german2'"):
        load_policy("reworded", policy=f"{file}:Listener", wordings="german2")
