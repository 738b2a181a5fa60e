"""An export holds what the bags hold, refuses what does not fit, and is whole or not there."""

from __future__ import annotations

import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_json
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.rlds import RldsReader
from roboxim_recorder.export import export_bags
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_recorder.summary import bag_info, dataset_summary

PNG = ExportConfig(encoding="png")


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake):
    """A run's folder with four successes and a failure, the same for every test here."""
    folder = tmp_path_factory.mktemp("run")
    for index in range(5):
        fake(index=index, outcome="failure" if index == 3 else "success").record(folder)
    return folder


def test_the_export_is_what_the_bags_hold(run, tmp_path, fake):
    progress = []
    report = export_bags("rlds", run, tmp_path / "out", PNG, progress=lambda *at: progress.append(at))
    assert report.path == tmp_path / "out" / "roboxim" / "1.0.0"
    assert (report.splits, report.steps, report.left_out) == ({"train": 3, "val": 1}, 20, {"not_lifted": 1})
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]
    reader = RldsReader(report.path)
    assert reader.features.images == {"image": (24, 32), "wrist_image": (16, 16)}
    episodes = [*reader.episodes("train"), *reader.episodes("val")]
    for index, exported in zip((0, 1, 2, 4), episodes, strict=True):
        episode = fake(index=index)
        assert exported.metadata["episode_id"] == episode.info.episode_id
        assert exported.metadata["robot"] == "panda"
        assert from_json(exported.metadata["action_semantics"], ActionSemantics) == episode.info.semantics
        assert exported.instruction == episode.instruction
        assert exported.reward.tolist() == [0, 0, 0, 0, 1]
        for step in range(5):
            np.testing.assert_array_equal(exported.frame("image", step), episode.image("workspace", step))
            np.testing.assert_array_equal(exported.frame("wrist_image", step), episode.image("wrist", step))
            label = np.array(episode.label(step + 1), np.float32)
            assert label[3] != 0.0
            label[3] = 0.0  # below 1e-5
            np.testing.assert_array_equal(exported.action[step], label)
            robot = episode.state(step).robot
            tcp = robot.pose_tcp_measured.matrix
            expected = np.float32([*tcp[:3, 3], *tcp[:3, 0], *tcp[:3, 1], 1.0])
            np.testing.assert_allclose(exported.state[step], expected, atol=1e-7)
            np.testing.assert_array_equal(exported.vectors["joint_positions"][step], np.float32(robot.joint_positions))
        layout = json.loads(exported.metadata["state_layout"])
        assert layout[:4] == ["tcp.x", "tcp.y", "tcp.z", "tcp.x_axis.x"]
        assert (len(layout), layout[-1]) == (10, "gripper.opening")
        assert json.loads(exported.metadata["joint_names"]) == [f"j{i}" for i in range(7)]


def test_episodes_that_took_another_try_are_left_out_unless_asked_for(tmp_path, fake):
    fake(index=0).record(tmp_path / "run")
    fake(index=1).record(tmp_path / "run", recovered=True)
    report = export_bags("rlds", tmp_path / "run", tmp_path / "out", PNG)
    assert (report.splits, report.left_out) == ({"train": 1}, {"recovered": 1})
    report = export_bags("rlds", tmp_path / "run", tmp_path / "all", replace(PNG, keep_recovered=True))
    assert (sum(report.splits.values()), report.left_out) == (2, {})


def test_dead_dimensions_and_statistics(run, tmp_path):
    report = export_bags("rlds", run, tmp_path / "out", PNG)
    assert report.dead_dimensions == ("droll", "dpitch")
    statistics = json.loads((report.path / "dataset_statistics.json").read_text())
    actions = np.concatenate([e.action for e in RldsReader(report.path).episodes("train")])
    assert statistics["num_transitions"] == len(actions) == 15
    np.testing.assert_allclose(statistics["action"]["q99"], np.quantile(actions, 0.99, axis=0), rtol=1e-5)
    compile((report.path / "openvla_register.py").read_text(), "openvla_register.py", "exec")


def test_two_exports_are_the_same_bytes(run, tmp_path):
    first, second = (export_bags("rlds", run, tmp_path / name).path for name in "ab")
    names = sorted(path.name for path in first.iterdir())
    assert "roboxim-train.tfrecord-00000-of-00001" in names
    assert [(first / name).read_bytes() for name in names] == [(second / name).read_bytes() for name in names]


def test_an_interrupted_export_is_not_taken_for_whole_and_goes_on(run, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_datasets.rlds.dataset.RldsWriter", small_shards())

    def interrupt(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_bags("rlds", run, tmp_path / "out", progress=interrupt)
    with pytest.raises(RecorderError, match="0 datasets"):
        RldsReader(tmp_path / "out")
    resumed = export_bags("rlds", run, tmp_path / "out")
    assert resumed.resumed == 1  # the second was still being encoded
    whole = export_bags("rlds", run, tmp_path / "other")
    for path in whole.path.iterdir():
        assert (resumed.path / path.name).read_bytes() == path.read_bytes()


def small_shards():
    from roboxim_datasets.rlds.writer import RldsWriter

    class Small(RldsWriter):
        def __init__(self, *args, **options):
            super().__init__(*args, **{**options, "shard_bytes": 1})

    return Small


def test_an_existing_export_is_refused_kept_or_replaced(run, tmp_path):
    out = tmp_path / "out"
    first = export_bags("rlds", run, out)
    with pytest.raises(RecorderError, match="exists") as caught:
        export_bags("rlds", run, out)
    assert caught.value.code == ErrorCode.EXPORT_REFUSED
    before = (first.path / "dataset_info.json").stat().st_mtime_ns
    assert export_bags("rlds", run, out, if_exists="keep").splits == first.splits
    assert (first.path / "dataset_info.json").stat().st_mtime_ns == before
    everything = ExportConfig(only_successful=False, val_fraction=0.0)
    with pytest.raises(RecorderError, match="exists"):
        export_bags("rlds", run, out, everything, if_exists="keep")
    assert export_bags("rlds", run, out, everything, if_exists="overwrite").splits == {"train": 5}


def test_images_are_resized_and_cameras_chosen(run, tmp_path):
    config = ExportConfig(cameras={"wrist": "hand"}, image_height=8, image_width=12)
    reader = RldsReader(export_bags("rlds", run, tmp_path / "out", config).path)
    assert next(reader.episodes("train")).frames("hand").shape == (5, 8, 12, 3)
    with pytest.raises(InvalidRequestError, match="no camera 'wirst'.*did you mean 'wrist'"):
        export_bags("rlds", run, tmp_path / "out", ExportConfig(cameras={"wirst": "image"}))


def test_the_robots_of_bags_are_named(tmp_path, fake):
    fake(index=0).record(tmp_path / "run")
    fake(index=1, robot="ur5").record(tmp_path / "run")
    assert dataset_summary(tmp_path / "run").robots == {"panda": 1, "ur5": 1}
    assert "robot         ur5" in bag_info(tmp_path / "run" / "episodes" / "demo-0-00001-0")


def test_nothing_to_export_is_refused(tmp_path, fake):
    fake(outcome="failure").record(tmp_path)
    with pytest.raises(RecorderError, match="none of the 1 bags.*not_lifted"):
        export_bags("rlds", tmp_path, tmp_path / "out")


def test_a_damaged_bag_is_named(tmp_path, fake):
    file = next(fake().record(tmp_path).glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(RecorderError, match="demo-0-00000-0 is damaged"):
        export_bags("rlds", tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    "options", [{"val_fraction": 1.0}, {"image_height": 5}, {"name": "bridge_v2"}, {"shard_mib": 0}]
)
def test_bad_configurations_are_refused(options):
    with pytest.raises(InvalidRequestError):
        ExportConfig(**options)


@pytest.mark.thorough
def test_processes_write_the_same_bytes_and_a_dead_one_costs_nothing(run, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_datasets.rlds.dataset.RldsWriter", small_shards())
    config = ExportConfig(actions="end_effector_absolute,rotation_6d", image_width=32, image_height=24)
    alone = export_bags("rlds", run, tmp_path / "alone", config).path
    monkeypatch.setattr("roboxim_recorder.export.processes.AHEAD", 0)  # so that the second episode comes too late

    def kill(done, total):
        if done == 1:
            for process in multiprocessing.active_children():
                process.kill()

    with pytest.raises(RecorderError, match="a process of the export ended unexpectedly; run the same command again"):
        export_bags("rlds", run, tmp_path / "together", config, workers=2, progress=kill)
    report = export_bags("rlds", run, tmp_path / "together", config, workers=2)
    assert report.resumed == 1
    assert {p.name: p.read_bytes() for p in report.path.iterdir()} == {p.name: p.read_bytes() for p in alone.iterdir()}
