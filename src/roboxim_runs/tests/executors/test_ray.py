"""Jobs on a Ray cluster: the same results, whatever is lost; `make scale` installs Ray."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from click.testing import CliRunner
from planted_runs import add_ray_node, ray_cluster

from roboxim_bringup.graph import PolicyLaunch
from roboxim_cli.main import group
from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, RoboximError, UnavailableError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_policies.served import ServedPolicy
from roboxim_runs.executors import CancelledError, Done, Job, LocalExecutor, Lost, Work
from roboxim_runs.executors.ray_cluster import RayExecutor
from roboxim_runs.policies.server_worker import POLICY_KEY
from roboxim_runs.policies.servers import PolicyServers

WORKER = """
import os
import time
from pathlib import Path

from roboxim_runs.executors import WorkerBrokenError
from roboxim_core.errors import ConfigError


class Worker:
    def __init__(self, settings, number):
        self.folder = Path(settings["folder"])
        (self.folder / f"pid-{os.getpid()}").touch()

    def run(self, job, note):
        note({"started": job, "pid": os.getpid(), "actor": os.getppid()})
        if job == "wrong":
            raise ConfigError("wrong job")
        if job == "broken":
            raise WorkerBrokenError("out of order")
        if str(job).startswith("until"):
            while not (self.folder / "go on").exists():
                note({"waiting": job})
                time.sleep(0.05)
        shown = {name: os.environ.get(name) for name in ("THING", "LEAK", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
        return {"job": job, "domain": os.environ["ROS_DOMAIN_ID"], **shown}

    def close(self):
        pass
"""
OPTIONAL = ("ray", "fsspec", "s3fs")


@pytest.fixture
def work(tmp_path):
    (tmp_path / "my_worker.py").write_text(WORKER)
    return Work(
        worker="my_worker:Worker", settings={"folder": str(tmp_path)}, python_path=(str(tmp_path),),
        environment={"THING": "x", "ROS_DOMAIN_ID": "99999"},
    )  # fmt: skip


class StandIn:
    """What `RayExecutor` uses of Ray, with actors that are threads of this process."""

    def __init__(self):
        self.exceptions = SimpleNamespace(RayError=RayError, RayActorError=RayActorError)
        self.util = SimpleNamespace(get_node_ip_address=lambda: "127.0.0.1")
        self.address, self.actors, self.pool = "stand-in", [], ThreadPoolExecutor(32)

    def is_initialized(self):
        return True

    def cluster_resources(self):
        return {"CPU": 2.0}

    def remote(self, cls):
        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=lambda *words: self.made(cls(*words))))

    def made(self, actor):
        self.actors.append(actor)
        handle = SimpleNamespace(dead=False)
        for name in ("facts", "begin", "poll", "close"):
            setattr(handle, name, SimpleNamespace(remote=partial(self.called, handle, getattr(actor, name))))
        return handle

    def called(self, handle, method, *words):
        words = json.loads(json.dumps(words))
        return self.pool.submit(lambda: json.loads(json.dumps(method(*words))))

    def wait(self, references, timeout):
        done, left = wait(references, timeout)
        return list(done), list(left)

    def get(self, reference):
        return reference.result()

    def kill(self, handle):
        handle.dead = True


class RayError(Exception):
    pass


class RayActorError(RayError):
    pass


@pytest.fixture(scope="module")
def real_cluster():
    """Two nodes on this machine, each with one CPU."""
    pytest.importorskip("ray")
    cluster = ray_cluster()
    yield cluster
    cluster.shutdown()


@pytest.fixture(params=["stand-in", pytest.param("Ray", marks=pytest.mark.slow)])
def cluster(request, monkeypatch):
    if request.param == "Ray":
        return request.getfixturevalue("real_cluster")
    standing_in = StandIn()
    monkeypatch.setitem(sys.modules, "ray", standing_in)
    return standing_in


def jobs(*data):
    return [Job(key=f"job {number}", data=value) for number, value in enumerate(data)]


def results(outcomes):
    return {outcome.key: outcome.value["job"] for outcome in outcomes}


def gone(pid):
    """Wait until a process has ended; return False if it still runs after a minute."""
    waiting = threading.Event()
    for _ in range(600):
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        waiting.wait(0.1)
    return False


def test_without_the_extra_the_user_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"needs Ray, which is not installed; .*pip install 'roboxim\[ray\]'"):
        CliRunner().invoke(
            group, ["generate", "--executor", "ray", "--out", "x"], standalone_mode=False, catch_exceptions=False
        )
    with pytest.raises(ConfigError, match="--address and --resources are for --executor ray"):
        CliRunner().invoke(
            group, ["generate", "--address", "auto", "--out", "x"], standalone_mode=False, catch_exceptions=False
        )


def test_a_cluster_gives_the_results_of_this_machine(cluster, work, monkeypatch, tmp_path):
    monkeypatch.setenv("LEAK", "must not reach the worker")
    wanted, notes = jobs(1, "two", [3.5, None], {"four": True}), []
    outcomes = list(RayExecutor(2, address=cluster.address).run(work, wanted, on_note=notes.append))
    local = Work(**{**vars(work), "environment": {"ROS_DOMAIN_ID": "1"}})
    assert results(outcomes) == results(LocalExecutor(2).run(local, wanted))
    values = [outcome.value for outcome in outcomes]
    assert {(value["THING"], value["LEAK"], value["ROS_AUTOMATIC_DISCOVERY_RANGE"]) for value in values} == {
        ("x", None, "SUBNET")
    }
    domains = {value["domain"] for value in values}
    assert domains <= {str(number) for number in range(1, 233)}, "each worker reserves a domain of its own"
    assert sorted(note.key for note in notes if "started" in (note.data or {})) == [job.key for job in wanted]
    assert all(gone(int(path.name.removeprefix("pid-"))) for path in tmp_path.glob("pid-*")), "nothing is left behind"


@pytest.mark.parametrize("victim", ["worker", "actor"])
def test_the_job_of_a_killed_worker_or_actor_is_repeated(cluster, work, tmp_path, victim):
    if victim == "actor" and isinstance(cluster, StandIn):
        pytest.skip("the stand-in's actors are threads")
    notes, retried = [], []

    def kill(note):
        if note.data and "started" in note.data and not retried and not (tmp_path / "go on").exists():
            os.kill(note.data["pid" if victim == "worker" else "actor"], signal.SIGKILL)
            (tmp_path / "go on").touch()
        if note.text:
            notes.append(note.text)

    executor = RayExecutor(1, address=cluster.address)
    outcomes = list(executor.run(work, jobs("until", "next"), on_note=kill, before_retry=retried.append))
    assert results(outcomes) == {"job 0": "until", "job 1": "next"}
    assert retried == ["job 0"]
    assert "worker 0 died at job 0" in notes[0]


@pytest.mark.slow
def test_the_jobs_of_a_lost_node_are_repeated_on_the_others(real_cluster, work, tmp_path):
    cluster = real_cluster
    node = add_ray_node(cluster, resources={"doomed": 1})
    lost, pids = [], []

    def lose(note):
        if note.data and "started" in note.data and len(pids) < 1:
            pids.append(note.data["pid"])
            cluster.remove_node(node, allow_graceful=False)
        if note.text:
            lost.append(note.text)
            (tmp_path / "go on").touch()  # not before: a worker may outlive its node for a moment
            add_ray_node(cluster, resources={"doomed": 1})  # the node comes back

    doomed = RayExecutor(1, address=cluster.address, resources={"CPU": 1, "doomed": 1})
    place = doomed.run(work, jobs("until"), on_note=lose)
    assert results(place) == {"job 0": "until"}
    assert "worker 0 died at job 0" in lost[0]
    assert gone(pids[0])


def test_faults_cancellation_and_lost_jobs_are_as_on_this_machine(cluster, work, tmp_path):
    executor = RayExecutor(2, address=cluster.address)
    with pytest.raises(ConfigError, match="wrong job"):
        list(executor.run(work, jobs("wrong", 1)))
    outcomes = {outcome.key: outcome for outcome in executor.run(work, jobs("broken", 1))}
    assert isinstance(outcomes["job 0"], Lost)
    assert "3 workers died at it" in outcomes["job 0"].message
    assert isinstance(outcomes["job 1"], Done)
    stop = threading.Event()
    with pytest.raises(CancelledError):
        list(executor.run(work, jobs("until"), on_note=lambda _: stop.set(), cancellation=stop))
    with pytest.raises(RoboximError, match="unknown"):
        list(executor.run(Work(**{**vars(work), "worker": "unknown_module:Worker"}), jobs(1)))
    assert all(gone(int(path.name.removeprefix("pid-"))) for path in tmp_path.glob("pid-*"))


def served(servers, work, *, before):
    """Return a worker's work and its policy's options when there is another server than before."""
    waiting = threading.Event()
    while True:
        made = servers.prepared(work, 0, waiting)
        options = made.settings["graph"]["policies"][0]["options"]
        if options["url"] != before:
            return made, options
        waiting.wait(0.1)


@pytest.mark.thorough
def test_a_policy_server_on_a_cluster_serves_and_is_started_again_when_it_dies(cluster, monkeypatch):
    launch, url = PolicyLaunch(spec="random"), ""
    settings = {"graph": {"policies": [to_plain(launch)]}, "config": {"policy_timeout_s": 60.0}}
    work = Work(worker="unused:Unused", settings=settings)
    window = ObservationWindow(
        instruction="", observations=[Observation(seq=0, stamp_ns=0)], pad_mask=(True,), episode_id="e", seq=0
    )
    executor = RayExecutor(1, address=cluster.address, resources={"CPU": 0.0})
    with PolicyServers("mine", launch, [executor]) as servers:
        for _ in range(2):
            made, options = served(servers, work, before=url)
            monkeypatch.setenv(POLICY_KEY, made.environment[POLICY_KEY])
            policy = ServedPolicy(**options)
            policy.reset(EpisodeStart(episode_id="e", instruction="", seed=1))
            assert policy.act(window).actions.shape == (1, 7)
            policy.close()
            url = options["url"]
            listening = [c for c in psutil.net_connections("tcp") if c.status == psutil.CONN_LISTEN]
            [pid] = {c.pid for c in listening if c.laddr.port == int(url.rpartition(":")[2])}
            os.kill(pid, signal.SIGKILL)
    assert gone(pid)


@pytest.mark.slow
def test_an_address_without_a_cluster_is_named():
    pytest.importorskip("ray")
    with pytest.raises(UnavailableError, match="no connection to the Ray cluster at '127.0.0.1:1'"):
        list(RayExecutor(1, address="127.0.0.1:1").run(Work(worker="x:y"), jobs(1)))
