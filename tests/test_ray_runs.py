"""Runs on a Ray cluster give the bytes of a run on this machine, whatever is lost; `make scale` installs Ray."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
from planted_runs import add_ray_node, ray_cluster, recordings, repeatable_results

from roboxim_ros.testing import PATIENCE_S
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import EpisodeFinished, Notice
from roboxim_runs.executors.ray_cluster import RayExecutor

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SMALL = {"size": 32, "renderer": "tiny"}
EPISODES = 6
MANY = 40
"""Demonstrations and rollouts of the runs in which a node is killed."""


@pytest.fixture
def cluster():
    pytest.importorskip("ray")
    cluster = ray_cluster(2)
    yield cluster
    cluster.shutdown()


def same(run, other):
    assert recordings(run) == recordings(other)
    assert repeatable_results(run) == repeatable_results(other)
    left = [path for path in (run / ".partial").rglob("*")] if (run / ".partial").exists() else []
    assert not left, "nothing is left behind"


@pytest.mark.parametrize("kind", ["generate", "evaluate"])
def test_a_node_killed_in_the_middle_changes_nothing(cluster, tmp_path, kind):
    def run(out, **options):
        if kind == "generate":
            generate(GenerationConfig(out=out, episodes=MANY, workers=2, **SMALL), **options)
            return out
        evaluate(
            EvaluationConfig(out=out, episodes=MANY, policies="random", max_steps=10, workers=2, **SMALL), **options
        )
        return out / "random"

    doomed, seen = add_ray_node(cluster), []

    def lose(event):
        if isinstance(event, EpisodeFinished) and doomed in cluster.list_all_nodes() and event.result.index >= 4:
            cluster.remove_node(doomed, allow_graceful=False)
        if isinstance(event, Notice):
            seen.append(event.text)

    made = run(tmp_path / "ray", executor=RayExecutor(3, address=cluster.address), on_event=lose)
    assert doomed not in cluster.list_all_nodes()
    assert len(repeatable_results(made)) == MANY
    same(made, run(tmp_path / "local"))


@pytest.mark.parametrize("victim", ["driver", "cluster"])
def test_a_killed_driver_or_cluster_is_continued_by_the_same_command(cluster, tmp_path, victim):
    out = tmp_path / "ray"

    def command(address):
        words = ["generate", "--out", out, "--episodes", EPISODES, "--size", 32, "--renderer", "tiny", "--workers", 2]
        words += ["--executor", "ray", "--address", address]
        return [sys.executable, "-m", "roboxim_cli", *map(str, words)]

    environment = {**os.environ, "RAY_gcs_rpc_server_reconnect_timeout_s": "5"}
    driver = subprocess.Popen(command(cluster.address), env=environment)
    deadline = time.monotonic() + PATIENCE_S
    results = out / "results.jsonl"
    while not results.exists() or not results.read_text():
        assert driver.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.2)
    if victim == "driver":
        driver.send_signal(signal.SIGKILL)
    else:
        cluster.shutdown()
    assert driver.wait(PATIENCE_S) != 0
    again = ray_cluster(2) if victim == "cluster" else cluster
    try:
        subprocess.run(command(again.address), env=environment, check=True, timeout=PATIENCE_S)
    finally:
        if again is not cluster:
            again.shutdown()
    generate(GenerationConfig(out=tmp_path / "local", episodes=EPISODES, workers=2, **SMALL))
    same(out, tmp_path / "local")


def test_bags_of_a_cluster_can_go_to_a_store(cluster, tmp_path):
    pytest.importorskip("fsspec")
    from roboxim_runs.storage.store import local_sources

    url = f"file://{tmp_path}/store"
    config = GenerationConfig(out=tmp_path / "ray", episodes=2, workers=2, store=url, **SMALL)
    generate(config, executor=RayExecutor(2, address=cluster.address))
    generate(GenerationConfig(out=tmp_path / "local", episodes=2, workers=2, **SMALL))
    with local_sources([url]) as [folder]:
        assert recordings(folder) == recordings(tmp_path / "local")


LOOKING = """
from roboxim_policies import BasePolicy


class Looking(BasePolicy):
    cameras = ("workspace",)

    def act(self, window):
        return [0.001 * window.newest.images["workspace"].mean() / 255] * 6 + [1.0]
"""


def test_a_policy_server_is_placed_by_resources_and_moves_when_its_node_is_lost(cluster, tmp_path):
    (tmp_path / "looking.py").write_text(LOOKING)

    def run(out, **options):
        config = EvaluationConfig(
            policies=f"looking={tmp_path}/looking.py:Looking", out=out, episodes=EPISODES, max_steps=10, workers=2,
            **SMALL,
        )  # fmt: skip
        evaluate(config, **options)
        return out / "looking"

    doomed, told = [add_ray_node(cluster, resources={"model": 1})], []

    def lose(event):
        if isinstance(event, EpisodeFinished) and doomed:
            cluster.remove_node(doomed.pop(), allow_graceful=False)
            add_ray_node(cluster, resources={"model": 1})
        if isinstance(event, Notice):
            told.append(event.text)

    server = RayExecutor(1, address=cluster.address, resources={"CPU": 0, "model": 1})
    workers = RayExecutor(2, address=cluster.address)
    made = run(tmp_path / "ray", executor=workers, servers=[server], on_event=lose)
    assert not doomed
    assert any("the server of policy 'looking'" in text for text in told), told
    same(made, run(tmp_path / "local"))
