"""A policy server that is killed in mid-evaluation costs no episode, and no episode that it missed is counted."""

import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest

from roboxim_core.errors import UnavailableError
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import EpisodeFinished, Notice
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.storage.folder import RunFolder

pytestmark = pytest.mark.slow
EPISODES, STEPS = 5, 25
PATIENT_S = 120.0


class Served:
    """``roboxim policy serve random`` as a process that can be killed and started again."""

    def __init__(self):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.process = None

    def start(self):
        command = [Path(sys.executable).parent / "roboxim", "policy", "serve", "random", "--wire", "openpi"]
        self.process = subprocess.Popen([*command, "--port", str(self.port)], stdout=subprocess.DEVNULL)

    def wait(self):
        for _ in range(600):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.port}/healthz").read()
                return
            except OSError:
                threading.Event().wait(0.1)
        raise AssertionError("the server did not start")

    def kill(self):
        if self.process is not None:
            os.kill(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self.process = None


@contextmanager
def serving():
    served = Served()
    served.start()
    served.wait()
    try:
        yield served
    finally:
        served.kill()


def config(out, served, **more):
    options = {"url": f"ws://127.0.0.1:{served.port}", "convention": "server", "version": "1", "reconnect_s": 0.5}
    spec = PolicySpec(spec="openpi", name="p", options=options)
    return EvaluationConfig(policies=[spec], out=out, episodes=EPISODES, max_steps=STEPS, size=32, workers=1, **more)


def facts(results):
    return [(result.index, result.outcome, result.steps, result.final_state_hash) for result in results]


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The episodes as they are in process."""
    out = tmp_path_factory.mktemp("here")
    spec = PolicySpec(spec="random", name="p")
    return facts(
        evaluate(
            EvaluationConfig(policies=[spec], out=out, episodes=EPISODES, max_steps=STEPS, size=32, workers=1)
        ).results
    )


class Fate:
    """Kills the server when the first episode has ended, and does something a moment later."""

    def __init__(self, served, later=lambda: None):
        self.served, self.later, self.told, self.killed = served, later, [], False

    def __call__(self, event):
        if isinstance(event, Notice):
            self.told.append(event.text)
        if isinstance(event, EpisodeFinished) and not self.killed:
            self.killed = True
            self.served.kill()
            threading.Timer(3.0, self.later).start()


def test_run_survives_a_killed_server_that_is_started_again(tmp_path, expected):
    with serving() as served:
        fate = Fate(served, served.start)
        result = evaluate(config(tmp_path / "out", served, server_wait_s=PATIENT_S), on_event=fate)
    assert facts(result.results) == expected
    assert result.first.measured
    assert [text.partition(":")[0] for text in fate.told] == [
        "waiting up to 120 s for the policy's server",
        "the policy's server is back; the run continues",
    ]


def test_run_stops_in_a_sentence_and_the_same_command_continues(tmp_path, expected):
    with serving() as served:
        with pytest.raises(UnavailableError, match=r"stayed away for 1 s .*start the server again, and the same com"):
            evaluate(config(tmp_path / "out", served, server_wait_s=1.0), on_event=Fate(served))
        there = RunFolder(tmp_path / "out" / "p").results()
        assert 1 <= len(there) < EPISODES
        assert not any(result.outcome == "error" for result in there)
        served.start()
        served.wait()
        result = evaluate(config(tmp_path / "out", served, server_wait_s=5.0))
    assert facts(result.results) == expected
