"""RoboXim's policies, served over each wire and asked over it, act as they do in process."""

import json
import threading
import urllib.request
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.actions import (
    ActionPlan,
    ActionSemantics,
    Chunking,
    Ensemble,
    GripperRule,
    GripperSwitch,
    LateRows,
    hold_action,
)
from roboxim_core.conventions import load_convention, observe
from roboxim_core.errors import ConfigError, PolicyError, RoboximError
from roboxim_core.policies import CameraRequirement, EpisodeStart, Observation, ObservationWindow
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.proprioception import Proprioception
from roboxim_policies import BasePolicy, load_policy
from roboxim_policies.serving import Sessions, policy_server
from roboxim_policies.wires import openvla
from roboxim_policies.wires.own import own_extras


class Looking(BasePolicy):
    """Acts on everything that it may see: pictures, measurements, instruction, seed, and what it did before."""

    cameras = (CameraRequirement(name="workspace", width=32, height=24), CameraRequirement(name="wrist"))
    window = 2
    horizon = 3
    semantics = ActionSemantics(rate_hz=0)

    def __init__(self, fail: bool = False):
        self.fail = fail

    def reset(self, start):
        self.rng = np.random.default_rng(start.seed + len(start.instruction))
        self.asked = 0

    def act(self, window):
        if self.fail:
            raise RuntimeError("no weights")
        self.asked += 1
        seen = [window.newest.images["workspace"].mean(), window.observations[0].images["wrist"].mean() / 255]
        measured = sum(window.newest.proprio.joint_velocities) + window.newest.proprio.tcp_rotation_6d[1]
        noise = self.rng.normal(size=(3, 7)) * 0.01
        noise[:, 6] = (self.asked + window.seq + sum(window.pad_mask)) % 2
        noise[:, :3] += np.array([*seen, measured]) / 1e4
        return noise.astype(np.float32)


def windows(count=4):
    rng = np.random.default_rng(3)
    seen = [
        Observation(
            seq=seq,
            stamp_ns=seq * 100,
            images={
                "workspace": rng.integers(0, 255, (24, 32, 3), np.uint8),
                "wrist": rng.integers(0, 255, (64, 64, 3), np.uint8),
            },
            proprio=Proprioception(
                tcp_position=tuple(rng.normal(size=3)),
                tcp_rotation_6d=(0.36, 0.48, -0.8, -0.8, 0.6, 0.0),
                joint_names=("a", "b"),
                joint_positions=tuple(rng.normal(size=2)),
                joint_velocities=tuple(rng.normal(size=2)),
                gripper_opening=rng.uniform(),
            ),
        )
        for seq in range(count)
    ]
    for seq in range(count):
        pair = [seen[max(seq - 1, 0)], seen[seq]]
        yield ObservationWindow(
            instruction="Pick up the red cube", observations=pair, pad_mask=(seq > 0, True), episode_id="e", seq=seq
        )


@contextmanager
def served(make, **options):
    """Serve a policy over openpi's wire, and yield a remote policy that asks it."""
    with ExitStack() as stack:
        server = stack.enter_context(policy_server(make, "openpi", port=0, size=64, **options))
        yield stack.enter_context(load_policy("openpi", url=server.url, convention="server", version="1"))


def run(policy, seed=5):
    guard = GuardedPolicy(policy)
    guard.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=seed))
    return np.stack([guard.act(window).actions for window in windows()])


def test_served_policy_answers_bit_for_bit_as_in_process():
    with served(Looking) as remote:
        assert remote.describe().cameras[0] == Looking.cameras[0]
        assert remote.describe().semantics == Looking.semantics
        for seed in (5, 6):
            expected, found = run(Looking(), seed), run(remote, seed)
            assert found.dtype == expected.dtype == np.float32
            assert found.tobytes() == expected.tobytes()


class Ensembled(Looking):
    """Is asked at every second tick, and its answers are averaged."""

    chunking = Chunking(execute=2, ensemble=Ensemble.EXPONENTIAL, ensemble_decay=0.3)


class Steadied(Looking):
    """Needs two actions that agree before its gripper changes."""

    chunking = Chunking(execute=2)
    gripper = GripperRule(binary=True, band=0.2, agree=2)


def executed(policy, seed, ticks=9):
    """Return what the episode loop executes of a policy, shape (ticks, 7)."""
    guard = GuardedPolicy(policy)
    guard.reset(EpisodeStart(episode_id=f"e{seed}", instruction="Pick up the red cube", seed=seed))
    plan = ActionPlan(guard.description.chunking, guard.description.semantics)
    switch, actions = GripperSwitch(guard.description.gripper), []
    for window in windows(ticks):
        if plan.due(window.seq):
            plan.add(window.seq, 0, guard.act(replace(window, episode_id=f"e{seed}")).actions, ())
        action = plan.action(window.seq).action.copy()
        action[6] = switch.step(float(action[6]))
        actions.append(action)
    return np.stack(actions)


class Lagging(Looking):
    """Was trained with an arm that lags, and executes late answers from their own tick on."""

    semantics = ActionSemantics()
    lag = (0.1, 0.2, 0.3, 0.0, 0.0, 0.5)
    chunking = Chunking(execute=2, late_rows=LateRows.DROP)


def test_a_served_policy_keeps_its_lag_and_its_use_of_late_answers():
    with served(Lagging) as remote:
        assert (remote.describe().lag, remote.describe().chunking) == (Lagging.lag, Lagging.chunking)
        assert run(remote).tobytes() == run(Lagging()).tobytes()


class Commanded(Looking):
    """Moves up by the gripper command that was executed before, and closes a little more with each answer."""

    semantics = ActionSemantics()
    horizon = 1

    def reset(self, start):
        self.rows = iter(np.linspace(0.9, 0.1, 9))

    def act(self, window):
        assert window.commanded_opening is None or 0 <= window.commanded_opening <= 1
        return [0.0, 0.0, 0.01 * (window.commanded_opening or 0.0), 0.0, 0.0, 0.0, next(self.rows)]


@pytest.mark.parametrize("wire", ["openpi", "vla_eval", "openvla"])
def test_a_served_policy_is_told_the_gripper_command_that_was_executed(wire):
    with (
        policy_server(Commanded, wire, port=0, size=64) as server,
        load_policy(wire, url=server.url, convention="server", version="1") as remote,
    ):
        remote.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=0))
        told = (None, 0.25, 0.75)
        rows = [remote.act(replace(w, commanded_opening=o))[0] for w, o in zip(windows(3), told, strict=True)]
        assert [row[2] for row in rows] == pytest.approx([0.0, 0.0025, 0.0075])


def test_a_client_that_takes_one_action_at_each_tick_need_not_tell_what_it_executed():
    sessions = Sessions(Commanded, single=True, size=64)
    with sessions.session() as session:
        requests = [observe(sessions.convention, window) for window in windows(3)]
        rows = [session.answer(request)[0] for request in requests]
    assert [row[2] for row in rows] == pytest.approx([0.0, 0.009, 0.008])


@pytest.mark.parametrize("wire", ["openpi", "vla_eval", "openvla"])
@pytest.mark.parametrize("kind", [Looking, Ensembled, Steadied])
def test_what_is_executed_is_the_same_bit_for_bit_over_every_wire(wire, kind):
    """Two wires carry one action in each answer, and one of them has no episodes."""
    logged = []
    with (
        policy_server(kind, wire, port=0, size=64, log=logged.append) as server,
        load_policy(wire, url=server.url, convention="server", version="1") as remote,
    ):
        for seed in (5, 6, 6):
            assert executed(remote, seed).tobytes() == executed(kind(), seed).tobytes()
    assert not logged


def test_clients_of_openvlas_wire_have_sessions_of_their_own():
    with policy_server(Looking, "openvla", port=0, size=64) as server:
        remotes = [load_policy("openvla", url=server.url, convention="server", version="1") for _ in range(2)]
        for seed, remote in enumerate(remotes):
            remote.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=seed))
        first, *_ = windows()
        together = [remote.act(first) for remote in remotes]
        for seed in range(2):
            alone = Looking()
            alone.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=seed))
            np.testing.assert_array_equal(together[seed], alone.act(first)[:1])


def test_a_client_of_openvlas_wire_that_is_dropped_while_it_waits_gets_a_session_of_its_own():
    """Otherwise it would act with a policy that another client has taken meanwhile."""
    with policy_server(Looking, "openvla", port=0, size=64) as server:
        with server._client("a") as first:
            pass

        class Dropped:
            def __enter__(self):
                first.lock = threading.Lock()
                server._clients.pop("a").close()

            def __exit__(self, *_):
                pass

        first.lock = Dropped()
        with server._client("a") as again:
            assert again is not first


class Counting(BasePolicy):
    """Its action says how often it was asked in this episode."""

    cameras = (CameraRequirement(name="workspace", width=32, height=32), CameraRequirement(name="wrist"))
    semantics = ActionSemantics(rate_hz=0)
    horizon = 2

    def reset(self, start):
        self.asked = 0

    def act(self, window):
        self.asked += 1
        return [[self.asked / 100, row / 100, 0, 0, 0, 0, 1] for row in range(2)]


def test_foreign_client_of_openvlas_wire_gets_the_chunks_rows_and_begins_episodes_as_well_as_it_can():
    with policy_server(Counting, "openvla", port=0, convention=load_convention("roboxim")) as server:

        def ask(x, instruction="red", **more):
            state = np.array([x, 0, 0.3, 1, 0, 0, 0, -1, 0, 1.0])
            pictures = {key: np.zeros((256, 256, 3), np.uint8) for key in ("image", "wrist_image")}
            body = openvla.encode({**pictures, "state": state, "instruction": instruction, **more})
            asked = urllib.request.Request(f"{server.url}/act", body, {"Content-Type": "application/json"})
            answer = openvla.decode(urllib.request.urlopen(asked).read())
            return tuple(np.round(answer[:2] * 100).astype(int))

        assert [ask(0.50 + 0.01 * i) for i in range(4)] == [(1, 0), (1, 1), (2, 0), (2, 1)]
        assert ask(0.54) == (3, 0)
        assert ask(0.20) == (1, 0), "the arm was set back"
        assert ask(0.20) == (1, 1)
        assert ask(0.20, "blue") == (1, 0)
        assert ask(0.20, "blue", episode_id=7) == (1, 0)
        assert ask(0.20, "blue", episode_id=7) == (1, 1)
        assert ask(0.20, "blue", episode_id=8) == (1, 0)


def test_genuine_client_of_vla_eval_is_told_by_its_first_observation_what_to_do():
    """Its ``episode_start`` has the name of the task; the instruction comes with the observations."""
    sessions = Sessions(Approach, convention=load_convention("libero"), single=True)
    with sessions.session() as session:
        session.begin(episode_id="", seed=0)
        request = {
            **{f"observation/{key}": np.zeros((224, 224, 3), np.uint8) for key in ("image", "wrist_image")},
            "observation/state": np.array([-0.16, 0.1, 1.212, np.pi, 0, 0, 0.04, -0.04]), "prompt": "red",
        }  # fmt: skip
        assert session.answer(request)[0, 6] == 1
        session.begin(episode_id="", seed=0)
        assert session.answer({**request, "prompt": "blue"})[0, 6] == -1


def test_sessions_have_policies_of_their_own():
    with policy_server(Looking, "openpi", port=0, size=64) as server:
        remotes = [load_policy("openpi", url=server.url, convention="server", version="1") for _ in range(3)]
        for index, remote in enumerate(remotes):
            remote.reset(EpisodeStart(episode_id="e", instruction="x", seed=index))
        window = next(windows())
        together = [np.float32(remote.act(window)) for remote in remotes]
        for index, remote in enumerate(remotes):
            alone = Looking()
            alone.reset(EpisodeStart(episode_id="e", instruction="x", seed=index))
            np.testing.assert_array_equal(together[index], alone.act(window))
            remote.close()


PICTURE = "observation/images/workspace"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda request: request["observation/state"].fill(np.nan), "'observation/state' must have 20 finite numbers"),
        (lambda request: request["observation/state"][:, :3].fill(np.inf), "got 20, of which 14 are finite"),
        (lambda request: request["observation/state"].fill(0), "'observation/state' of the request: .*rotation_6d"),
        (lambda request: request.update({PICTURE: np.uint8(3)[...]}), "must have 2 RGB pictures, .* got .."),
        (lambda request: request.update({PICTURE: np.zeros((2, 0, 0, 3), np.uint8)}), "must have 2 RGB pictures"),
        (lambda request: request["roboxim"].update(seq="x"), "'roboxim' of .*: seq: expected a whole number, got 'x'"),
        (lambda request: request["roboxim"].update(seed=[]), "'roboxim' of .*: seed: expected .*"),
        (lambda request: request["roboxim"]["observations"][1].pop("proprio"), "observations.1.proprio: required key"),
        (
            lambda request: request["roboxim"]["observations"][0]["proprio"].update(tcp_position=[1.0]),
            "observations.0.proprio.tcp_position: expected 3 values, got 1",
        ),
        (lambda request: request["roboxim"].update(observations=[]), "must have 2 observations, got 0"),
        (lambda request: request["roboxim"].update(commanded_opening=np.nan), "commanded_opening: expected a finite"),
    ],
)
def test_a_wrong_request_is_refused_by_its_field(change, words):
    sessions, (window, *_) = Sessions(Looking, size=64), windows()
    request = {**observe(sessions.convention, window), "roboxim": own_extras(window)}
    if "state" in words or "14" in words:
        del request["roboxim"]
    change(request)
    with sessions.session() as session, pytest.raises(RoboximError, match=words):
        session.answer(request)


def test_failing_policy_costs_its_episode_and_the_server_goes_on():
    logged = []
    with served(lambda: Looking(fail=True), log=logged.append) as remote:
        for _ in range(2):
            remote.reset(EpisodeStart(episode_id="e", instruction="x", seed=0))
            with pytest.raises(PolicyError, match="PolicyError: policy 'Looking' raised RuntimeError.*no weights"):
                remote.act(next(windows()))


class Approach(BasePolicy):
    """Moves the tool towards a point, so that its action depends on the state that arrives."""

    cameras = ("workspace", "wrist")
    semantics = ActionSemantics(rate_hz=0)

    def act(self, window):
        action = hold_action(0.0 if "red" in window.instruction else 1.0)
        action[:3] = 0.05 * (0.4 - np.array(window.newest.proprio.tcp_position))
        action[3] = 0.1
        return action


@pytest.mark.parametrize("wire", ["openpi", "vla_eval", "openvla"])
def test_served_policy_speaks_the_convention_of_a_benchmark(wire):
    libero = load_convention("libero")
    window = ObservationWindow(
        instruction="red",
        observations=[
            Observation(
                seq=0,
                stamp_ns=0,
                images={name: np.zeros((256, 256, 3), np.uint8) for name in ("workspace", "wrist")},
                proprio=Proprioception(
                    tcp_position=(0.5, 0.1, 0.3), tcp_rotation_6d=(1, 0, 0, 0, -1, 0), gripper_opening=0.5
                ),
            )
        ],
        pad_mask=(True,),
        episode_id="e",
        seq=0,
    )
    with policy_server(Approach, wire, port=0, convention=libero) as server:
        if wire == "openvla":
            request = {
                "image": np.zeros((224, 224, 3), np.uint8),
                "wrist_image": np.zeros((224, 224, 3), np.uint8),
                "state": observe(libero, window)["observation/state"],
                "instruction": "red",
            }
            for double in (False, True):
                asked = urllib.request.Request(
                    f"{server.url}/act", openvla.encode(request, double=double), {"Content-Type": "application/json"}
                )
                raw = openvla.decode(urllib.request.urlopen(asked).read())
        else:
            with load_policy(wire, url=server.url, convention="server", version="1") as remote:
                remote.reset(EpisodeStart(episode_id="e", instruction="red", seed=0))
                raw = remote.raw(window)[0]
    # the motion in units of what robosuite's arm moves per step of 0.05 m and 0.5 rad, and 1 closes
    gains = np.array(libero.action.response.gain)
    np.testing.assert_allclose(raw, [*(np.array([-0.1, 0.3, 0.1, 0.2, 0, 0]) / gains), 1], atol=1e-6)


def test_openvla_answers_errors_as_the_genuine_server_does():
    logged = []
    with policy_server(Approach, "openvla", port=0, convention=load_convention("libero"), log=logged.append) as server:
        asked = urllib.request.Request(f"{server.url}/act", b'{"x": 1}', {"Content-Type": "application/json"})
        assert json.loads(urllib.request.urlopen(asked).read()) == "error"
    assert "needs an instruction" in logged[0]


def test_web_pages_cannot_use_a_server():
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with policy_server(Looking, "openpi", port=0) as server:
        assert urllib.request.urlopen(server.url.replace("ws", "http") + "/healthz").read() == b"OK\n"
        with pytest.raises(InvalidStatus), connect(server.url, origin="https://example.org"):
            pass


def test_policy_gets_pictures_of_the_size_that_it_states():
    """A checkpoint states the sizes of its training; a client of LIBERO sends 224 x 224 px."""

    class Small(Approach):
        cameras = (CameraRequirement(name="workspace", width=48, height=32), CameraRequirement(name="wrist"))

        def act(self, window):
            assert window.newest.images["wrist"].shape == (224, 224, 3)
            action = super().act(window)
            action[3] = window.newest.images["workspace"][:16].mean() / 1000  # of the upper half
            return action

    libero = load_convention("libero")
    picture = np.zeros((224, 224, 3), np.uint8)
    picture[:112] = 200
    request = {
        "observation/image": picture, "observation/wrist_image": picture, "prompt": "red",
        "observation/state": np.array([-0.16, 0.1, 1.212, np.pi, 0, 0, 0.04, -0.04]),
    }  # fmt: skip
    sessions = Sessions(Small, convention=libero)
    with sessions.session() as session:
        assert session.answer(request)[0, 3] == pytest.approx(0.2 / 0.5 / libero.action.response.gain[3], abs=0.02)


def test_what_cannot_be_served_is_refused():
    class Privileged(Looking):
        privileged = True

    with pytest.raises(ConfigError, match="privileged"):
        policy_server(Privileged, "openpi")
    with pytest.raises(ConfigError, match="expected one of: openpi, openvla, vla_eval"):
        policy_server(Looking, "groot")
    roboxim = load_convention("roboxim")
    blind = replace(roboxim, images=roboxim.images[:1])
    with pytest.raises(ConfigError, match="needs camera wrist, the convention"):
        policy_server(Looking, "openpi", convention=blind)

    class Slow(Approach):
        semantics = ActionSemantics(rate_hz=10)

    with pytest.raises(ConfigError, match="acts at 10 Hz, the convention 'libero' at 20 Hz.*a copy of the convention"):
        policy_server(Slow, "openpi", convention=load_convention("libero"))
    with pytest.raises(ConfigError, match="acts by 'end_effector_delta', the convention 'droid_velocity' by"):
        policy_server(Approach, "openpi", convention=load_convention("droid_velocity"))
