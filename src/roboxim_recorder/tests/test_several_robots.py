"""Datasets of several robots: each episode names its own, and joints are left out where they differ."""

from __future__ import annotations

from dataclasses import replace

import pytest

from roboxim_core.errors import RecorderError
from roboxim_core.state import StateRecord
from roboxim_datasets.formats import open_dataset
from roboxim_policies.learning.data import read_demonstrations
from roboxim_recorder.export import EXPORTERS, export_bags

FORMATS = {
    "rlds": ("rlds", {"encoding": "png"}),
    "lerobot 3.0": ("lerobot", {"images": True}),
    "lerobot 2.1": ("lerobot", {"images": True, "version": "2.1"}),
    "hdf5": ("hdf5", {}),
}


def named_joints(episode):
    """Return the episode with the robot's name in the names of its joints, as real robots have them."""

    class Named(type(episode)):
        def state(self, seq: int) -> StateRecord:
            found = super().state(seq)
            names = tuple(f"{self.robot}_{name}" for name in found.robot.joint_names)
            return replace(found, robot=replace(found.robot, joint_names=names))

    return Named(**{name: getattr(episode, name) for name in episode.__dataclass_fields__})


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake):
    folder = tmp_path_factory.mktemp("run")
    for index, robot in enumerate(("panda", "fr3", "panda", "xarm7")):
        named_joints(fake(index=index, robot=robot)).record(folder)
    return folder


def export(run, out, case, **options):
    name, own = FORMATS[case]
    return export_bags(name, run, out, EXPORTERS[name]().config(**own, **options))


@pytest.mark.parametrize("case", FORMATS)
def test_each_episode_names_its_robot_and_joints_that_differ_are_left_out(case, run, tmp_path):
    report = export(run, tmp_path / "out", case)
    assert (report.robots, report.columns_left_out) == (("fr3", "panda", "xarm7"), ("joint_positions",))
    dataset = open_dataset(report.path)
    assert dataset.description.robot == "fr3+panda+xarm7"
    assert sorted(episode.robot for episode in dataset.episodes()) == ["fr3", "panda", "panda", "xarm7"]
    assert "joint_positions" not in dataset.features.vectors
    assert not any(episode.joint_names for episode in dataset.episodes())


def test_robots_with_the_same_joints_keep_them(fake, tmp_path):
    for index, robot in enumerate(("panda", "fr3")):
        fake(index=index, robot=robot).record(tmp_path / "run")
    report = export(tmp_path / "run", tmp_path / "out", "rlds")
    assert report.columns_left_out == ()
    assert "joint_positions" in open_dataset(report.path).features.vectors


@pytest.mark.parametrize("options", [{"actions": "joint_position"}, {"state": "joint_positions"}])
def test_numbers_of_joints_that_differ_are_refused_by_the_names_of_the_robots(options, run, tmp_path):
    with pytest.raises(RecorderError, match=r"different joints: fr3 \(e\.g\. .*panda .*--where robot="):
        export(run, tmp_path / "out", "rlds", **options)


@pytest.mark.thorough
def test_processes_write_the_same_bytes(run, tmp_path):
    config = EXPORTERS["rlds"]().config(encoding="png")
    one, two = (export_bags("rlds", run, tmp_path / str(n), config, workers=n).path for n in (1, 2))
    assert {f.name: f.read_bytes() for f in one.rglob("*record*")} == {
        f.name: f.read_bytes() for f in two.rglob("*record*")
    }


def test_bc_reads_the_demonstrations_of_all(run, tmp_path):
    dataset = export(run, tmp_path / "out", "rlds", val_fraction=0.0).path
    reading = read_demonstrations(dataset, image_sizes={"workspace": 8})
    assert (reading.robot, len(reading.episodes)) == ("fr3+panda+xarm7", 4)
