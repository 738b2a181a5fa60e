"""A run's bags are held against its results: what is missing or unexpected is named, and never silently left out."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_recorder.export import export_bags
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_recorder.run_bags import read_results, run_bags
from roboxim_recorder.summary import dataset_summary


@pytest.fixture
def run(tmp_path, fake):
    """A finished run: three kept bags, one set apart, a result for each."""
    folder = tmp_path / "run"
    lines = []
    for index in range(4):
        kept = "keep" if index < 3 else "set_apart"
        episode = fake(index=index, outcome="success" if index < 3 else "failure")
        bag = episode.record(folder, keep=kept)
        lines.append(to_json(replace(episode.result, bag=str(bag.relative_to(folder)))) + "\n")
    (folder / "results.jsonl").write_text("".join(lines))
    return folder


def bag(run, index):
    return run / "episodes" / f"demo-0-{index:05d}-0"


def test_a_whole_run_lacks_nothing(run):
    found = run_bags(run)
    assert found.paths == tuple(bag(run, index) for index in range(3))
    assert (found.missing, found.unexpected) == ((), ())
    assert run_bags(run / "episodes") == found
    assert export_bags("rlds", run, run.parent / "out").splits == {"train": 2, "val": 1}


def test_missing_bags_are_named_and_refused_unless_skipped(run):
    shutil.rmtree(bag(run, 1))
    next(bag(run, 2).glob("*.mcap")).unlink()
    shutil.rmtree(run / "set_apart")
    assert run_bags(run).missing == ("episodes/demo-0-00001-0", "episodes/demo-0-00002-0", "set_apart/demo-0-00003-0")
    with pytest.raises(RecorderError, match="3 bags are missing.*episodes/demo-0-00001-0.*--skip-missing") as caught:
        export_bags("rlds", run, run.parent / "out")
    assert caught.value.code == ErrorCode.EXPORT_REFUSED
    report = export_bags("rlds", run, run.parent / "out", ExportConfig(skip_missing=True))
    assert report.splits == {"train": 1}
    assert report.left_out == {"no_bag": 3}
    assert len(report.missing) == 3


def test_a_run_that_lost_every_bag_says_so(run):
    shutil.rmtree(run / "episodes")
    with pytest.raises(RecorderError, match="3 bags are missing"):
        export_bags("rlds", run, run.parent / "out")


def test_a_bag_without_a_result_is_named_and_not_exported(run, fake):
    fake(index=7).record(run)
    found = run_bags(run)
    assert found.unexpected == (bag(run, 7),)
    assert found.unexpected_text == "1 bag has no line in results.jsonl: demo-0-00007-0"
    report = export_bags("rlds", run, run.parent / "out")
    assert (sum(report.splits.values()), report.left_out, report.unexpected) == (3, {"no_result": 1}, found.unexpected)


def test_a_bag_that_holds_another_episode_is_refused(run, fake):
    first, second = bag(run, 0), bag(run, 1)
    first.rename(run / "aside")
    second.rename(first)
    (run / "aside").rename(second)
    with pytest.raises(RecorderError, match="demo-0-00000-0 holds another episode") as caught:
        export_bags("rlds", run, run.parent / "out")
    assert caught.value.code == ErrorCode.BAG_DAMAGED


def test_a_bag_that_ended_otherwise_than_its_result_says_is_refused(run, fake):
    shutil.rmtree(bag(run, 0))
    fake(index=0, steps=7).record(run)
    with pytest.raises(RecorderError, match="demo-0-00000-0 holds another episode"):
        export_bags("rlds", run, run.parent / "out")


def test_a_torn_last_line_is_left_out_and_a_damaged_one_is_named(run):
    path = run / "results.jsonl"
    text = path.read_text()
    path.write_text(text + text[:50])
    assert len(read_results(run)) == 4
    path.write_text("{ nonsense\n" + text)
    with pytest.raises(ConfigError, match=r"results.jsonl line 1"):
        run_bags(run)
    path.write_bytes(b"\xff\n")
    with pytest.raises(ConfigError, match=r"results.jsonl line 1 is not a result"):
        run_bags(run)


def test_an_evaluations_folder_names_its_policies_folders(run):
    evaluation = run.parent / "evaluation"
    evaluation.mkdir()
    shutil.copytree(run, evaluation / "bc")
    shutil.copytree(run, evaluation / "random")
    for read in (run_bags, dataset_summary):
        with pytest.raises(RecorderError, match=rf"name a policy's: {evaluation}/bc or {evaluation}/random"):
            read(evaluation)
