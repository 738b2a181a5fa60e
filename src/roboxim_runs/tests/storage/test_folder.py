import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.episode.records import WORKER_DIED
from roboxim_core.errors import ConfigError, RecorderError
from roboxim_core.plain_data.results_log import RESULTS_FILE, RUN_FILE
from roboxim_core.verdicts import Verdict
from roboxim_runs.episodes.generation import GenerationResult
from roboxim_runs.episodes.run import EpisodesJob, run_episodes
from roboxim_runs.events import Interrupted
from roboxim_runs.executors import Done, Lost
from roboxim_runs.storage.folder import RunFolder


def result(index):
    verdict = Verdict(success=True, predicates={"lift_m": 0.0512345678901234})
    return EpisodeResult(episode_id=f"e{index}", index=index, outcome="success", verdict=verdict)


def test_results_survive_a_torn_last_line(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 0}) as folder:
        folder.append(result(1))
        folder.append(result(0))
    path = tmp_path / "run" / RESULTS_FILE
    path.write_text(path.read_text() + '{"episode_id": "e2", "ind')
    with RunFolder(tmp_path / "run").opened({"seed": 0}) as folder:
        assert folder.results() == [result(0), result(1)]
        folder.append(result(2))
        assert folder.results() == [result(0), result(1), result(2)]


def test_episodes_of_two_seeds_keep_a_result_each_and_the_last_attempt_counts(tmp_path):
    """`rerender` writes episodes of several runs into one folder."""
    results = [replace(result(0), episode_id=f"demo-{seed}-00000-0") for seed in (0, 1)]
    again = replace(results[1], episode_id="demo-1-00000-1", attempt=1)
    with RunFolder(tmp_path / "run").opened({"rerender": {}}) as folder:
        for one in (*results, again):
            folder.append(one)
        assert folder.results() == [results[0], again]


def test_another_configuration_is_refused_by_key(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 2}):
        pass
    with RunFolder(tmp_path / "run").opened({"seed": 0, "episodes": 5}) as folder:
        folder.append(result(0))  # from now on the folder has a result
    with RunFolder(tmp_path / "run").opened({"seed": 0, "episodes": 9}) as folder:
        assert folder.config()["episodes"] == 9
    with (
        pytest.raises(ConfigError, match="seed: 0 stored, 1 requested"),
        RunFolder(tmp_path / "run").opened({"seed": 1}),
    ):
        pass


def test_another_command_and_a_folder_without_a_success_get_their_own_advice(tmp_path):
    failed = replace(result(0), outcome="failure", reason="not_lifted")
    with RunFolder(tmp_path / "run").opened({"purpose": "demo", "skill": "rotate"}) as folder:
        folder.append(failed)
    with (
        pytest.raises(ConfigError, match=r'skill: "rotate" stored.*none of its 1 episodes succeeded: remove it'),
        RunFolder(tmp_path / "run").opened({"purpose": "demo", "skill": "pick_up"}),
    ):
        pass
    with (
        pytest.raises(ConfigError, match="a run of 'roboxim generate'; choose another output folder"),
        RunFolder(tmp_path / "run").opened({"rerender": {"depth": None, "width": 0}}),
    ):
        pass


def summary(before, results, out):
    return GenerationResult(out=out, results=tuple(results), before=tuple(before), picture=None).summary


def test_the_summary_of_generate(tmp_path):
    kept = [result(0), replace(result(1), attempt=2)]
    failed = replace(result(2), outcome="failure", attempt=4)
    assert summary([], kept, tmp_path).endswith("episodes (1 after a failed attempt)")
    assert summary([], [failed], tmp_path) == f"0 demonstrations in {tmp_path / 'episodes'}"
    assert "(1 of 2 episodes existed before; " in summary(kept[:1], kept, tmp_path)
    again = summary(kept, kept[:1], tmp_path)
    assert again.startswith("1 demonstration in")
    assert again.endswith("(1 more in the folder, from an earlier run); all of them existed already, nothing was run")


def test_a_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    said = "has files and is not the folder of 'roboxim generate'"
    with pytest.raises(ConfigError, match=said), RunFolder(tmp_path).opened({"seed": 0}):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_whose_first_file_did_not_fit_on_the_disk_can_be_used_again(tmp_path, monkeypatch):
    def full(path, text):
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"), RunFolder(tmp_path / "run").opened({"seed": 0}):
        pass
    monkeypatch.undo()
    with RunFolder(tmp_path / "run").opened({"seed": 0}) as folder:
        assert folder.results() == []


def test_two_commands_in_one_folder_are_refused(tmp_path):
    with (
        RunFolder(tmp_path / "run").opened({"seed": 0}),
        pytest.raises(ConfigError, match="another command"),
        RunFolder(tmp_path / "run").opened({"seed": 0}),
    ):
        pass


def test_config_is_readable_by_people(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 0}):
        pass
    assert json.loads((tmp_path / "run" / "run.json").read_text()) == {"seed": 0}


def test_bags_of_an_unfinished_index_are_discarded(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 0}) as folder:
        for place in ("episodes/demo-0-00003-0", "set_apart/demo-0-00003-1", ".partial/demo-0-00003-2"):
            (folder.path / place).mkdir(parents=True)
        (folder.path / "episodes" / "demo-0-00004-0").mkdir()
        folder.discard([3])
        assert [path.name for path in folder.path.glob("*/demo-*")] == ["demo-0-00004-0"]


def test_bags_are_not_discarded_for_a_seed_that_is_the_number_of_an_unfinished_index(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 12345}) as folder:
        for place in ("episodes/demo-12345-00003-0", "set_apart/demo-12345-12345-0"):
            (folder.path / place).mkdir(parents=True)
        folder.discard([12345])
        assert [path.name for path in folder.path.glob("*/demo-*")] == ["demo-12345-00003-0"]


class Executor:
    """An executor that yields the given outcomes."""

    def __init__(self, outcome_of):
        self.asked, self.outcome_of = [], outcome_of

    def run(self, work, jobs, **_):
        self.asked.append([job.data for job in jobs])
        for job in jobs:
            yield self.outcome_of(job)


def done(job, **changes):
    return Done(key=job.key, value=to_plain(replace(result(job.data), **changes)))


def job_in(folder, episodes=3):
    return EpisodesJob(config=RunConfig(output_dir=str(folder)), episodes=episodes)


def test_resuming_repeats_only_episodes_whose_workers_all_died(tmp_path):
    job = job_in(tmp_path / "run")
    first = Executor(lambda job: Lost(key=job.key, message="dead") if job.data == 1 else done(job, outcome="failure"))
    assert [r.reason for r in run_episodes(job, "first", {}, executor=first)] == ["", WORKER_DIED, ""]
    again = Executor(done)
    assert [r.reason for r in run_episodes(job, "again", {}, executor=again)] == ["", "", ""]
    run_episodes(job, "once more", {}, executor=again)
    assert first.asked + again.asked == [[0, 1, 2], [1]]


def test_an_interrupted_run_reports_its_finished_episodes(tmp_path):
    def interrupted(job):
        if job.data == 1:
            raise KeyboardInterrupt
        return done(job)

    events = []
    with pytest.raises(KeyboardInterrupt):
        run_episodes(job_in(tmp_path / "run"), "", {}, executor=Executor(interrupted), on_event=events.append)
    assert isinstance(events[-1], Interrupted)
    assert events[-1].text.startswith("1 episode is done in")
    assert not RunFolder(tmp_path / "run").in_use


@pytest.mark.parametrize("line", ["garbage", "[1]", '{"episode_id": 3}', "\x00\x01", "[" * 100_000])
def test_a_line_that_is_no_result_is_named_and_repaired(tmp_path, line):
    job = job_in(tmp_path / "run")
    run_episodes(job, "", {}, executor=Executor(done))
    log = tmp_path / "run" / RESULTS_FILE
    first, _, last, end = log.read_text().split("\n")
    log.write_text("\n".join([first, line, last, end]))
    with pytest.raises(ConfigError, match=r"results.jsonl line 2 .*--repair"):
        run_episodes(job, "", {}, executor=Executor(done))
    executor = Executor(done)
    assert len(run_episodes(job, "", {}, executor=executor, repair=True)) == 3
    assert executor.asked == [[1]]
    assert line in log.with_name(f"{RESULTS_FILE}.damaged").read_text()


@pytest.mark.parametrize("text", ["", '{"episodes": 3, "ru', "[]", "\x00"])
def test_a_torn_configuration_is_named_and_repaired_from_the_results(tmp_path, text):
    job = job_in(tmp_path / "run")
    run_episodes(job, "", {}, executor=Executor(done))
    (tmp_path / "run" / RUN_FILE).write_text(text)
    with pytest.raises(ConfigError, match=r"run.json is damaged .*--repair"):
        run_episodes(job, "", {}, executor=Executor(done))
    executor = Executor(done)
    run_episodes(job, "", {}, executor=executor, repair=True)
    assert executor.asked == [], "the results name the configuration that they are of"
    (tmp_path / "run" / RUN_FILE).write_text(text)
    other = replace(job, renderer="tiny")
    run_episodes(other, "", {}, executor=executor, repair=True)
    assert executor.asked == [[0, 1, 2]], "results of another configuration are not taken"


def test_a_result_of_another_run_is_refused(tmp_path):
    run_episodes(job_in(tmp_path / "a"), "", {}, executor=Executor(done))
    other = replace(job_in(tmp_path / "b"), renderer="tiny")
    run_episodes(other, "", {}, executor=Executor(done))
    with (tmp_path / "b" / RESULTS_FILE).open("a") as file:
        file.write((tmp_path / "a" / RESULTS_FILE).read_text())
    with pytest.raises(ConfigError, match="results.jsonl line 4 is a result of another run"):
        run_episodes(other, "", {}, executor=Executor(done))


def test_a_vanished_bag_is_named_and_its_episode_run_again(tmp_path):
    def recorded(job):
        bag = f"episodes/demo-0-{job.data:05d}-0"
        (tmp_path / "run" / bag).mkdir(parents=True)
        (tmp_path / "run" / bag / "x_0.mcap").write_bytes(b"recording" + MCAP0_MAGIC)
        return done(job, bag=bag)

    job = job_in(tmp_path / "run", 4)
    run_episodes(job, "", {}, executor=Executor(recorded))
    bags = tmp_path / "run" / "episodes"
    shutil.rmtree(bags / "demo-0-00001-0")
    (bags / "demo-0-00002-0" / "x_0.mcap").unlink()  # its folder alone is no bag
    (bags / "demo-0-00003-0" / "x_0.mcap").write_bytes(b"recor")  # the disk was full
    with pytest.raises(RecorderError, match=r"3 bags .* gone or cut short: episodes/demo-0-00001-0, .*--repair"):
        run_episodes(job, "", {}, executor=Executor(recorded))
    executor = Executor(recorded)
    results = run_episodes(job, "", {}, executor=executor, repair=True)
    assert executor.asked == [[1, 2, 3]]
    assert [r.index for r in results] == [0, 1, 2, 3]
    run_episodes(job, "", {}, executor=executor)


@pytest.mark.parametrize("name", ["x" * 300, "a/" * 2000])
def test_a_name_that_no_file_system_takes_is_refused(tmp_path, name):
    with pytest.raises(ConfigError, match="not a valid folder"):
        RunFolder(tmp_path / name)
