"""A worker's graph in this process: what it tells while an episode runs, and what is left of one that is given up."""

from __future__ import annotations

import threading
import time

import pytest

from roboxim_bringup.graph import GraphConfig, PolicyLaunch
from roboxim_core.config import to_plain
from roboxim_core.episode import RunConfig
from roboxim_policies.base import BasePolicy
from roboxim_runs.episodes.worker import EpisodeWorker
from roboxim_runs.executors import WorkerBrokenError

pytestmark = pytest.mark.ros
TICK_S = 0.05
STEPS = 20


class SlowPolicy(BasePolicy):
    """Answers late, so that an episode lasts."""

    name = "slow"

    def act(self, window):
        time.sleep(TICK_S)
        return [0.0] * 7


@pytest.fixture
def worker(runtime, tmp_path, monkeypatch):
    from roboxim_ros.runs import free_domain

    parameters = {"sim": {"scene": "", "renderer": "tiny"}, "recorder": {"output_root": str(tmp_path)}}
    graph = GraphConfig(parameters=parameters, policies=(PolicyLaunch(spec=f"{__file__}:SlowPolicy"),))
    config = RunConfig(
        output_dir=str(tmp_path / "run"), actor="policy", image_width=32, image_height=32, max_steps=STEPS, keep="all"
    )
    with free_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield EpisodeWorker({"graph": to_plain(graph), "config": to_plain(config)}, 0)


def test_a_worker_tells_of_its_episode_and_returns_its_result(worker, tmp_path):
    notes = []
    result = worker.run(3, notes.append)
    worker.close()
    assert (result["index"], result["steps"], result["outcome"]) == (3, STEPS, "failure")
    assert len(list(tmp_path.rglob("*.mcap"))) == 1
    assert [note["index"] for note in notes] == [3] * len(notes)
    ticks = [note["seq"] for note in notes]
    assert len(ticks) >= STEPS * TICK_S / 0.5, "it tells every 0.2 s"
    assert ticks == sorted(ticks)


@pytest.mark.parametrize("error", [WorkerBrokenError("the graph is broken"), SystemExit(143)])
@pytest.mark.thorough
def test_an_episode_that_is_given_up_ends_before_the_graph_and_leaves_no_bag(worker, tmp_path, monkeypatch, error):
    begun = threading.Event()

    def check():
        if begun.is_set():
            raise error

    monkeypatch.setattr(worker, "_check", check)
    with pytest.raises(type(error)):
        worker.run(0, lambda note: begun.set())
    worker.close()
    assert not list(tmp_path.rglob("*.mcap"))
    assert not any(thread.name.startswith("episodes") for thread in threading.enumerate() if thread.is_alive())
