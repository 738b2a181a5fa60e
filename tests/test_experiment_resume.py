"""An experiment that is killed in each of its stages ends with the same card; a changed input is refused by name."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TEXT = """
about: Does a policy combine a skill and an object that it never saw together?
factors: {{task: [pick_up], target: [cube, soda_can]}}
unseen: [{{target: cube}}]
set: {{distractors: {{minimum: 0, maximum: 0}}}}
datasets:
  leave_out: {{cells: seen, per_cell: 2}}
  baseline: {{cells: all, per_cell: 2, fault: rotation_jump, share: 0.25}}
conditions:
  leave_out: {{train: leave_out}}
  baseline: {{train: baseline}}
trainers:
  bc:
    command: "roboxim train bc {{dataset}} --out {{out}} --seed {{seed}} --steps {{steps}}"
    until: "--until {{until}}"
    policy: bc
    steps: {steps}
evaluate: {{per_cell: 2, max_steps: 12}}
curve: {{every: 10, per_checkpoint: 1}}
replicates: {{count: 1}}
compare: [{{first: leave_out, second: baseline, where: unseen, primary: true}}]
image_size: 64x64
"""
LONGEST_S = 900.0
"""Longest wait for a stage to begin [s]."""


def start(file, out, log):
    command = [str(Path(sys.executable).with_name("roboxim")), "experiment", "run", str(file), "--out", str(out)]
    return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, process_group=0)


def finish(file, out, log):
    assert start(file, out, log).wait(LONGEST_S) == 0, Path(log.name).read_text()[-3000:]
    return json.loads((out / "card.json").read_text())


def kill_when(file, out, log, begun):
    """Start the experiment, and kill it with all its children's guardian when a stage has begun."""
    process = start(file, out, log)
    deadline = time.monotonic() + LONGEST_S
    while not begun():
        assert process.poll() is None, f"it ended early: {Path(log.name).read_text()[-3000:]}"
        assert time.monotonic() < deadline, "the stage did not begin"
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()


def finished(out):
    log = out / "stages.jsonl"
    return [json.loads(line)["stage"] for line in log.read_text().splitlines()] if log.exists() else []


def test_a_run_that_is_killed_in_each_stage_ends_with_the_same_card(tmp_path):
    file, out = tmp_path / "mine.yaml", tmp_path / "out"
    file.write_text(TEXT.format(steps=20))
    with open(tmp_path / "log", "a") as log:
        whole = finish(file, tmp_path / "whole", log)
        stages = finished(tmp_path / "whole")
        assert {stage.split("/")[0] for stage in stages} == {
            "generate", "corrupt", "export", "prove", "train", "evaluate",
        }  # fmt: skip
        for stage in stages:
            folder = out / stage
            if stage in finished(out):
                continue  # it was quicker than the kill
            kill_when(file, out, log, lambda folder=folder: folder.exists() and any(os.scandir(folder)))
        killed = finish(file, out, log)
    assert finished(out) == stages, "each stage is finished once"
    assert killed["sha256"] == whole["sha256"]


def test_a_changed_file_is_refused_by_the_stage_that_it_changes(tmp_path):
    file, out = tmp_path / "mine.yaml", tmp_path / "out"
    file.write_text(TEXT.format(steps=20))
    with open(tmp_path / "log", "a") as log:
        kill_when(file, out, log, lambda: any(stage.startswith("train/") for stage in finished(out)))
        file.write_text(TEXT.format(steps=30))
        assert start(file, out, log).wait(LONGEST_S) != 0
    text = (tmp_path / "log").read_text()
    assert "stage 'train/leave_out.0' was finished with other inputs" in text
    assert "steps" in text
