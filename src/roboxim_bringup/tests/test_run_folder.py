import errno
import json
from dataclasses import replace
from pathlib import Path

import pytest

from roboxim_bringup import jobs
from roboxim_bringup.commands.generate import _summary
from roboxim_bringup.run_folder import RESULTS_FILE, RunFolder
from roboxim_bringup.workers import WORKER_DIED
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError
from roboxim_core.verdicts import Verdict


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


def test_another_configuration_is_refused_by_key(tmp_path):
    with RunFolder(tmp_path / "run").opened({"seed": 2}):
        pass
    with RunFolder(tmp_path / "run").opened({"seed": 0, "episodes": 5}) as folder:
        folder.append(result(0))  # from now on there is something to lose
    with RunFolder(tmp_path / "run").opened({"seed": 0, "episodes": 9}) as folder:
        assert folder.config()["episodes"] == 9
    with pytest.raises(ConfigError, match="seed: 0 there, 1 asked"), RunFolder(tmp_path / "run").opened({"seed": 1}):
        pass


def test_another_command_or_a_folder_without_a_success_is_told_apart(tmp_path):
    failed = replace(result(0), outcome="failure", reason="not_lifted")
    with RunFolder(tmp_path / "run").opened({"purpose": "demo", "skill": "rotate"}) as folder:
        folder.append(failed)
    with (
        pytest.raises(ConfigError, match=r'skill: "rotate" there.*none of its 1 episodes succeeded: remove it'),
        RunFolder(tmp_path / "run").opened({"purpose": "demo", "skill": "pick_up"}),
    ):
        pass
    with (
        pytest.raises(ConfigError, match="a run of 'roboxim generate'; choose another --out$"),
        RunFolder(tmp_path / "run").opened({"rerender": {"depth": None, "width": 0}}),
    ):
        pass


def test_an_interrupted_run_says_what_is_there(tmp_path, capsys):
    folder = RunFolder(tmp_path / "run")

    def run():
        with folder.opened({"seed": 0}):
            folder.append(result(0))
            assert folder.in_use
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert "1 episode is done in" in capsys.readouterr().err
    assert not folder.in_use


def test_what_generate_says_it_made(tmp_path):
    kept = [result(0), replace(result(1), attempt=2)]
    failed = replace(result(2), outcome="failure", attempt=4)
    assert _summary([], kept, tmp_path).endswith("episodes (1 after a failed attempt)")
    assert _summary([], [failed], tmp_path) == f"0 demonstrations in {tmp_path / 'episodes'}"
    assert "(1 of 2 episodes were there before; " in _summary(kept[:1], kept, tmp_path)
    again = _summary(kept, kept[:1], tmp_path)
    assert again.startswith("1 demonstration in")
    assert again.endswith(
        "(1 more there, of an earlier command that asked for more); they were there already, nothing was run"
    )


def test_a_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match="not a run's folder"), RunFolder(tmp_path).opened({"seed": 0}):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_whose_first_file_did_not_fit_on_the_disk_can_be_used_again(tmp_path, monkeypatch):
    def full(path, text):
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
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
        folder.discard(3)
        assert [path.name for path in folder.path.glob("*/demo-*")] == ["demo-0-00004-0"]


def test_going_on_tries_again_what_cost_all_workers_and_nothing_else(tmp_path, monkeypatch):
    asked = []

    class Pool:
        def __init__(self, *arguments, **options):
            pass

        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *_: None  # noqa: E731

        def run(self, config, indices, **options):
            asked.append(list(indices))
            for index in indices:
                died = index == 1 and len(asked) == 1
                yield replace(result(index), outcome="error" if died else "failure", reason=WORKER_DIED if died else "")

    monkeypatch.setattr(jobs, "WorkerPool", Pool)
    job = jobs.Job(config=RunConfig(output_dir=str(tmp_path / "run")), episodes=3)
    assert [r.reason for r in jobs.run_job(job, "first")] == ["", WORKER_DIED, ""]
    assert [r.reason for r in jobs.run_job(job, "again")] == ["", "", ""]
    jobs.run_job(job, "once more")
    assert asked == [[0, 1, 2], [1]]
