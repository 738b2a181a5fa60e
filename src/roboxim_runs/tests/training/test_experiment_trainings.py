"""Trainings side by side: tiny trainers that wait at gates (named pipes), which a test opens and closes."""

import json
import os
import select
import shlex
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments import Stage
from roboxim_runs.events import Interrupted, Notice, StageFinished, StageProgress, StageStarted, ignore
from roboxim_runs.executors import CancelledError, LocalExecutor, WorkerBrokenError
from roboxim_runs.training import commands as experiment_trainings
from roboxim_runs.training import worker as training_worker
from roboxim_runs.training.commands import started, train, train_on

TRAINER = """
import os, sys
from pathlib import Path
place, out, seed, steps = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4]
def note(what):
    with open(place / "journal", "a") as journal:
        print(what, seed, file=journal)
out.mkdir(exist_ok=True)
with open(os.environ["ROBOXIM_EVENTS"], "a") as events:
    print('{"event": "stage_started", "title": "reading", "total": 9}', file=events)
    print('{"event": "stage_started", "title": "training", "unit": "steps", "total": 7}', file=events)
    print('{"event": "stage_progress", "done": 5, "total": 7, "note": "of ' + seed + '"}', file=events)
try:
    note("begins")
    word = (place / f"gate{seed}").read_text()
    note("ends")
except KeyboardInterrupt:
    (out / "checkpoint").write_text("half")
    sys.exit(130)
if word == "fail":
    sys.exit("no space left on the device")
(out / "checkpoint").write_text("whole")
"""
CALL = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_experiment_trainings import Trainers
trainers = Trainers(Path(sys.argv[2]))
trainers.run(2, at_once=2)
"""


@dataclass
class Trainers:
    """A folder with trainings that wait at a gate each."""

    place: Path

    def run(self, number, *, at_once, steps=7, on_event=ignore, cancellation=None, executor=False):
        found = []
        (self.place / "out/export/mine.0").mkdir(parents=True, exist_ok=True)
        run = partial(train_on, LocalExecutor(at_once)) if executor else partial(train, at_once=at_once)
        command = shlex.join([sys.executable, "-S", str(self.place / "trainer.py"), str(self.place)])
        run(
            [
                Stage(
                    name=f"train/mine.{seed}", kind="train", needs=("export/mine.0",), sha="",
                    inputs={"command": f"{command} {{out}} {{seed}} {{steps}}", "seed": seed, "steps": steps,
                            "checkpoints": [], "until": ""},
                )
                for seed in range(number)
            ],
            self.place / "out", on_event=on_event, on_trained=found.append, cancellation=cancellation,
        )  # fmt: skip
        return found

    @contextmanager
    def begun(self, *arguments, **options):
        """Run trainings in another thread; yield what their result comes from."""
        with ThreadPoolExecutor(1) as pool:
            yield pool.submit(self.run, *arguments, **options)

    def gate(self, seed):
        """Wait until a training has begun; it goes on when the gate is closed."""
        return open(self.place / f"gate{seed}", "w")

    def checkpoint(self, seed):
        return (self.place / f"out/train/mine.{seed}/checkpoint").read_text()

    @property
    def most_at_once(self):
        running, most = set(), 0
        for line in (self.place / "journal").read_text().splitlines():
            what, seed = line.split()
            (running.add if what == "begins" else running.discard)(seed)
            most = max(most, len(running))
        return most


@pytest.fixture
def trainers(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "trainer.py").write_text(TRAINER)
    for seed in range(4):
        os.mkfifo(tmp_path / f"gate{seed}")
    return Trainers(tmp_path)


def test_so_many_trainings_run_at_once_and_never_more(trainers):
    with trainers.begun(4, at_once=2) as result:
        with trainers.gate(0), trainers.gate(1):  # both have begun, and none can end yet
            pass
        with trainers.gate(2), trainers.gate(3):
            pass
        found = result.result()
    assert trainers.most_at_once == 2
    assert sorted(one.stage.name for one in found) == [f"train/mine.{seed}" for seed in range(4)]
    assert all(1.0 <= one.at_once < 2.01 for one in found)
    assert max(one.at_once for one in found) > 1.5
    assert not any(one.continued for one in found)


def test_one_training_after_the_other(trainers):
    with trainers.begun(2, at_once=1) as result:
        for seed in range(2):
            trainers.gate(seed).close()
        found = result.result()
    assert [one.stage.name for one in found] == ["train/mine.0", "train/mine.1"]
    assert [one.at_once for one in found] == pytest.approx([1.0, 1.0])
    assert trainers.most_at_once == 1


def test_a_training_that_fails_ends_the_run_and_the_others_save_checkpoints(trainers):
    with trainers.begun(3, at_once=2) as result, trainers.gate(0):
        with trainers.gate(1) as gate:
            gate.write("fail")
        with pytest.raises(RoboximError) as caught:
            result.result()
    message = str(caught.value)
    assert message.startswith("train/mine.1: ")
    assert "ended with exit code 1" in message
    assert f"the end of {trainers.place}/out/train/mine.1.log:\nno space left on the device" in message
    assert "also interrupted: training mine.0" in message
    assert trainers.checkpoint(0) == "half"
    assert "begins 2" not in (trainers.place / "journal").read_text()


class CtrlC:
    """A cancellation that behaves as Ctrl-C in the thread that runs the trainings."""

    def __init__(self):
        self.pressed = threading.Event()

    def set(self):
        self.pressed.set()

    def is_set(self):
        if self.pressed.is_set():
            raise KeyboardInterrupt
        return False


@pytest.mark.parametrize(("request_", "error"), [(CtrlC, KeyboardInterrupt), (threading.Event, CancelledError)])
def test_an_interruption_ends_all_with_checkpoints_and_the_same_call_continues(trainers, request_, error):
    cancellation, events = request_(), []
    begun = trainers.begun(3, at_once=2, cancellation=cancellation, on_event=events.append)
    with begun as result, trainers.gate(0), trainers.gate(1):
        cancellation.set()
        with pytest.raises(error):
            result.result()
    assert [trainers.checkpoint(seed) for seed in range(2)] == ["half"] * 2
    (text,) = [event.text for event in events if isinstance(event, Interrupted)]
    assert "training mine.0" in text
    assert "training mine.1" in text
    assert "mine.2" not in text
    with trainers.begun(3, at_once=3) as result:
        with trainers.gate(0), trainers.gate(1), trainers.gate(2):
            pass
        continued = {one.stage.name: one.continued for one in result.result()}
    assert continued == {"train/mine.0": True, "train/mine.1": True, "train/mine.2": False}
    assert trainers.checkpoint(1) == "whole"


def test_trainings_of_a_background_job_save_checkpoints_too(trainers):
    """A shell starts its background jobs with SIGINT ignored, which their children inherit."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        cancellation = threading.Event()
        with trainers.begun(1, at_once=1, cancellation=cancellation) as result, trainers.gate(0):
            cancellation.set()
            with pytest.raises(CancelledError):
                result.result()
    finally:
        signal.signal(signal.SIGINT, before)
    assert trainers.checkpoint(0) == "half"


def test_trainings_die_with_a_killed_run_and_the_same_call_continues(trainers):
    call = subprocess.Popen([sys.executable, "-c", CALL, str(Path(__file__).parent), str(trainers.place)])
    try:
        with trainers.gate(0) as first, trainers.gate(1) as second:
            call.send_signal(signal.SIGKILL)
            call.wait()
            for gate in (first, second):
                poll = select.poll()
                poll.register(gate, 0)
                assert poll.poll(60_000), "the training did not end"
    finally:
        call.kill()
    with trainers.begun(2, at_once=2) as result:
        with trainers.gate(0), trainers.gate(1):
            pass
        assert [one.continued for one in result.result()] == [True, True]


def test_progress_names_the_training_and_says_its_steps(trainers, monkeypatch):
    monkeypatch.setattr(experiment_trainings, "REPORT_S", 0.0)
    events, told = [], threading.Event()

    def on_event(event):
        events.append(event)
        if len({one.name for one in events if isinstance(one, StageProgress) and one.done == 5}) == 2:
            told.set()

    with trainers.begun(2, at_once=2, on_event=on_event) as result:
        with trainers.gate(0), trainers.gate(1):
            assert told.wait(120)
        result.result()
    for seed in range(2):
        mine = [event for event in events if event.name == f"train/mine.{seed}"]
        assert mine[0] == StageStarted(
            title=f"training mine.{seed}", total=7, unit="steps", name=f"train/mine.{seed}"
        )  # fmt: skip
        assert StageProgress(done=5, total=7, note=f"of {seed}", name=f"train/mine.{seed}") in mine
        assert mine[-1] == StageFinished(name=f"train/mine.{seed}")
    assert list((trainers.place / "out/train").glob(".*")) == [], "the trainers' reports are removed"


def test_a_trainer_that_reports_nothing_is_shown_by_the_last_line_of_its_log(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment_trainings, "REPORT_S", 0.0)
    os.mkfifo(tmp_path / "gate")
    told = threading.Event()

    def on_event(event):
        if isinstance(event, StageProgress) and event.note == "epoch 2":
            told.set()

    stage = Stage(
        name="train/mine.0", kind="train", needs=("export/mine.0",), sha="",
        inputs={"command": f"sh -c 'printf \"epoch 1\\repoch 2\"; cat {tmp_path}/gate'", "seed": 0, "steps": 0,
                "checkpoints": [], "until": ""},
    )  # fmt: skip
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(train, [stage], tmp_path, at_once=1, on_event=on_event, on_trained=ignore)
        with open(tmp_path / "gate", "w"):
            assert told.wait(120)
        result.result()


def test_a_report_that_is_none_is_skipped(tmp_path):
    reports = experiment_trainings.TrainerReports(tmp_path / "events")
    assert reports.last() is None
    lines = ["no JSON", "[]", '{"event": 3}', '{"event": "stage_progress", "done": "many"}', '{"event": "notice"}']
    reports.path.write_text("\n".join([*lines, json.dumps({"event": "stage_progress", "done": 4}), '{"event": "sta']))
    assert reports.last().done == 4
    assert reports.last() is None, "the torn line is read when it is whole"


def test_the_trainer_roboxim_is_the_one_of_this_environment(tmp_path):
    with open(tmp_path / "log", "w") as log:
        assert started(["roboxim", "--help"], log).wait(300) == 0


def test_a_script_may_be_the_trainer_of_roboxim(tmp_path):
    words = ["sh", "-c", "roboxim --version; true"]  # the shell remains the parent of what it calls
    with (tmp_path / "log").open("wb") as log:
        assert started(words, log).wait(60) == 0
    assert (tmp_path / "log").read_text().startswith("roboxim")


def test_a_trainer_has_as_many_threads_as_outside_of_an_experiment(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    words = ["sh", "-c", "echo ${OMP_NUM_THREADS:-unset} $OPENBLAS_NUM_THREADS"]
    with (tmp_path / "log").open("wb") as log:
        assert started(words, log).wait(60) == 0
    assert (tmp_path / "log").read_text() == "unset 3\n"


# ------------------------------------------------------------------ trainings as jobs of an executor


@pytest.mark.thorough
def test_workers_of_an_executor_train(trainers):
    events = []
    with trainers.begun(3, at_once=2, executor=True, on_event=events.append) as result:
        with trainers.gate(0), trainers.gate(1):
            pass
        trainers.gate(2).close()
        found = result.result()
    assert trainers.most_at_once == 2
    assert [trainers.checkpoint(seed) for seed in range(3)] == ["whole"] * 3
    assert sorted(one.stage.name for one in found) == [f"train/mine.{seed}" for seed in range(3)]
    assert all(one.origin["device"] and not one.continued and 1.0 <= one.at_once < 2.01 for one in found)
    for seed in range(3):
        mine = [event for event in events if getattr(event, "name", "") == f"train/mine.{seed}"]
        assert isinstance(mine[0], StageStarted)
        assert isinstance(mine[-1], StageFinished)
    assert list((trainers.place / "out/train").glob(".*")) == []


@pytest.mark.thorough
def test_a_training_of_an_executor_that_fails_ends_the_run(trainers):
    with trainers.begun(3, at_once=2, executor=True) as result, trainers.gate(0):
        with trainers.gate(1) as gate:
            gate.write("fail")
        with pytest.raises(RoboximError, match="train/mine.1: .* exit code 1") as caught:
            result.result()
    assert "no space left on the device" in str(caught.value)
    assert trainers.checkpoint(0) == "half"
    assert "begins 2" not in (trainers.place / "journal").read_text()


@pytest.mark.thorough
def test_trainings_of_an_executor_are_cancelled_with_checkpoints(trainers):
    cancellation, events = threading.Event(), []
    begun = trainers.begun(2, at_once=2, executor=True, cancellation=cancellation, on_event=events.append)
    with begun as result, trainers.gate(0), trainers.gate(1):
        cancellation.set()
        with pytest.raises(CancelledError):
            result.result()
    assert [trainers.checkpoint(seed) for seed in range(2)] == ["half"] * 2
    (text,) = [event.text for event in events if isinstance(event, Interrupted)]
    assert "training mine.0" in text


@pytest.mark.thorough
def test_a_training_whose_worker_is_killed_goes_on_with_another_one(trainers, monkeypatch):
    events = []
    with trainers.begun(1, at_once=1, executor=True, on_event=events.append) as result:
        with trainers.gate(0) as gate:
            parent = int((trainers.place / "out/train/.mine.0.worker").read_text().split()[1])
            os.kill(parent, signal.SIGKILL)
            poll = select.poll()
            poll.register(gate, 0)
            assert poll.poll(60_000), "the training did not end with its worker"
        trainers.gate(0).close()
        (one,) = result.result()
    assert one.continued
    assert trainers.checkpoint(0) == "whole"
    assert any("died at train/mine.0" in event.text for event in events if isinstance(event, Notice))


def test_a_worker_that_was_given_up_ends_its_training(trainers, monkeypatch):
    """Another worker has written its name beside the folder, e.g. since this one's node was cut off. The training has
    ended when its worker has, even one that does not react to SIGINT, and so have the trainer's own children."""
    monkeypatch.setattr(training_worker, "LOOK_S", 0.0)
    monkeypatch.setattr(training_worker, "SAVE_S", 0.2)
    worker = training_worker.TrainingWorker({"out": str(trainers.place / "out")}, 0)
    (trainers.place / "out/export/mine.0").mkdir(parents=True)
    trainer = f"sh -c 'trap \"\" INT; cat {trainers.place}/gate0; true'"
    stage = {
        "name": "train/mine.0", "kind": "train", "needs": ["export/mine.0"], "sha": "",
        "inputs": {"command": trainer, "seed": 0, "steps": 0, "checkpoints": [], "until": ""},
    }  # fmt: skip
    name = trainers.place / "out/train/.mine.0.worker"
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(worker.run, stage, ignore)
        with trainers.gate(0) as gate:
            name.write_text("another one")
            with pytest.raises(WorkerBrokenError, match="another one has taken"):
                result.result()
            poll = select.poll()
            poll.register(gate, 0)
            assert poll.poll(60_000), "the trainer's child lives on"
    assert name.read_text() == "another one"


def test_a_machine_that_does_not_see_the_folder_is_named(tmp_path):
    stage = {"name": "train/mine.0", "kind": "train", "needs": ["export/mine.0"], "sha": "", "inputs": {}}
    with pytest.raises(ConfigError, match="does not see .*export/mine.0.*share"):
        training_worker.TrainingWorker({"out": str(tmp_path)}, 0).run(stage, ignore)
