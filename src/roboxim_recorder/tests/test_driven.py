"""A recording of a driven graph as a dataset: what becomes an episode, and what is named instead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from roboxim_interfaces import msg as ours

from roboxim_core.config import digest
from roboxim_core.errors import RecorderError
from roboxim_recorder.bag_writer import McapFile
from roboxim_recorder.cdr import message_layout
from roboxim_recorder.driven import DrivenDataset, is_driven
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.messages.schemas import message_schema

SCENE = ("/sim/scene", "roboxim_interfaces/msg/SceneSpec")
TOPICS = {
    SCENE[0]: SCENE[1],
    "/episode/info": "roboxim_interfaces/msg/EpisodeInfo",
    "/sim/state": "roboxim_interfaces/msg/StateRecord",
    "/camera/workspace/image": "sensor_msgs/msg/Image",
    "/camera/wrist/image": "sensor_msgs/msg/Image",
    "/joint_states": "sensor_msgs/msg/JointState",
}
NOTICES = {"/sim/ticks": "roboxim_interfaces/msg/TickNotice"}


def driven(folder, *drives, lost=(), scene=True, notices=True, early=0):
    """Write what bag record writes: a scene, then ticks.

    Args:
        folder: The bag.
        drives: What happened.
        lost: (topic, drive, tick), tick None: all.
        scene: Whether scenes are recorded.
        notices: Whether notices are.
        early: Messages of the drive before that are written after a scene.
    """
    file = McapFile(folder, folder.name)
    types = TOPICS | (NOTICES if notices else {})
    messages = []

    def write(topic, message, at):
        file.write(topic, message_layout(message_schema(types[topic])).clean(serialize_message(message)).data, at)

    for topic, kind in types.items():
        file.add_topic(topic, message_schema(kind))
    for number, drive in enumerate(drives):
        spec = replace(drive.scene, table=replace(drive.scene.table, center=(0.5, 0.01 * number, 0.0)))
        if scene:
            messages.insert(len(messages) - early if number else 0, (SCENE[0], to_msg(spec, ours.SceneSpec)))
        for seq in range(drive.last_seq + 1):
            for topic, message in drive.tick(seq).items():
                if topic == "/sim/state":
                    message.scene_hash = digest(spec)
                if topic in types and not {(topic, number, seq), (topic, number, None)} & set(lost):
                    messages.append((topic, message))
    for at, (topic, message) in enumerate(messages):
        write(topic, message, at)
    file.finish({})
    return folder


def test_ticks_become_steps_whose_actions_are_the_commands(fake, tmp_path):
    drive = fake(steps=5)
    dataset = DrivenDataset(driven(tmp_path / "bag", drive), "Wave")
    assert is_driven(tmp_path / "bag")
    assert not is_driven(drive.record(tmp_path / "run"))
    [episode] = dataset.episodes()
    assert (episode.success, episode.instruction, episode.fps) == (None, "Wave", 10.0)
    assert episode.semantics.control == "joint_position"
    steps = list(episode.steps())
    assert len(steps) == len(episode) == drive.last_seq
    for step in steps:
        after = drive.state(step.index + 1).robot
        np.testing.assert_allclose(step.action, [*after.joint_commands, after.gripper_command], rtol=1e-6)
        np.testing.assert_allclose(
            step.proprio["state"][0], drive.state(step.index).robot.pose_tcp_measured.position[0]
        )
        for camera, image in step.images.items():
            np.testing.assert_array_equal(image, drive.image(camera, step.index))
    [left] = [part for part in dataset.account.left_out if part.name == "/joint_states"]
    assert left.count == drive.last_seq + 1


@pytest.mark.parametrize("rate_hz", [12.0, 15.0, 24.0, 30.0])
def test_ticks_whose_stamps_are_rounded_are_one_episode_at_its_rate(fake, tmp_path, monkeypatch, rate_hz):
    scene = replace(fake().scene, control_rate_hz=rate_hz)
    monkeypatch.setattr(type(fake()), "scene", scene)
    monkeypatch.setattr(type(fake()), "stamp_ns", lambda self, seq: round(seq * 1e9 / rate_hz))
    drives = fake(index=0, steps=5), fake(index=1, steps=9)
    dataset = DrivenDataset(driven(tmp_path / "bag", *drives, lost={("/sim/state", 1, 0)}), "Wave")
    assert [len(episode) for episode in dataset.episodes()] == [7, 10]
    assert dataset.description.fps == rate_hz


def test_a_new_scene_and_lost_ticks_end_an_episode_and_are_named(fake, tmp_path):
    lost = {("/sim/state", 0, 3), ("/camera/wrist/image", 1, 2)}
    drives = fake(index=0, steps=5), fake(index=1, steps=5)
    dataset = DrivenDataset(driven(tmp_path / "bag", *drives, lost=lost), "Wave")
    episodes = list(dataset.episodes())
    assert [len(episode) for episode in episodes] == [2, 3, 1, 4]  # ticks 0-2, 4-7; then 0-1, 3-7
    first = next(episodes[2].steps()).images["wrist"]
    np.testing.assert_array_equal(first, drives[1].image("wrist", 0))
    said = {part.why: part.count for part in dataset.account.left_out if part.name == "/sim/state"}
    assert said == {"without an image of each camera": 1}


def test_images_that_were_lost_do_not_shift_those_of_later_scenes(fake, tmp_path):
    lost = {("/camera/wrist/image", 1, None), ("/camera/workspace/image", 1, None)}
    drives = [fake(index=10 * index, steps=5) for index in range(3)]
    dataset = DrivenDataset(driven(tmp_path / "bag", *drives, lost=lost), "Wave")
    first, last = dataset.episodes()
    for episode, drive in ((first, drives[0]), (last, drives[2])):
        for step in episode.steps():
            for camera, image in step.images.items():
                np.testing.assert_array_equal(image, drive.image(camera, step.index))
    said = {part.why: part.count for part in dataset.account.left_out if part.name == "/sim/state"}
    assert said == {"without an image of each camera": 8}
    with pytest.raises(RecorderError, match="24 states with images that may be of another scene: record /sim/ticks"):
        DrivenDataset(driven(tmp_path / "blind", *drives, lost=lost, notices=False), "Wave")


def test_states_belong_to_the_scene_whose_hash_they_have(fake, tmp_path):
    drives = fake(index=0, steps=5), fake(index=1, steps=5)
    ordered, stalled = (
        [
            (len(episode), [step.proprio["state"].tolist() for step in episode.steps()])
            for episode in DrivenDataset(driven(tmp_path / name, *drives, early=early), "Wave").episodes()
        ]
        for name, early in (("ordered", 0), ("stalled", 12))
    )
    assert ordered == stalled
    assert [length for length, _ in ordered] == [7, 7]


@pytest.mark.parametrize(
    ("without", "said"), [("/sim/scene", "has no scene: record /sim/scene"), ("", "no two successive")]
)
def test_what_cannot_be_an_episode_says_why(fake, tmp_path, without, said):
    drive = fake(steps=0, settle=0) if not without else fake()
    with pytest.raises(RecorderError, match=said):
        DrivenDataset(driven(tmp_path / "bag", drive, scene=not without), "Wave")


@pytest.mark.parametrize("format", ["lerobot", "rlds", "hdf5"])
def test_it_is_written_in_every_format_with_an_unknown_outcome(fake, tmp_path, format):
    from roboxim_datasets.formats import open_dataset
    from roboxim_datasets.plans import plan_of
    from roboxim_datasets.rewrite import write_dataset

    dataset = DrivenDataset(driven(tmp_path / "bag", fake(steps=5)), "Wave")
    written = write_dataset(plan_of(dataset), tmp_path / "out", format, how="convert")
    assert "/joint_states" in {part.name for part in written.left_out}
    episode = open_dataset(written.path).episode(0)
    assert (len(episode), episode.instruction, episode.success) == (7, "Wave", None)
    assert episode.semantics.control == "joint_position"
