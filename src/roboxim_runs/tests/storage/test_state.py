"""Runs tell what they are doing: by their events, and to another process by their folders."""

from __future__ import annotations

import json
import os
import time

import pytest
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.shards import Shard
from roboxim_runs.episodes.run import EpisodesJob, run_episodes
from roboxim_runs.executors import CancelledError, Done
from roboxim_runs.storage.event_log import EVENTS_FILE
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.state import find_runs, run_state


class Instant:
    """An executor whose episodes are done at once; ``after`` ends the run in their middle."""

    def __init__(self, after=None, error=None):
        self.after, self.error = after, error

    def run(self, work, jobs, **_):
        for number, job in enumerate(jobs):
            if number == self.after:
                raise self.error
            result = EpisodeResult(episode_id=f"demo-0-{job.data:05d}-0", index=job.data, outcome="success")
            yield Done(key=job.key, value=to_plain(result))


def run(out, executor, shard="", **options):
    job = EpisodesJob(
        config=RunConfig(run_seed=0, purpose="demo", output_dir=str(out)), episodes=6, shard=Shard.parse(shard)
    )
    return run_episodes(job, "demonstrations", {}, executor=executor, **options)


def events(out):
    return [json.loads(line) for line in (out / EVENTS_FILE).read_text().splitlines()]


def test_a_run_writes_its_events_as_json_lines(tmp_path):
    run(tmp_path / "run", Instant())
    found = events(tmp_path / "run")
    assert [event["event"] for event in found] == [
        "run_started", "stage_started", "stage_progress", *["stage_progress", "episode_finished"] * 6, "stage_finished",
        "run_ended",
    ]  # fmt: skip
    assert (found[0]["executor"], found[0]["pid"], found[0]["total"]) == ("instant", os.getpid(), 6)
    assert found[-1]["state"] == "finished"
    [last] = [event for event in found if event.get("index") == 5]
    assert (last["outcome"], last["episode_id"]) == ("success", "demo-0-00005-0")
    run(tmp_path / "run", Instant())
    assert events(tmp_path / "run") == found, "a finished run has nothing to tell"


@pytest.mark.parametrize(
    ("error", "state", "message"),
    [(CancelledError("x"), "stopped", ""), (RoboximError("the disk is full"), "failed", "the disk is full")],
)
def test_how_a_run_ended_is_in_its_folder(tmp_path, error, state, message):
    with pytest.raises(type(error)):
        run(tmp_path / "run", Instant(after=2, error=error))
    [found] = find_runs([tmp_path])
    assert (found.state, found.message, found.done, found.total) == (state, message, 2, 6)
    run(tmp_path / "run", Instant())
    assert (found := run_state(tmp_path / "run")).state == "finished"
    assert (found.done, found.total, found.kind, found.executor) == (6, 6, "generate", "instant")


def test_an_episode_that_was_repaired_counts_once(tmp_path):
    run(tmp_path / "run", Instant())
    with RunFolder(tmp_path / "run").opened(RunFolder(tmp_path / "run").config()) as folder:
        folder.append(EpisodeResult(episode_id="demo-0-00003-1", index=3, outcome="success"))
    assert run_state(tmp_path / "run").done == 6


def test_a_running_run_has_a_rate_and_a_killed_one_is_lost(tmp_path):
    seen = []

    def look(event):
        if type(event).__name__ == "EpisodeFinished" and event.result.index == 3:
            seen.append(run_state(tmp_path / "run", time.time() + 1.0))

    run(tmp_path / "run", Instant(), on_event=look)
    assert (seen[0].state, seen[0].done) == ("running", 4)
    assert seen[0].per_second > 0
    assert seen[0].left_s == pytest.approx(2 / seen[0].per_second)
    log = tmp_path / "run" / EVENTS_FILE
    log.write_text("\n".join(log.read_text().splitlines()[:8]) + '\n{"time": "20')  # what a SIGKILL leaves
    results = tmp_path / "run" / "results.jsonl"
    results.write_text("".join(results.read_text().splitlines(keepends=True)[:3]))
    assert run_state(tmp_path / "run").state == "lost"


def test_runs_below_a_folder_are_listed_with_their_shards(tmp_path):
    run(tmp_path / "shards" / "2", Instant(), shard="2/4")
    with RunFolder(tmp_path / "evaluation" / "bc").opened({"purpose": "eval", "episodes": 9}):
        listed = CliRunner().invoke(group, ["runs", str(tmp_path)], standalone_mode=False, catch_exceptions=False)
    lines = {line.split()[0]: line.split()[1:] for line in listed.stdout.splitlines()}
    assert lines[str(tmp_path / "shards" / "2")][:6] == ["generate", "2/4", "finished", "2", "of", "2"]
    assert lines[str(tmp_path / "evaluation" / "bc")][:6] == ["evaluate", "-", "running", "0", "of", "9"]
    with pytest.raises(ConfigError, match="no such folder"):
        find_runs([tmp_path / "nonsense"])


def test_a_command_writes_its_events_into_a_file_of_choice(tmp_path, monkeypatch):
    monkeypatch.delenv("ROBOXIM_EVENTS", raising=False)
    source = tmp_path / "run"
    with RunFolder(source).opened({"purpose": "eval", "episodes": 1}) as folder:
        folder.append(EpisodeResult(episode_id="eval-0-00000-0", index=0, outcome="failure"))
    words = ["--events", str(tmp_path / "events.jsonl"), "merge", str(source), "--out", str(tmp_path / "out")]
    with monkeypatch.context() as patch:
        patch.setenv("ROBOXIM_EVENTS", "")
        CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
    names = [json.loads(line)["event"] for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert names == ["stage_started", "stage_progress", "stage_finished"]
