"""Executors give the same results, survive dead workers, and end on cancellation."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from multiprocessing.connection import Pipe
from pathlib import Path

import pytest

from roboxim_core.errors import ConfigError, RoboximError, UnavailableError
from roboxim_runs.executors import (
    CancelledError,
    Done,
    InlineExecutor,
    Job,
    KeptProcesses,
    LocalExecutor,
    Lost,
    Work,
    worker_process,
)
from roboxim_runs.executors import kept as kept_module
from roboxim_runs.executors.pool import ClosingError
from roboxim_runs.executors.worker_process import WorkerProcess

WORKER = """
import os
import signal
import sys
import threading
import time
from pathlib import Path

from roboxim_runs.executors import WorkerBrokenError
from roboxim_core.errors import ConfigError


class Worker:
    def __init__(self, settings, number):
        self.settings, self.number = settings, number
        if settings.get("refuse"):
            raise ConfigError("no such setting")
        if settings.get("vanish"):
            print("last words", flush=True)
            os._exit(7)

    def run(self, job, note):
        note({"started": job})
        if job == "wrong":
            raise ConfigError("wrong job")
        if job == "bug":
            return 1 // 0
        if job == "hang":
            threading.Event().wait()
        while job == "chatter":  # never silent
            note({"started": job})
        if job == "broken" or (job == "broken once" and self.first()):
            raise WorkerBrokenError("out of order")
        if job == "kill" or (job == "kill once" and self.first()):
            print("last words", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        if job == "say":
            print("said", flush=True)
            return {"pid": os.getpid(), "variable": os.environ.get("THING"), "path": sys.path}
        return {"job": job, "pi": 3.141592653589793, "variable": os.environ.get("THING")}

    def first(self):
        mark = Path(self.settings["folder"]) / "mark"
        there = mark.exists()
        mark.touch()
        return not there

    def close(self):
        time.sleep(self.settings.get("close_s", 0.0))
        Path(self.settings["folder"], f"closed-{self.number}").touch()
"""


@pytest.fixture
def work(tmp_path):
    (tmp_path / "my_worker.py").write_text(WORKER)

    def make(**settings):
        return Work(
            worker="my_worker:Worker", settings={"folder": str(tmp_path), **settings}, environment={"THING": "x"},
            python_path=(str(tmp_path),),
        )  # fmt: skip

    yield make
    sys.modules.pop("my_worker", None)
    if str(tmp_path) in sys.path:
        sys.path.remove(str(tmp_path))


def jobs(*data):
    return [Job(key=f"job {number}", data=value) for number, value in enumerate(data)]


def test_every_executor_gives_the_same_results(work, tmp_path):
    wanted = jobs(1, "two", [3.5, None], {"four": True})
    found = []
    for executor in (InlineExecutor(), LocalExecutor(1), LocalExecutor(3)):
        results = {outcome.key: outcome.value for outcome in executor.run(work(), wanted)}
        assert [results[job.key]["job"] for job in wanted] == [job.data for job in wanted]
        found.append([{**results[job.key], "variable": None} for job in wanted])
        assert list(tmp_path.glob("closed-*")), "workers are closed"
    assert found[0] == found[1] == found[2]


def test_kept_processes_serve_one_work_after_the_other(work, tmp_path):
    """Each with its settings, environment, modules and log; a work that may leave something gets its own process."""
    first, second = work(), work()
    first = replace(first, python_path=(*first.python_path, "/of/the/first"))
    second.environment["OTHER"] = second.environment.pop("THING")
    with KeptProcesses() as kept:
        said = []
        for number, given in enumerate((first, second, first)):
            executor = LocalExecutor(1, log_dir=tmp_path / f"logs-{number}", kept=kept)
            said += [done.value for done in executor.run(replace(given, leaves_nothing=number < 2), jobs("say"))]
        [(process, _)] = kept._idle
        assert kept.pids() == [process.pid]
    assert said[0]["pid"] == said[1]["pid"] != said[2]["pid"]
    assert [one["variable"] for one in said] == ["x", None, "x"], "a work has its own environment alone"
    assert ["/of/the/first" in one["path"] for one in said] == [True, False, True]
    assert [(tmp_path / f"logs-{i}/worker-0.log").read_text().count("said") for i in range(3)] == [1, 1, 1]
    assert process.poll() is not None, "it ends with its keeper"


def test_a_kept_process_that_died_or_was_busy_is_not_used_again(work, tmp_path):
    given = replace(work(), leaves_nothing=True)
    with KeptProcesses() as kept:
        [first] = LocalExecutor(1, kept=kept).run(given, jobs("say"))
        os.kill(first.value["pid"], signal.SIGKILL)
        [second] = LocalExecutor(1, kept=kept).run(given, jobs("say"))
        assert second.value["pid"] != first.value["pid"]
        with pytest.raises(ConfigError, match="wrong job"):
            list(LocalExecutor(1, kept=kept).run(given, jobs("wrong")))
        assert kept.take() is None


def test_a_kept_process_that_ends_when_it_is_needed_is_replaced(work):
    """It ends by itself, which is no fault of the work that it gets."""
    ours, theirs = Pipe()
    code = f"import os, multiprocessing.connection as c; c.Connection({theirs.fileno()}).recv_bytes(); os._exit(3)"
    process = subprocess.Popen([sys.executable, "-c", code], pass_fds=[theirs.fileno()])
    theirs.close()
    with KeptProcesses() as kept:
        kept.give(process, ours)
        [done] = LocalExecutor(1, kept=kept).run(replace(work(), leaves_nothing=True), jobs("say"))
    assert process.returncode == 3
    assert done.value["pid"] != process.pid


def test_a_kept_process_ends_after_a_number_of_works(work, monkeypatch):
    monkeypatch.setattr(kept_module, "MAX_WORKS", 2)
    given = replace(work(), leaves_nothing=True)
    with KeptProcesses() as kept:
        pids = [done.value["pid"] for _ in range(3) for done in LocalExecutor(1, kept=kept).run(given, jobs("say"))]
    assert pids[0] == pids[1] != pids[2]


def test_a_cancelled_run_leaves_no_kept_process_at_work(work):
    given, stop = replace(work(), leaves_nothing=True), threading.Event()
    with KeptProcesses() as kept:
        executor = LocalExecutor(2, kept=kept)
        with pytest.raises(CancelledError):
            list(executor.run(given, jobs("hang", "hang"), on_note=lambda _: stop.set(), cancellation=stop))
        resting = {process.pid for process, _ in kept._idle}  # a worker that had no job yet when the run was cancelled
        assert set(kept.pids()) == resting
        assert len(resting) < 2


@pytest.mark.parametrize("fault", ["kill once", "broken once"])
def test_a_job_whose_worker_died_is_repeated_by_a_fresh_one(work, tmp_path, fault):
    notes, retried = [], []
    executor = LocalExecutor(1, log_dir=tmp_path / "logs")
    outcomes = list(
        executor.run(work(), jobs(fault, "next"), on_note=lambda n: notes.append(n.text), before_retry=retried.append)
    )
    assert [outcome.value["job"] for outcome in outcomes] == [fault, "next"]
    assert retried == ["job 0"]
    [told] = [note for note in notes if note]
    assert "worker 0 died at job 0" in told
    assert ("SIGKILL" in told and "last words" in told) or "out of order" in told
    assert len(list((tmp_path / "logs").iterdir())) == 2


def test_a_job_that_costs_all_its_workers_is_lost_and_the_others_are_done(work):
    outcomes = {outcome.key: outcome for outcome in LocalExecutor(2).run(work(), jobs("kill", 1, 2))}
    assert isinstance(outcomes["job 0"], Lost)
    assert "3 workers died at it" in outcomes["job 0"].message
    assert {type(outcomes[f"job {i}"]) for i in (1, 2)} == {Done}


@pytest.mark.parametrize("make", [InlineExecutor, LocalExecutor])
def test_a_fault_that_a_new_worker_repeats_ends_the_run(work, make):
    with pytest.raises(ConfigError, match="wrong job"):
        list(make().run(work(), jobs("wrong", 1)))
    with pytest.raises(ConfigError, match="no such setting"):
        list(make().run(work(refuse=True), jobs(1)))
    with pytest.raises((RoboximError, ZeroDivisionError), match="division"):
        list(make().run(work(), jobs("bug")))


def test_a_worker_that_cannot_start_shows_its_log(work):
    with pytest.raises(UnavailableError, match=r"(?s)could not start: exit code 7; .*last words"):
        list(LocalExecutor(1).run(work(vanish=True), jobs(1)))


def test_a_worker_that_hangs_counts_as_dead(work):
    [outcome] = LocalExecutor(1, stall_s=0.2).run(work(), jobs("hang"))  # a start takes longer, and is no silence
    assert "no message from it for 0.2 s" in outcome.message


def test_the_end_of_a_worker_is_not_interrupted(work, tmp_path, monkeypatch):
    monkeypatch.setattr(worker_process, "EXIT_S", 600.0)  # a busy machine may need long to end a process
    list(LocalExecutor(1).run(work(close_s=0.5), jobs(1)))  # of two workers, a slow one may never start
    assert [path.name for path in tmp_path.glob("closed-*")] == ["closed-0"]


def test_a_cancelled_run_ends_its_workers(work):
    stop = threading.Event()
    executor, pids = LocalExecutor(2), []

    def note(_):
        pids.extend(executor.pids())
        stop.set()

    with pytest.raises(CancelledError):
        list(executor.run(work(), jobs("hang", "hang"), on_note=note, cancellation=stop))
    assert pids
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    with pytest.raises(CancelledError):
        list(InlineExecutor().run(work(), jobs(1), cancellation=stop))


def test_a_worker_that_is_never_silent_ends_with_its_run(work, tmp_path):
    closing, notes = threading.Event(), []

    def note(data):
        notes.append(data)
        closing.set()

    process = WorkerProcess(work(), 0, closing, log_dir=tmp_path)
    try:
        process.start()
        with pytest.raises(ClosingError):
            process.run("chatter", note)
    finally:
        process.end()
    assert len(notes) == 1


def test_every_executor_refuses_data_that_is_not_plain(work):
    for executor in (InlineExecutor(), LocalExecutor(1)):
        with pytest.raises(TypeError, match="not JSON serializable"):
            list(executor.run(work(), jobs(Path("x"))))


def test_a_script_needs_no_guard_of_its_main_module(work, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from roboxim_runs.executors import Job, LocalExecutor, Work\n"
        f"work = Work(worker='my_worker:Worker', settings={{'folder': {str(tmp_path)!r}}}, "
        f"python_path=({str(tmp_path)!r},))\n"
        "for outcome in LocalExecutor(2).run(work, [Job(key=str(i), data=i) for i in range(2)]):\n"
        "    print(outcome.value['job'])\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=os.environ, timeout=100)
    assert sorted(done.stdout.split()) == ["0", "1"], done.stderr
