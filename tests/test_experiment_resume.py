"""An experiment that is killed in the midst of each stage ends with the same card; a changed input is refused by name.

The experiment is the smallest one that has every kind of stage: one condition, whose dataset has a planted fault and
whose training has a checkpoint. One worker, since a second one would only start a second graph after each kill.
"""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]  # a busy machine is slow; waits are limited by LONGEST_S

TEXT = """
about: Does a policy reach for an object that it never saw?
factors: {{task: [pick_up], target: [cube, soda_can]}}
unseen: [{{target: cube}}]
set: {{distractors: {{minimum: 0, maximum: 0}}}}
datasets:
  leave_out: {{cells: seen, per_cell: 3, fault: rotation_jump, share: 0.25}}
conditions:
  leave_out: {{train: leave_out}}
trainers:
  bc:
    command: "roboxim train bc {{dataset}} --out {{out}} --seed {{seed}} --steps {{steps}}"
    until: "--until {{until}}"
    policy: bc
    steps: {steps}
evaluate: {{per_cell: 2, max_steps: 8}}
curve: {{every: 10, per_checkpoint: 1}}
replicates: {{count: 1}}
compare: [{{first: leave_out, second: leave_out, where: unseen, against: seen, primary: true}}]
image_size: 64x64
"""
ROBOXIM = (str(Path(sys.executable).with_name("roboxim")),)
KILLS_ITSELF = """
import os, signal, sys
from roboxim_cli.main import main
from roboxim_cli.printer import EventPrinter
from roboxim_runs.events import StageProgress, StageStarted

title, stage, show = sys.argv.pop(1), [], EventPrinter.__call__

def killed(printer, event):
    if isinstance(event, StageStarted):
        stage[:] = [event.title]
    if isinstance(event, StageProgress) and stage and stage[0].startswith(title):
        os.kill(os.getpid(), signal.SIGKILL)
    show(printer, event)

EventPrinter.__call__ = killed
sys.argv[0] = "roboxim"
main()
"""
"""The command ``roboxim``, killed at the first progress of a stage whose title begins with its first argument."""
TITLES = {"corrupt": "planting", "export": "exporting", "prove": "proving"}
"""Kinds of stages that are over too soon to be killed from outside, to how the title of their progress begins."""
LONGEST_S = 1800.0
"""Longest wait for a stage to begin [s]; a busy machine is slow."""


def start(file, out, log, *, program=ROBOXIM):
    command = [*program, "experiment", "run", str(file), "--out", str(out), "--workers", "1"]
    return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, process_group=0)


def finish(file, out, log):
    assert start(file, out, log).wait(LONGEST_S) == 0, Path(log.name).read_text()[-3000:]
    return json.loads((out / "card.json").read_text())


def kill_when(file, out, log, begun):
    """Start the experiment, and kill it with all its children's guardian when a stage has begun."""
    process = start(file, out, log)
    deadline = time.monotonic() + LONGEST_S
    while not begun():
        assert process.poll() is None or begun(), f"it ended early: {Path(log.name).read_text()[-3000:]}"
        assert time.monotonic() < deadline, "the stage did not begin"
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()


def kill_itself(file, out, log, title):
    """Run the experiment until a stage whose title begins so has done something."""
    process = start(file, out, log, program=(sys.executable, "-c", KILLS_ITSELF, title))
    assert process.wait(LONGEST_S) == -signal.SIGKILL, Path(log.name).read_text()[-3000:]


def finished(out):
    log = out / "stages.jsonl"
    return [json.loads(line)["stage"] for line in log.read_text().splitlines()] if log.exists() else []


def in_the_midst(out, stage):
    """Return whether a stage has begun: an episode is there but not all, or the first checkpoint."""
    if stage.startswith("train/"):
        return (out / f"{stage}@10").exists()
    return any(log.stat().st_size for log in (out / stage).rglob("results.jsonl"))


def test_a_run_that_is_killed_in_each_stage_ends_with_the_same_card(tmp_path):
    file, out = tmp_path / "mine.yaml", tmp_path / "out"
    file.write_text(TEXT.format(steps=20))
    with open(tmp_path / "log", "a") as log:
        whole = finish(file, tmp_path / "whole", log)
        stages = finished(tmp_path / "whole")
        assert {stage.split("/")[0] for stage in stages} == {
            "generate", "corrupt", "export", "prove", "train", "evaluate",
        }  # fmt: skip
        cut = []
        for stage in stages:
            if stage in finished(out):
                continue  # it was quicker than the kill
            kind = stage.partition("/")[0]
            if kind in TITLES:
                kill_itself(file, out, log, TITLES[kind])
            else:
                kill_when(file, out, log, lambda stage=stage: in_the_midst(out, stage))
            cut += [stage] if stage not in finished(out) else []
        assert {stage.split("/")[0] for stage in cut} == {*TITLES, "generate", "train", "evaluate"}, "as they ran"
        killed = finish(file, out, log)
        assert finished(out) == stages, "each stage is finished once"
        assert killed["sha256"] == whole["sha256"]
        file.write_text(TEXT.format(steps=30))
        assert start(file, out, log).wait(LONGEST_S) != 0
    text = (tmp_path / "log").read_text()
    assert "stage 'train/leave_out.0' was finished with other inputs" in text
    assert "steps" in text
