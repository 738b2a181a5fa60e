"""A class or an instance of the calling process is evaluated like any policy: this process serves it."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_policies import BasePolicy
from roboxim_policies.base import load_policy
from roboxim_runs.evaluation.checks import require_local
from roboxim_runs.executors import Work
from roboxim_runs.policies.here import OwnServer, own_policy
from roboxim_runs.policies.servers import SERVED
from roboxim_runs.policies.specs import find_policies

MEASURED = Proprioception(
    tcp_position=(0.5, 0.0, 0.3), tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0), gripper_opening=1.0
)


class Counting(BasePolicy):
    def __init__(self, step: float = 0.001) -> None:
        self.step, self.asked = step, 0

    def reset(self, start: EpisodeStart) -> None:
        self.asked = 0

    def act(self, window: ObservationWindow) -> np.ndarray:
        self.asked += 1
        return np.array([self.step * self.asked, 0, 0, 0, 0, 0, 1.0])


class Locked(Counting):
    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


def served(server: OwnServer, monkeypatch: pytest.MonkeyPatch) -> BasePolicy:
    """Return the policy as a worker has it."""
    settings = {"graph": {"policies": [{"spec": "x:Y", "options": {}}]}, "config": {"policy_timeout_s": 20.0}}
    work = server.prepared(Work(worker="", settings=settings), 0, threading.Event())
    for name, value in work.environment.items():
        monkeypatch.setenv(name, value)
    (launch,) = work.settings["graph"]["policies"]
    assert launch["spec"] == SERVED
    policy = load_policy(launch["spec"], **launch["options"])
    policy.reset(EpisodeStart(episode_id="e", instruction="Pick up the cube", seed=1))
    return policy


def first_dx(policy: BasePolicy) -> float:
    window = ObservationWindow(
        instruction="Pick up the cube", pad_mask=(True,), episode_id="e", seq=1,
        observations=[Observation(seq=1, stamp_ns=0, images={}, proprio=MEASURED)],
    )  # fmt: skip
    return float(policy.act(window).actions[0][0])


def test_an_instance_and_copies_of_it_answer_several_workers(monkeypatch):
    mine = Counting(step=0.002)
    (chosen,) = find_policies([mine])
    assert (chosen.name, chosen.is_checkpoint) == ("Counting", False)
    assert list(chosen.files(None)) == ["test_here.py"]
    with OwnServer(chosen.own) as server:
        one, two = served(server, monkeypatch), served(server, monkeypatch)
        assert [first_dx(one), first_dx(one), first_dx(two)] == pytest.approx([0.002, 0.004, 0.002])
        one.close()
        two.close()
    assert mine.asked == 2


def test_a_class_is_made_for_each_worker_and_its_arguments_are_checked():
    class Needy(Counting):
        def __init__(self, model: str) -> None:
            super().__init__()

    with pytest.raises(ConfigError, match="'model' is missing"):
        find_policies([Needy])
    assert find_policies([Needy("mine"), Counting])[0].name == "Needy"


def test_what_cannot_be_served_is_refused_with_the_reason():
    with pytest.raises(ConfigError, match="subclass of BasePolicy or an instance of one; got 3"):
        find_policies([3])
    (chosen,) = find_policies([Locked()])
    with pytest.raises(ConfigError, match="workers on other machines do not reach"):
        require_local([chosen], object(), 1)
    require_local([chosen], None, 1)
    with pytest.raises(ConfigError, match="'Locked' cannot be copied.*give workers=1"):
        require_local([chosen], None, 2)
    knowing = type("Knowing", (Counting,), {"privileged": True})
    with pytest.raises(ConfigError, match="'Knowing' is privileged"):
        own_policy(knowing())
