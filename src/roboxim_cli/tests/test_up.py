"""``roboxim up`` as a user runs it: processes that find each other, end together and leave nothing behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from roboxim_ros.runs import find_run, live_runs
from roboxim_ros.testing import PATIENCE_S, eventually

pytestmark = pytest.mark.ros


def command(*words):
    return [sys.executable, "-m", "roboxim_cli", *words]


def roboxim(*words):
    done = subprocess.run(command(*words), capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    return done.stdout


class Up:
    """A running ``roboxim up``."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.log = folder / "up.log"
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(command("up", *options), stdout=output, stderr=output)
        eventually(lambda: "is up in domain" in self.text or self.process.poll() is not None)
        assert self.process.poll() is None, self.text

    @property
    def text(self) -> str:
        return self.log.read_text()


@pytest.fixture
def up(runtime):
    started = []

    def start(*options):
        started.append(Up(runtime, *options))
        return started[-1]

    yield start
    for one in started:
        one.process.kill()
        one.process.wait()


def gone(pids):
    return not any(Path(f"/proc/{pid}").exists() and _state(pid) != "Z" for pid in pids)


def _state(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


@pytest.mark.thorough
def test_killed_child_is_started_again_and_killed_parent_leaves_no_orphan(up):
    one = up("--processes", "--only", "recorder", "--policy", "zero")
    before = find_run().pids
    assert len(before) == 3
    assert {"/policy/policy", "/recorder"} <= set(roboxim("node", "list").split())
    os.kill(before[1], signal.SIGKILL)
    eventually(lambda: "node 'policy' has died (killed by SIGKILL); starting it again" in one.text)
    eventually(lambda: len(find_run().live_pids) == 3 and find_run().pids != before)
    pids = find_run().pids
    one.process.kill()
    eventually(lambda: gone(pids))
    assert live_runs() == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.thorough
def test_signal_ends_everything_in_order(up, number):
    one = up("--only", "recorder")
    one.process.send_signal(number)
    assert one.process.wait(PATIENCE_S) == 0
    assert live_runs() == []


@pytest.mark.thorough
def test_detached_graph_is_ended_by_down(runtime):
    text = roboxim("up", "--only", "recorder", "--detach", "--id", "behind")
    assert "run behind is up" in text
    pids = find_run("behind").pids
    assert "ended run behind" in roboxim("down")
    assert gone(pids)
    assert live_runs() == []


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["-p", "nonsense"], "name:=value"),
        (["--policy", "nonsense"], "unknown policy 'nonsense'"),
        (["--processes", "-p", "recorder:nonsense:=1"], "no parameter 'nonsense'"),
    ],
)
@pytest.mark.thorough
def test_wrong_configuration_ends_it_before_it_is_up(runtime, options, complaint):
    done = subprocess.run(
        command("up", "--only", "recorder", *options), capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert done.returncode != 0
    assert complaint in done.stderr
    assert live_runs() == []


@pytest.mark.thorough
def test_nodes_started_one_by_one_make_one_run(runtime):
    first = subprocess.Popen(command("node", "recorder"), stdout=subprocess.PIPE, text=True)
    second = None
    try:
        assert "serves in run" in first.stdout.readline()
        second = subprocess.Popen(command("policy", "serve", "zero", "--namespace", "mine"), stdout=subprocess.PIPE)
        assert find_run().id.encode() in second.stdout.readline()
        assert {"/recorder", "/mine/policy"} <= set(roboxim("node", "list").split())
        answer = yaml.safe_load(roboxim("service", "call", "/mine/describe_policy"))
        assert answer["description"]["name"] == "zero"
        first.terminate()
        first.wait(PATIENCE_S)
        assert find_run().pids == (second.pid,)
    finally:
        for process in filter(None, (first, second)):
            process.kill()
            process.wait()
            process.stdout.close()


EPISODE = {
    "config": {"run_seed": 4, "purpose": "test", "actor": "expert", "image_width": 32, "image_height": 32},
    "indices": [0],
}


@pytest.mark.slow
def test_one_process_and_many_behave_the_same(up):
    hashes = []
    for mode in ([], ["--processes"]):
        one = up(*mode, "-p", "sim:renderer:=tiny")
        result = yaml.safe_load(roboxim("action", "send_goal", "/evaluator/run_episodes", json.dumps(EPISODE)))
        [episode] = result["results"]
        assert episode["outcome"] == "success"
        hashes.append(episode["final_state_hash"])
        one.process.terminate()
        assert one.process.wait(PATIENCE_S) == 0
    assert hashes[0] == hashes[1]
