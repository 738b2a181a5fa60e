"""Damage is found, named; a run's folder is listed and summarised."""

from __future__ import annotations

import pytest
from mcap.reader import make_reader

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export import export_bags
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.run_bags import list_bags
from roboxim_recorder.summary import bag_info, dataset_summary


def truncate(path, part):
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * part)])


def test_a_whole_bag_passes(tmp_path, fake):
    report = check_bag(fake().record(tmp_path))
    assert report.ok, report.problems
    assert (report.episode_id, report.ticks, report.outcome) == ("demo-0-00000-0", 8, "success")


def test_a_truncated_bag_is_damaged(tmp_path, fake):
    path = fake(steps=20).record(tmp_path)
    truncate(path, 0.4)
    with pytest.raises(RecorderError, match="demo-0-00000-0 is damaged.*repair") as caught:
        BagReader(path)
    assert caught.value.code == ErrorCode.BAG_DAMAGED
    assert not check_bag(path).ok


def test_a_flipped_bit_is_found(tmp_path, fake):
    path = fake().record(tmp_path)
    file = next(path.glob("*.mcap"))
    with file.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]
    data = bytearray(file.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 16
    file.write_bytes(data)
    assert not check_bag(path).ok


def test_a_runs_folder_is_listed_and_summarised(tmp_path, fake):
    kept = [fake(index=i, instruction=f"Pick up {i % 2}").record(tmp_path) for i in range(3)]
    fake(index=7, outcome="failure").record(tmp_path, keep="set_apart")
    fake(index=8).open(tmp_path)
    assert list_bags(tmp_path) == kept
    assert list_bags(kept[1]) == [kept[1]]
    summary = dataset_summary(tmp_path)
    assert (summary.episodes, summary.set_apart, summary.ticks) == (3, 1, 24)
    assert summary.instructions == {"Pick up 0": 2, "Pick up 1": 1}
    assert summary.reasons == {"not_lifted": 1}
    assert "3 kept (success x3), 1 set apart" in summary.text
    assert "Pick up 0" in bag_info(kept[0])


def test_a_folder_without_bags_is_named(tmp_path, fake):
    with pytest.raises(RecorderError, match="has no bags"):
        list_bags(tmp_path)
    fake(outcome="failure").record(tmp_path, keep="set_apart")
    with pytest.raises(RecorderError, match="has no bags; the 1 in set_apart did not succeed"):
        list_bags(tmp_path)
    with pytest.raises(ConfigError, match="no such folder"):
        list_bags(tmp_path / "nothere")


def test_non_bags_are_distinguished_from_damaged_bags(tmp_path, fake):
    bag = fake().record(tmp_path)
    (tmp_path / "policy.py").write_text("class Policy: ...")
    with pytest.raises(ConfigError, match="policy.py is not a bag"):
        BagReader(tmp_path / "policy.py")
    with pytest.raises(ConfigError, match="no such bag"):
        BagReader(tmp_path / "nothere")
    with pytest.raises(ConfigError, match=f"is a run, not one bag; name one, e.g. {bag}"):
        BagReader(tmp_path)
    with pytest.raises(ConfigError, match=f"is a folder of bags, not one bag; name one, e.g. {bag}"):
        BagReader(tmp_path / "episodes")


def test_a_bag_that_lost_its_file_is_not_passed_over(tmp_path, fake):
    paths = [fake(index=index).record(tmp_path) for index in range(2)]
    next(paths[1].glob("*.mcap")).unlink()
    assert list_bags(tmp_path) == paths
    assert not check_bag(paths[1]).ok
    with pytest.raises(RecorderError, match="demo-0-00001-0 is not an episode's bag"):
        export_bags("rlds", tmp_path, tmp_path / "rlds")
