"""A policy that one process serves to the simulators of a run acts as it does in theirs."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, ErrorCode, PolicyError
from roboxim_core.policies import ActionChunk, CameraRequirement, EpisodeStart
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_policies import BasePolicy
from roboxim_policies.reworded import RewordedPolicy
from roboxim_policies.served import ServedPolicy
from roboxim_policies.serving.batches import Batcher, _Request
from roboxim_policies.serving.shared import SharedServer, SharedSessions

from test_serving import Looking, run, windows  # isort: skip

KEY_ENV = "A_KEY"
SIMULATORS = 3


@contextmanager
def served(make, count=1, *, key="secret", **options):
    """Serve a policy, and yield the server and so many clients."""
    with ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).setenv(KEY_ENV, key)
        server = stack.enter_context(SharedServer(SharedSessions(make), key="secret", port=0, **options))
        description = to_plain(server.sessions.description)
        clients = [ServedPolicy(server.url, description, key_env=KEY_ENV, timeout_s=60.0) for _ in range(count)]
        for client in clients:
            stack.callback(client.close)
        yield server, clients


def start(seed=0, instruction="Pick up the red cube"):
    return EpisodeStart(episode_id="e", instruction=instruction, seed=seed)


def test_a_served_policy_describes_itself_and_answers_bit_for_bit_as_in_process():
    with served(Looking) as (_, [client]):
        assert client.describe() == Looking().describe()
        for seed in (5, 6):
            assert run(client, seed).tobytes() == run(Looking(), seed).tobytes()


class Finishing(BasePolicy):
    def act(self, window):
        return ActionChunk(actions=np.zeros((1, 7), np.float32), done=True, phases=("free",))


def test_what_an_answer_says_beside_its_actions_arrives():
    with served(Finishing) as (_, [client]):
        client.reset(start())
        answer = client.act(next(windows()))
        assert (answer.done, answer.phases) == (True, ("free",))


def test_what_the_served_policy_received_is_what_its_process_says():
    with served(lambda: RewordedPolicy(policy="zero", instruction="Other words")) as (_, [client]):
        guard = GuardedPolicy(client)
        guard.reset(start())
        assert guard.act(next(windows())).received == ("Other words",)


class Batching(BasePolicy):
    """Answers with its own episode's seed; the first batch waits until all simulators have asked."""

    cameras = (CameraRequirement(name="workspace"),)
    made: list = []
    sizes: list = []

    def __init__(self):
        self.made.append(self)

    def another(self):
        return self.__class__.__new__(self.__class__)

    def reset(self, start):
        self.seed = start.seed

    @classmethod
    def act_batch(cls, policies, windows):
        cls.sizes.append(len(windows))
        return [
            np.full(7, policy.seed / 1000 + window.newest.images["workspace"].mean() / 1e6)
            for policy, window in zip(policies, windows, strict=True)
        ]

    def act(self, window):
        raise AssertionError("the server asks in batches")


def test_simulators_that_ask_together_are_answered_together_by_one_model_each_for_its_own_episode():
    Batching.made, Batching.sizes = [], []
    together = threading.Barrier(SIMULATORS)

    def simulate(number):
        guard = GuardedPolicy(clients[number])
        guard.reset(start(seed=number))
        together.wait(60)
        return [float(guard.act(window).actions[0, 0]) for window in windows(20)]

    with served(Batching, SIMULATORS) as (server, clients), ThreadPoolExecutor(SIMULATORS) as pool:
        server.sessions.batcher._took_s = 10.0  # as if the model were slow: it waits a little for the others
        found = list(pool.map(simulate, range(SIMULATORS)))
    pictures = [window.newest.images["workspace"].mean() / 1e6 for window in windows(20)]
    for number in range(SIMULATORS):
        assert found[number] == pytest.approx([number / 1000 + picture for picture in pictures], rel=1e-6)
    assert len(Batching.made) == 1, "one model serves all simulators"
    assert sum(Batching.sizes) == SIMULATORS * 20
    assert max(Batching.sizes) > 1, "no requests were computed together"


class Failing(Batching):
    @classmethod
    def act_batch(cls, policies, windows):
        raise RuntimeError("no memory")


class Fussy(Batching):
    """Fails for the episode of seed 1, and waits until all simulators have asked."""

    @classmethod
    def act_batch(cls, policies, windows):
        if any(policy.seed == 1 for policy in policies):
            raise RuntimeError("not this one")
        return super().act_batch(policies, windows)


def test_a_request_that_fails_in_a_batch_costs_only_its_own_episode():
    Fussy.sizes = []
    batcher = Batcher(Fussy)
    requests = [_Request(Fussy(), window) for window in windows(3)]
    for seed, request in enumerate(requests):
        request.policy.reset(start(seed=seed))
    batcher._answer(requests)
    batcher.close()
    assert [request.answer.exception() is None for request in requests] == [True, False, True]
    assert str(requests[1].answer.exception()) == "not this one"
    assert requests[2].answer.result()[0] == pytest.approx(0.002, abs=1e-3)


class Miscounting(Batching):
    @classmethod
    def act_batch(cls, policies, windows):
        return []


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Looking(fail=True), "raised RuntimeError.*no weights"),
        (Failing, "raised RuntimeError.*no memory"),
        (Miscounting, "act_batch of Miscounting must return one answer for each of the 1 requests"),
    ],
)
def test_a_policy_that_fails_costs_its_episode_and_the_server_goes_on(make, message):
    with served(make) as (_, [client]):
        for _ in range(2):
            client.reset(start())
            with pytest.raises(PolicyError, match=message):
                client.act(next(windows()))


class Choosy(Looking):
    """Refuses the episode of seed 1."""

    def reset(self, start):
        if start.seed == 1:
            raise RuntimeError("not this scene")
        super().reset(start)


def test_a_policy_that_raises_when_an_episode_begins_says_why():
    with served(Choosy) as (_, [client]):
        with pytest.raises(PolicyError, match="could not reset.* raised RuntimeError .*not this scene") as caught:
            client.reset(start(seed=1))
        assert caught.value.code == ErrorCode.POLICY_FAULT
        client.reset(start(seed=0))
        assert len(client.act(next(windows())).actions) == 3


def test_a_lost_server_is_told_from_a_failing_policy():
    with served(Looking) as (server, [client]):
        client.reset(start())
        server.__exit__()
        with pytest.raises(PolicyError) as raised:
            client.act(next(windows()))
        assert raised.value.code == ErrorCode.POLICY_DIED


def test_clients_without_the_key_are_refused():
    with served(Looking, key="wrong") as (_, [client]), pytest.raises(PolicyError, match="401"):
        client.reset(start())


class Knowing(BasePolicy):
    privileged = True

    def act(self, window):
        return np.zeros(7)


def test_a_privileged_policy_is_refused():
    with pytest.raises(ConfigError, match="privileged.*leave --policy-servers out"):
        SharedSessions(Knowing)
