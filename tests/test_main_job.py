"""Generation through the command line gives the same bags when it is killed, interrupted and resumed."""

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.run_bags import list_bags
from roboxim_ros.testing import PATIENCE_S
from roboxim_runs.storage.folder import RunFolder

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(3600)]
EPISODES = 6


def roboxim(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "roboxim_cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def generate(out, workers):
    return roboxim("generate", "--episodes", EPISODES, "--workers", workers, "--size", 64, "--seed", 5, "--out", out)


def worker_pids(parent):
    children = Path(f"/proc/{parent}/task").glob("*/children")
    pids = [int(pid) for path in children for pid in path.read_text().split()]
    return [pid for pid in pids if b"roboxim_runs.executors.worker" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def wait_for_results(out, count, process):
    path = out / "results.jsonl"
    waiting = threading.Event()
    while process.poll() is None and not (path.exists() and len(path.read_text().splitlines()) >= count):
        waiting.wait(0.1)


def bags(out):
    """The bytes of every file of every bag."""
    return {path.relative_to(out): path.read_bytes() for bag in list_bags(out) for path in bag.iterdir()}


def test_killed_interrupted_and_resumed_runs_give_the_same_bags(tmp_path):
    plain = generate(tmp_path / "plain", workers=1)
    assert plain.wait(3 * PATIENCE_S) == 0, plain.stdout.read()

    for attempt in range(5):  # on a busy machine a run may end before it is interrupted
        out = tmp_path / f"rough{attempt}"
        rough = generate(out, workers=2)
        wait_for_results(out, 1, rough)
        for pid in worker_pids(rough.pid)[:1]:
            os.kill(pid, signal.SIGKILL)
        wait_for_results(out, 3, rough)
        workers = worker_pids(rough.pid)
        rough.send_signal(signal.SIGINT)
        if rough.wait(PATIENCE_S) == 130:
            break
    assert rough.returncode == 130
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers), "no orphan is left"
    done = len(RunFolder(out).results())
    assert 3 <= done < EPISODES

    resumed = generate(out, workers=2)
    text, _ = resumed.communicate(timeout=3 * PATIENCE_S)
    assert resumed.returncode == 0, text
    assert f"{EPISODES} demonstrations" in text
    assert all(check_bag(bag).ok for bag in list_bags(out))
    assert not list((out / ".partial").glob("*"))
    expected = bags(tmp_path / "plain")
    assert len(expected) == 2 * EPISODES
    found = bags(out)
    assert sorted(found) == sorted(expected)
    assert [name for name, content in found.items() if content != expected[name]] == []


def test_smoke_run_of_the_demo_creates_the_files_that_it_names(tmp_path):
    process = roboxim("demo", "--smoke", "--out", tmp_path / "demo")
    text, _ = process.communicate(timeout=10 * PATIENCE_S)
    assert process.returncode == 0, text
    named = re.findall(r"^  (/\S+): ", text, re.MULTILINE)
    assert len(named) == 8
    assert all(Path(path).exists() for path in named)
    assert np.fromfile(named[0], np.uint8).size > 10_000
