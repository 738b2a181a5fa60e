"""A policy's server that is away costs time, never episodes: they are repeated, and the run stops in a sentence."""

from __future__ import annotations

import threading

import pytest

from roboxim_bringup.graph import PolicyLaunch
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ErrorCode, EvaluationError, PolicyError, UnavailableError
from roboxim_policies.base import BasePolicy
from roboxim_runs.episodes.run import EpisodesJob, run_environment, run_episodes
from roboxim_runs.evaluation.checks import require_played
from roboxim_runs.evaluation.results import PolicyResult
from roboxim_runs.events import Notice
from roboxim_runs.executors import InlineExecutor, Note
from roboxim_runs.policies.waiting import LOSSES, Retries, Waiting
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.state import run_state


def lost(steps=0, reason="policy_died", index=0):
    return EpisodeResult(
        episode_id=f"eval-0-{index:05d}-0", index=index, outcome="error", reason=reason, message="gone", steps=steps
    )


def test_patience_ends_after_its_time_however_many_tries():
    now = [100.0]
    retries = Retries(60.0, clock=lambda: now[0])
    assert not retries.tried
    pauses = []

    def wait_for_ever():
        while True:
            pauses.append(retries.lost(lost()))
            now[0] += pauses[-1]

    with pytest.raises(UnavailableError, match=r"stayed away for 60 s \(--server-wait.*gone.*same command continues"):
        wait_for_ever()
    assert pauses[:6] == [0.5, 1, 2, 4, 8, 10]
    assert sum(pauses) == pytest.approx(60.0)
    assert retries.tried
    with pytest.raises(UnavailableError, match="stayed away for 0 s"):
        Retries(0.0).lost(lost())


def test_server_that_ends_in_mid_episode_again_and_again_ends_the_run():
    now = [0.0]
    retries = Retries(60.0, clock=lambda: now[0])
    for _ in range(LOSSES - 1):
        assert retries.lost(lost(steps=7)) == 0.5, "it was there, so the time begins anew"
        now[0] += 59.0
        retries.lost(lost())
    with pytest.raises(UnavailableError, match="lost 3 times in the middle of episode eval-0-00000-0"):
        retries.lost(lost(steps=7))


def test_waiting_of_several_workers_is_told_once():
    waiting = Waiting()

    def told(key, data):
        return waiting.notice(Note(worker=0, key=key, data=data))

    assert told("index 0", {"seq": 3}) == told("index 0", None) == ""
    assert told("index 0", {"waiting": "waiting for it"}) == "waiting for it"
    assert told("index 1", {"waiting": "waiting for it"}) == ""
    assert "is back" in told("index 1", {"waiting": ""})
    assert told("index 0", {"waiting": ""}) == ""


@pytest.mark.parametrize("reason", ["policy_died", "worker_died"])
def test_episode_that_was_not_played_is_no_result(tmp_path, reason):
    """Also in folders of older versions, which hold such lines."""
    job = EpisodesJob(config=RunConfig(output_dir=str(tmp_path)), episodes=2)
    folder = RunFolder(tmp_path)
    with folder.opened(job.identity):
        folder.append(lost(reason=reason))
        folder.append(EpisodeResult(episode_id="eval-0-00001-0", index=1, outcome="error", reason="policy_fault"))
    assert [result.index for result in folder.results()] == [1]
    assert list(job.done(folder.results())) == [1]
    assert (run_state(tmp_path).done, run_state(tmp_path).total) == (1, 2)
    with folder.opened(job.identity):
        folder.append(EpisodeResult(episode_id="eval-0-00000-0", index=0, outcome="success"))
    assert [result.outcome for result in folder.results()] == ["success", "error"]
    assert run_state(tmp_path).done == 2


def test_policy_that_lost_all_its_processes_has_no_rate(tmp_path):
    results = (EpisodeResult(episode_id="e-0", index=0, outcome="success"), lost(reason="worker_died", index=1))
    require_played([PolicyResult(name="p", results=results[:1], folder=tmp_path)])
    with pytest.raises(
        EvaluationError, match="'p' has no rate, since 1 of 2 episodes were not played.*at index 1: gone"
    ):
        require_played([PolicyResult(name="p", results=results, folder=tmp_path)])


class Away(BasePolicy):
    """Stands for a server: it is away as often as ``times`` says, from the third request of the first episode on."""

    name = "away"
    times = 0
    asked = 0

    def reset(self, start):
        if Away.times > 0 and Away.asked >= 3:
            Away.times -= 1
            raise PolicyError("the server cannot be reached", ErrorCode.POLICY_DIED)

    def act(self, window):
        Away.asked += 1
        if Away.asked == 3:
            raise PolicyError("the connection was lost", ErrorCode.POLICY_DIED)
        return [0.0] * 7


def job_of(folder, wait_s):
    config = RunConfig(
        output_dir=str(folder), actor="policy", image_width=32, image_height=32, max_steps=4, settle_ticks=1
    )
    launch = PolicyLaunch(spec=f"{__name__}:Away")
    return EpisodesJob(config=config, episodes=2, renderer="tiny", policies=(launch,), server_wait_s=wait_s)


@pytest.mark.ros
@pytest.mark.thorough
def test_run_survives_a_server_that_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(Away, "times", 2)
    monkeypatch.setattr(Away, "asked", 0)
    events = []
    with run_environment("test") as environment:
        results = run_episodes(
            job_of(tmp_path / "run", 60.0), "", environment, executor=InlineExecutor(), on_event=events.append
        )
    assert [(r.index, r.outcome, r.steps) for r in results] == [(0, "failure", 4), (1, "failure", 4)]
    told = [event.text for event in events if isinstance(event, Notice)]
    assert told[0].startswith("waiting up to 60 s for the policy's server: ")
    assert "connection was lost" in told[0]
    assert told[1:] == ["the policy's server is back; the run continues"]
    assert len(list((tmp_path / "run").rglob("*.mcap"))) == 2, "the episodes that broke off leave no bag"


@pytest.mark.ros
@pytest.mark.thorough
def test_run_stops_when_the_server_stays_away_and_the_same_run_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(Away, "times", 1_000)
    monkeypatch.setattr(Away, "asked", 0)
    job = job_of(tmp_path / "run", 1.0)
    with run_environment("test") as environment:
        with pytest.raises(UnavailableError, match="stayed away for 1 s.*cannot be reached.*same command continues"):
            run_episodes(job, "", environment, executor=InlineExecutor())
        assert RunFolder(tmp_path / "run").results() == []
        Away.times = 0
        results = run_episodes(job, "", environment, executor=InlineExecutor())
    assert [result.steps for result in results] == [4, 4]
    assert not any(thread.name.startswith("episodes") for thread in threading.enumerate() if thread.is_alive())
