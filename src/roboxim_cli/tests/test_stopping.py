"""Commands that are stopped, or that end others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from roboxim_cli import detach
from roboxim_cli.main import group
from roboxim_core.errors import ConfigError
from roboxim_ros import runs

STEP = """
import sys, time
try:
    print("begun", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(1)  # a checkpoint is written
    open(sys.argv[-1], "w").write("saved")
"""
DEMO = """
import sys
from roboxim_cli.commands.stages import demo
sys.executable = sys.argv[1]
demo._step(sys.argv[2])
"""


def test_a_stopped_demo_lets_its_step_save(tmp_path):
    """The step is a program in place of `python -m roboxim_cli`; Ctrl-C reaches the group of both."""
    step, saved = tmp_path / "step", tmp_path / "saved"
    step.write_text(f"#!{sys.executable}\n{STEP}")
    step.chmod(0o755)
    process = subprocess.Popen(
        [sys.executable, "-c", DEMO, str(step), str(saved)],
        start_new_session=True,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # the tests may run in the background
    )
    assert process.stdout is not None
    while "begun" not in process.stdout.readline():
        assert process.poll() is None
    time.sleep(0.5)  # the demo waits for it now
    os.killpg(process.pid, signal.SIGINT)
    process.wait(60)
    assert saved.read_text() == "saved"


def test_down_goes_on_after_a_run_that_has_ended_meanwhile(monkeypatch):
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])

    class Run:
        id = "second"

        @property
        def live_pids(self):
            return (sleeper.pid,) if sleeper.poll() is None else ()

    gone = SimpleNamespace(id="first", live_pids=())
    monkeypatch.setattr(runs, "live_runs", lambda: [gone, Run()])
    said = CliRunner().invoke(group, ["down", "--all"], catch_exceptions=False).output
    assert said == "ended run second\n"
    assert sleeper.wait(10) == -signal.SIGTERM


def test_down_does_not_end_all_runs_when_one_is_named(monkeypatch):
    monkeypatch.setattr(runs, "live_runs", lambda: pytest.fail("looked for every run"))
    said = CliRunner().invoke(group, ["down", "--run", "mine", "--all"])
    assert "--all ends every run, not 'mine' alone" in f"{said.exception} {said.output}"


def test_the_log_of_a_live_run_is_not_erased(monkeypatch, tmp_path):
    monkeypatch.setattr(runs, "live_runs", lambda: [SimpleNamespace(id="bench")])
    with pytest.raises(ConfigError, match="a run named 'bench' is alive already"):
        detach.start_detached("bench")


def test_a_recording_without_a_run_leaves_nothing(tmp_path):
    result = CliRunner().invoke(group, ["bag", "record", "--out", str(tmp_path / "bag"), "--run", "none-such"])
    assert "none-such" in str(result.exception) + result.output
    assert not (tmp_path / "bag").exists()
