"""Faults through the nodes: each fault has a named reason, fails at most its own episode, and leaves no trace."""

import errno
import os
import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from roboxim_interfaces.action import RunEpisodes as RunEpisodesAction
from roboxim_interfaces.msg import RunConfig as RunConfigMsg
from roboxim_interfaces.srv import RunEpisodes
from sensor_msgs.msg import Image

from roboxim_bringup.graph import NODES, PolicyLaunch, start_graph
from roboxim_bringup.supervisor import Supervisor
from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_core.seeds import SeedPath
from roboxim_eval import ports
from roboxim_policies import BasePolicy
from roboxim_policies.node import PolicyNode
from roboxim_recorder.bag_writer import McapFile
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.run_bags import list_bags
from roboxim_ros.actions import ActionCall
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.runs import activate_transport, free_domain
from roboxim_ros.testing import PATIENCE_S, eventually

pytestmark = pytest.mark.ros
STILL = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
SMALL = {"purpose": "test", "actor": "policy", "image_width": 32, "image_height": 32, "max_steps": 3, "settle_ticks": 1}


class Scripted(BasePolicy):
    """A policy whose responses the test sets."""

    cameras = ("workspace", "wrist")

    def act(self, window):
        return self.answer(window)


@pytest.fixture(scope="module")
def shared():
    """One graph for all tests of this file, so that leftovers of a fault show in the next test."""
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        graph = start_graph(
            host, parameters={"sim": {"scene": "", "renderer": "tiny"}, "recorder": {"output_root": "/"}}
        )
        policy = Scripted()
        node = host.add(lambda context: PolicyNode(policy, context=context, namespace="policy"))
        with graph.clients() as clients:
            yield graph, clients, policy, node


@pytest.fixture
def policy(shared):
    _, _, policy, node = shared
    policy.answer = lambda window: STILL
    declared = node.guard.description
    yield policy
    node.guard.description = declared


@pytest.fixture
def graph(shared, policy):
    return shared[0]


@pytest.fixture
def run(shared, policy):
    def call(indices=(0,), **config):
        request = RunEpisodes.Request(
            config=to_msg(RunConfig(**{**SMALL, **config}), RunConfigMsg), indices=list(indices)
        )
        answer = shared[1].call(RunEpisodes, "evaluator/run_episodes", request, timeout_s=PATIENCE_S)
        return [from_msg(result, EpisodeResult) for result in answer.results]

    return call


def seed():
    return SeedPath(run_seed=0, purpose="test", index=9)


def refused(call):
    """Return the code and message that a call ends with."""
    with pytest.raises(RoboximError) as caught:
        call()
    return caught.value.code, str(caught.value)


def raise_(error):
    raise error


@pytest.mark.parametrize(
    ("answer", "reason", "message"),
    [
        (lambda: raise_(KeyError("weights")), "policy_fault", "KeyError in act at tick 0.*weights"),
        pytest.param(lambda: raise_(SystemExit(3)), "policy_fault", "SystemExit", marks=pytest.mark.thorough),
        (lambda: np.full(7, np.nan), "invalid_action", "finite, got nan at step 0, component 0"),
        (lambda: np.zeros(6), "invalid_action", r"shape \(horizon, 7\), got \(6,\)"),
        pytest.param(lambda: np.zeros((0, 7)), "invalid_action", "shape", marks=pytest.mark.thorough),
        pytest.param(
            lambda: np.zeros((2, 7)),
            "invalid_action",
            "horizon of at most 1, got \\(2, 7\\)",
            marks=pytest.mark.thorough,
        ),
        pytest.param(lambda: "up", "invalid_action", "not numbers", marks=pytest.mark.thorough),
        (lambda: None, "invalid_action", "shape|numbers|finite"),
    ],
)
def test_policy_faults_fail_the_episode_with_a_reason(run, policy, tmp_path, answer, reason, message):
    policy.answer = lambda window: answer() if "-00000-" in window.episode_id else STILL
    first, second = run((0, 1), output_dir=str(tmp_path), policy_timeout_s=PATIENCE_S)
    assert (first.outcome, first.reason) == ("error", reason)
    assert re.search(message, first.message), first.message
    assert (second.outcome, second.steps) == ("failure", 3)
    assert all(check_bag(tmp_path / result.bag).ok for result in (first, second))


def test_a_policy_that_does_not_answer_in_time_is_late(run, policy, tmp_path):
    may_answer = threading.Event()

    def late(window):
        may_answer.wait(PATIENCE_S)
        return STILL

    policy.answer = late
    try:
        (result,) = run(output_dir=str(tmp_path), policy_timeout_s=0.3)
    finally:
        may_answer.set()
    assert (result.outcome, result.reason) == ("error", "policy_late")
    assert "did not answer within 0.3 s" in result.message
    assert check_bag(tmp_path / result.bag).ok
    policy.answer = lambda window: STILL
    assert run(policy_timeout_s=PATIENCE_S)[0].steps == 3, "it answers again"


def test_a_policy_of_another_rate_than_the_run_asks_for_is_refused_before_the_first_step(run, shared, tmp_path):
    guard = shared[3].guard
    guard.description = replace(guard.description, semantics=ActionSemantics(rate_hz=5.0))
    code, message = refused(lambda: run(output_dir=str(tmp_path), rate_hz=10.0))
    assert code == ErrorCode.SEMANTICS_MISMATCH
    assert "rate_hz: 5.0 against 10.0" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("older_frame", [False, True])
@pytest.mark.thorough
def test_a_missing_image_is_named_and_never_replaced_by_an_older_frame(graph, policy, run, monkeypatch, older_frame):
    """The evaluator takes images from topics here, as that of another process does."""
    publisher = graph["sim"]._publisher
    monkeypatch.setattr(ports, "local_ticks", SimpleNamespace(shown=lambda *_: None))
    policy.answer = lambda window: np.array([0, 0, 0.02, 0, 0, 0, 1])
    sent = []

    class Faulty:
        """From tick 2 on publishes nothing, or tick 1's pixels with the later ticks' stamps."""

        def publish(self, serialised):
            message = deserialize_message(serialised, Image)
            sent.append(message)
            if len(sent) > 2:
                monkeypatch.setattr(ports, "MESSAGE_TIMEOUT_S", 2.0)
            if len(sent) > 2 and older_frame:
                message = Image(
                    **{name: getattr(message, name) for name in ("header", "height", "width", "encoding", "step")}
                )
                message.data = sent[1].data
            if len(sent) <= 2 or older_frame:
                publisher("camera/wrist/image").publish(message)

    monkeypatch.setattr(
        graph["sim"],
        "_publisher",
        lambda topic: Faulty() if topic == "camera/wrist/image" else publisher(topic),
    )
    code, message = refused(lambda: run(max_steps=5))
    assert code == ErrorCode.OBSERVATION_MISSING
    assert "tick 2" in message
    assert "wrist" in message
    assert "workspace" not in message
    monkeypatch.undo()
    policy.answer = lambda window: STILL
    assert run()[0].steps == 3, "the sim is free again"


@pytest.mark.parametrize("where", ["write", "finish"])
@pytest.mark.thorough
def test_a_full_disk_ends_the_run_and_leaves_nothing_half_written(run, tmp_path, monkeypatch, where):
    original, calls = getattr(McapFile, where), []

    def full(self, *arguments):
        calls.append(arguments)
        if len(calls) > (30 if where == "write" else 1):
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(self, *arguments)

    monkeypatch.setattr(McapFile, where, full)
    code, message = refused(lambda: run((0, 1), output_dir=str(tmp_path)))
    assert code == ErrorCode.DISK
    assert "free some space" in message
    kept = list((tmp_path / "episodes").glob("*"))
    assert all(check_bag(bag).ok for bag in kept)
    assert not list((tmp_path / ".partial").iterdir())
    monkeypatch.undo()
    missing = [index for index in (0, 1) if not any(f"-{index:05d}-" in bag.name for bag in kept)]
    assert len(missing) == (2 if where == "write" else 1)
    for result in run(missing, output_dir=str(tmp_path)):
        assert check_bag(tmp_path / result.bag).ok


def test_a_cancel_ends_the_run_within_a_tick_and_another_may_follow(shared, policy, run, tmp_path):
    graph, clients, _, _ = shared
    seen, reached = [], threading.Event()

    def slow(window):
        seen.append(window.seq)
        if window.seq == 2:
            reached.set()
            eventually(lambda: graph["evaluator"]._goal.is_cancel_requested)
        return STILL

    policy.answer = slow

    class Stop(Exception):
        pass

    def check():
        if reached.is_set():
            raise Stop

    config = RunConfig(**{**SMALL, "max_steps": 1000, "output_dir": str(tmp_path)})
    goal = RunEpisodesAction.Goal(config=to_msg(config, RunConfigMsg), indices=[0, 1])
    with ActionCall(clients, RunEpisodesAction, "evaluator/run_episodes") as action:
        with pytest.raises(Stop):
            action.run(goal, check=check)
        last = seen[-1]
        policy.answer = lambda window: STILL
        assert run()[0].steps == 3, "the evaluator is free at once"
    assert last <= 3
    assert not list(tmp_path.rglob("*.mcap")), "the bag of a cancelled episode is dropped"


def test_a_second_run_at_a_time_is_refused_and_does_not_disturb_the_first(shared, policy, run):
    _, clients, _, _ = shared
    refusals = []

    def meanwhile(window):
        if window.seq == 1:
            request = RunEpisodes.Request(config=to_msg(RunConfig(**SMALL), RunConfigMsg), indices=[5])
            with ActionCall(clients, RunEpisodesAction, "evaluator/run_episodes") as action:
                answer = action.run(RunEpisodesAction.Goal(config=request.config, indices=[5]), timeout_s=PATIENCE_S)
            refusals.append((answer.status, answer.result.error_msg))
        return STILL

    policy.answer = meanwhile
    (result,) = run(policy_timeout_s=PATIENCE_S)
    assert (result.outcome, result.steps) == ("failure", 3), result
    assert [status for status, _ in refusals] == ["aborted"]
    assert "already running episodes; wait for them or cancel them" in refusals[0][1]


def test_malformed_requests_are_rejected(run, tmp_path):
    assert run(()) == []
    (result,) = run(max_steps=100_000, actor="expert", settle_ticks=5)
    assert result.outcome == "success"
    code, message = refused(lambda: run(max_steps=2**32 - 1))
    assert code == ErrorCode.INVALID_REQUEST
    assert "max_steps must be from 0 to 100000" in message
    code, message = refused(lambda: run(rate_hz=7.0, actor="expert"))
    assert code == ErrorCode.INVALID_REQUEST
    assert "must divide the physics rate of 240 Hz, got 7" in message
    code, message = refused(lambda: run(output_dir="somewhere/relative"))
    assert code == ErrorCode.INVALID_REQUEST
    assert "absolute" in message
    (tmp_path / "file").write_text("in the way")
    code, message = refused(lambda: run(output_dir=str(tmp_path / "file")))
    assert code == ErrorCode.DISK


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("skill: [pick_up", "YAML"),
        ("just words", "mapping"),
        ("skill: pick_upp", "did you mean 'pick_up'"),
        ("{skill: pick_up, objects: {target: {models: {values: [cubee]}}}}", "did you mean 'cube'"),
        (
            "{skill: pick_up, objects: {target: {models: {values: [cube]}, modifiers: {color: {values: [mauve]}}}}}",
            "mauve.*red",
        ),
    ],
)
def test_a_wrong_task_configuration_is_refused_by_name(run, task, expected):
    code, message = refused(lambda: run(task_config=task))
    assert code in (ErrorCode.INVALID_CONFIG, ErrorCode.UNKNOWN_SKILL, ErrorCode.UNKNOWN_MODEL)
    assert re.search(expected, message), message


@pytest.mark.thorough
def test_an_evaluator_that_died_does_not_lock_out_its_successor(shared, policy, run):
    graph, clients, _, _ = shared
    client = ports.RosPorts(graph.host.context, graph.namespace)
    try:
        client.sim.load("dead", client.tasks.draw(seed(), "").scene)
    finally:
        client.close()
    assert run()[0].steps == 3


def test_a_foreign_lease_is_respected(shared, run):
    graph, clients, _, _ = shared
    sim = ports.SimClient(clients)
    sim.load("of-a-user", ports.TaskClient(clients).draw(seed(), "").scene)
    code, message = refused(run)
    assert code == ErrorCode.LEASE_HELD
    assert "release it first" in message
    sim.release("of-a-user")
    assert run()[0].steps == 3


@pytest.mark.thorough
def test_an_unwritable_folder_is_a_disk_error(tmp_path):
    (tmp_path / "file").touch()
    words = [
        sys.executable,
        "-m",
        "roboxim_cli",
        "generate",
        "--episodes",
        "1",
        "--out",
        str(tmp_path / "file" / "x"),
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 1
    assert "Not a directory" in done.stderr
    assert "[DISK]" in done.stderr
    assert "Traceback" not in done.stderr


SLOW_POLICY = """
import time
from roboxim_policies import BasePolicy
class Slow(BasePolicy):
    cameras = ("workspace",)
    def act(self, window):
        time.sleep(0.1)
        return [0, 0, 0, 0, 0, 0, 1]
"""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_any_process_of_a_graph_may_be_killed_in_mid_episode(tmp_path):
    (tmp_path / "slow.py").write_text(SLOW_POLICY)
    launch = PolicyLaunch(spec=f"{tmp_path / 'slow.py'}:Slow")
    with free_domain() as domain, mock.patch.dict(os.environ, ROS_DOMAIN_ID=str(domain)):
        activate_transport()
        parameters = {"sim": {"scene": "", "renderer": "tiny"}}
        with NodeHost() as host, Supervisor(tuple(NODES), [launch], parameters=parameters) as supervisor:
            supervisor.wait_until_ready()
            pids = {child.process.pid for child in supervisor.children}
            for number, name in enumerate(["policy", *NODES]):
                pids.add(_survive(name, 10 * number, supervisor, host, tmp_path / name))
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids), "no orphan is left"


def _survive(name, first, supervisor, host, out):
    """Kill a process in mid-episode; return the id of its successor."""
    running, ended = threading.Event(), []

    def watch(message):
        if message.feedback.seq >= 5:
            running.set()

    def goal(indices):
        actor = "policy" if name == "policy" else "expert"
        config = RunConfig(**{**SMALL, "actor": actor, "max_steps": 0, "settle_ticks": 10, "output_dir": str(out)})
        return RunEpisodesAction.Goal(config=to_msg(config, RunConfigMsg), indices=indices)

    def attempt(indices):
        with (
            Clients("killer", context=host.context) as clients,
            ActionCall(clients, RunEpisodesAction, "/evaluator/run_episodes") as action,
        ):
            try:
                ended.append(action.run(goal(indices), feedback=watch, timeout_s=PATIENCE_S).result)
            except RoboximError as error:
                ended.append(error)

    def run(indices):
        thread = threading.Thread(target=attempt, args=(indices,))
        thread.start()
        return thread

    thread = run([first, first + 1])
    assert running.wait(PATIENCE_S), name
    child = next(child for child in supervisor.children if child.name == name)
    killed = child.process
    killed.kill()
    killed.wait()
    while thread.is_alive():
        supervisor.supervise()
        thread.join(0.2)
    while child.process is killed:
        supervisor.supervise()
    supervisor.wait_until_ready()
    (broken,) = ended
    if isinstance(broken, RoboximError):
        assert name == "evaluator", broken
    elif broken.error_code:
        assert name in broken.error_msg or "sim/" in broken.error_msg, broken.error_msg
    else:
        assert sum(result.outcome == "error" for result in broken.results) <= 1, broken.results
    ended.clear()
    run([first + 5]).join()
    (after,) = ended
    assert not isinstance(after, RoboximError), f"{name}: {after}"
    assert after.error_code == 0, f"{name}: {after.error_msg}"
    assert after.results[0].outcome == ("failure" if name == "policy" else "success"), name
    assert all(check_bag(bag).ok for bag in list_bags(out)), name
    return child.process.pid
