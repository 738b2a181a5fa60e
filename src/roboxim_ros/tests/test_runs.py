from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from roboxim_core.errors import ConfigError
from roboxim_ros import runs
from roboxim_ros.testing import PATIENCE_S


@pytest.fixture(autouse=True)
def own_runtime_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ROBOXIM_RUN", raising=False)


def test_domains_of_concurrent_holders_differ_and_are_given_back():
    with runs.free_domain() as one, runs.free_domain() as two:
        assert one != two
        assert {one, two} <= set(range(1, runs.LARGEST_DOMAIN + 1))
    with runs.free_domain() as again:
        assert again == one


def test_domain_whose_ports_are_in_use_is_not_given(monkeypatch):
    monkeypatch.setattr(runs.os, "getpid", lambda: 40)
    with runs.free_domain() as first:
        assert first >= 41  # the first one that no other process has
    monkeypatch.setattr(runs, "_udp_ports_in_use", lambda: {7400 + 250 * first, 7411 + 250 * (first + 1)})
    with runs.free_domain() as second:
        assert second not in (first, first + 1)


def test_error_in_the_block_comes_through():
    with pytest.raises(FileNotFoundError), runs.free_domain():
        raise FileNotFoundError("mine")


def test_only_live_run_is_found_and_forgotten_at_the_end():
    with pytest.raises(ConfigError, match="roboxim up"):
        runs.find_run()
    with runs.register_run("up", domain=7, namespaces=("", "/w0")) as run:
        assert runs.find_run() == run
        assert runs.find_run(run.id).environment["ROS_DOMAIN_ID"] == "7"
        with pytest.raises(ConfigError, match=run.id):
            runs.find_run("nonsense")
    assert runs.live_runs() == []


def test_several_runs_need_a_name(monkeypatch):
    with runs.register_run("up", domain=7) as one, runs.register_run("up", domain=8) as two:
        with pytest.raises(ConfigError, match=f"(?s){one.id}.*{two.id}|{two.id}.*{one.id}"):
            runs.find_run()
        monkeypatch.setenv("ROBOXIM_RUN", two.id)
        assert runs.find_run() == two
        with pytest.raises(ConfigError, match="alive already"), runs.register_run("up", domain=9, run_id=one.id):
            pass


def test_two_runs_never_share_names_in_a_domain():
    with runs.register_run("up", domain=7, namespaces=("", "/w0")) as one:
        with pytest.raises(ConfigError, match=f"'{one.id}' is alive in domain 7 with namespace '/w0'"):
            runs.register_run("up", domain=7, namespaces=("/w0",)).__enter__()
        with pytest.raises(ConfigError, match="with namespace '/'"):
            runs.register_run("up", domain=7, namespaces=("/",)).__enter__()
        with runs.register_run("up", domain=7, namespaces=("/w1",)), runs.register_run("up", domain=8):
            assert len(runs.live_runs()) == 3
    with runs.register_run("up", domain=7):
        pass


def test_a_runs_name_must_be_a_valid_file_name():
    for name in ("a b", "", "../x", ".hidden"):
        with pytest.raises(ConfigError, match="letters, digits"):
            runs.register_run("up", domain=7, run_id=name).__enter__()


def test_killed_run_is_forgotten_even_if_its_pid_is_used_again():
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    with runs.register_run("up", domain=7) as run:
        file = runs.runtime_dir() / f"{run.id}.json"
        data = json.loads(file.read_text())
        for pid, birth in ((dead.pid, 1), (os.getpid(), 1)):
            other = {**data, "id": "old", "pids": [pid], "births": [birth]}
            (file.parent / "old.json").write_text(json.dumps(other))
            assert [live.id for live in runs.live_runs()] == [run.id]
            assert not (file.parent / "old.json").exists()


def test_run_lives_as_long_as_one_of_its_processes():
    with subprocess.Popen(["sleep", "infinity"]) as child:
        with runs.register_run("node", domain=7) as run:
            runs.extend_run(run.id, pids=[child.pid], nodes=["/sim"])
        assert runs.find_run().pids == (child.pid,)
        assert runs.find_run().nodes == ("/sim",)
        child.kill()
    assert runs.live_runs() == []


@pytest.mark.parametrize("content", ['{"id": "bad"', "[1]", '{"pids": [1], "births": ["x"]}', '{"pids": 1}'])
def test_damaged_file_is_no_run(content):
    (runs.runtime_dir() / "bad.json").write_text(content)
    assert runs.live_runs() == []


def test_live_runs_of_other_versions_are_kept():
    with runs.register_run("up", domain=7) as run:
        file = runs.runtime_dir() / f"{run.id}.json"
        data = json.loads(file.read_text())
        later, earlier = file.with_name("later.json"), file.with_name("earlier.json")
        later.write_text(json.dumps({**data, "id": "later", "colour": "red"}))
        earlier.write_text(json.dumps({key: value for key, value in data.items() if key != "namespaces"}))
        assert {live.id for live in runs.live_runs()} == {run.id, "later"}
        with pytest.raises(ConfigError, match="'earlier' is alive already"):
            runs.register_run("up", domain=8, run_id="earlier").__enter__()
        assert earlier.exists()
        for path in (later, earlier):
            path.unlink()


def test_runtime_dir_is_private_and_never_a_link(tmp_path, monkeypatch):
    assert runs.runtime_dir().stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "other"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "roboxim").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="directory of this user"):
        runs.runtime_dir()


def test_transport_environment_is_checked(monkeypatch):
    monkeypatch.setenv("ROBOXIM_TRANSPORT", "carrier_pigeon")
    with pytest.raises(ConfigError, match="user, network"):
        runs.activate_transport()


LISTENERS = """
import os, re, sys
from pathlib import Path
from roboxim_ros.runs import activate_transport, free_domain
activate_transport(open_network=sys.argv[1] == "network")
from roboxim_ros.host import NodeHost
from rclpy.node import Node
from std_srvs.srv import Empty
with free_domain() as domain, NodeHost(domain_id=domain) as host:
    node = host.add(lambda context: Node("probe", context=context))
    node.create_service(Empty, "probe", lambda request, response: response)
    mine = {os.readlink(f)[8:-1] for f in Path("/proc/self/fd").iterdir() if f.is_symlink()
            and os.path.lexists(f) and os.readlink(f).startswith("socket:")}
    for table in ("udp", "udp6", "tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[9] in mine:
                print(table, fields[1].partition(":")[0], fields[2].partition(":")[0])
"""


def _bound_addresses(transport: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", LISTENERS, transport], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    return set(done.stdout.split("\n")) - {""}


@pytest.mark.ros
def test_a_node_opens_no_socket():
    assert _bound_addresses("user") == set()


@pytest.mark.thorough
@pytest.mark.ros
def test_open_network_listens_on_every_interface():
    assert any(line.split()[1] == "00000000" for line in _bound_addresses("network"))


def test_a_job_does_not_hide_the_only_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ROBOXIM_RUN", raising=False)
    with runs.register_run("evaluate", domain=41) as job, runs.register_run("up", domain=42) as graph:
        assert runs.find_run().id == graph.id
        assert runs.find_run(job.id).id == job.id
        with runs.register_run("up", domain=43), pytest.raises(ConfigError, match="several runs are alive"):
            runs.find_run()
    with runs.register_run("evaluate", domain=41) as job:
        assert runs.find_run().id == job.id
