"""A bag holds what was published, is readable by the usual readers, and is in its place only when whole."""

from __future__ import annotations

import errno
import random

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rclpy.serialization import serialize_message
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg
from rosbags.highlevel import AnyReader

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import BagWriter, McapFile
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.recording import TickContent
from roboxim_ros.messages.conversions import to_msg


def test_a_bag_gives_back_what_was_recorded(tmp_path, fake):
    episode = fake(index=3)
    path = episode.record(tmp_path)
    reader = BagReader(path)
    assert path == tmp_path / "episodes" / "demo-0-00003-0"
    assert reader.info == episode.info
    assert reader.result == episode.result
    assert reader.metadata["instruction"] == episode.instruction
    ticks = list(reader.ticks())
    assert len(ticks) == len(reader) == 8
    for seq, tick in enumerate(ticks):
        assert (tick.seq, tick.stamp_ns) == (seq, episode.stamp_ns(seq))
        assert tick.state == episode.state(seq)
        assert tick.step == episode.step(seq)
        for camera in ("workspace", "wrist"):
            np.testing.assert_array_equal(tick.images[camera], episode.image(camera, seq))
        np.testing.assert_array_equal(tick.depth["workspace"], episode.depth(seq))
        assert tick.segmentation == {}


def test_a_bag_tells_what_the_policy_received_if_the_loop_knows_it(tmp_path, fake):
    episode = fake()
    assert BagReader(episode.record(tmp_path / "old")).received == ()
    recording = episode.open(tmp_path)
    for topic, message in episode.messages():
        recording.message(topic, serialize_message(message))
    cdr = serialize_message(to_msg(episode.result, EpisodeResultMsg))
    bag = tmp_path / recording.close(episode.result, cdr, "keep", ("", 'Say "a"\nü'))
    assert BagReader(bag).received == ("", 'Say "a"\nü')
    assert check_bag(bag).ok, check_bag(bag)
    assert BagReader(bag).metadata["instruction"] == episode.instruction


@pytest.mark.parametrize("told", ["[1]", '"Pick up"', "["])
def test_a_damaged_list_of_received_instructions_is_found(tmp_path, fake, told):
    reader = BagReader(fake().record(tmp_path))
    reader.metadata["received"] = told
    with pytest.raises(RecorderError, match="is damaged"):
        _ = reader.received


def test_only_wanted_cameras_are_given(tmp_path, fake):
    reader = BagReader(fake().record(tmp_path))
    assert list(next(reader.ticks(cameras=["wrist"])).images) == ["wrist"]
    with pytest.raises(InvalidRequestError, match="no camera 'wirst'.*did you mean 'wrist'"):
        next(reader.ticks(cameras=["wirst"]))


def test_rosbags_and_mcap_read_it(tmp_path, fake):
    episode = fake()
    path = episode.record(tmp_path)
    with AnyReader([path]) as reader:
        assert reader.message_count == 8 * 11 + 2
        connections = [c for c in reader.connections if c.topic == "/camera/wrist/image"]
        for seq, (connection, stamp, raw) in enumerate(reader.messages(connections)):
            image = reader.deserialize(raw, connection.msgtype)
            assert stamp == episode.stamp_ns(seq)
            np.testing.assert_array_equal(image.data.reshape(16, 16, 3), episode.image("wrist", seq))
    with next(path.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        channel = next(iter(reader.get_summary().channels.values()))
    assert (topics[0], topics[-1]) == ("/episode/info", "/episode/result")
    assert metadata["roboxim"]["outcome"] == "success"
    assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
    text = (path / "metadata.yaml").read_text()
    description = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert (description["version"], description["message_count"]) == (9, 8 * 11 + 2)
    listed = {one["topic_metadata"]["name"]: one["message_count"] for one in description["topics_with_message_count"]}
    assert sum(listed.values()) == 8 * 11 + 2
    assert listed.keys() >= {"/episode/info", "/sim/ticks", "/sim/state"}
    assert text == yaml.dump(yaml.safe_load(text), sort_keys=False, width=200), "it is put together from kept parts"


def test_the_order_of_arrival_does_not_show(tmp_path, fake):
    episode = fake()
    files = []
    for seed in (1, 2):
        recording = episode.open(tmp_path / str(seed))
        for seq in range(episode.last_seq + 1):
            messages = [(topic, serialize_message(m)) for topic, m in episode.tick(seq).items()]
            random.Random(seed).shuffle(messages)
            done = [tick for topic, cdr in messages for tick in recording.message(topic, cdr)]
            assert done == [seq], "a tick is acknowledged once, when its last message is there"
        reader = BagReader(tmp_path / str(seed) / episode.close(recording))
        files.append([topic for topic, _, _ in reader.messages()])
    assert files[0] == files[1]


def test_another_episodes_messages_are_not_taken(tmp_path, fake):
    mine, other = fake(index=1), fake(index=2)
    recording = mine.open(tmp_path)
    for seq in range(mine.last_seq + 1):
        for topic, message in (*other.tick(seq).items(), *mine.tick(seq).items()):
            recording.message(topic, serialize_message(message))
    for seq, tick in enumerate(BagReader(tmp_path / mine.close(recording)).ticks()):
        np.testing.assert_array_equal(tick.images["wrist"], mine.image("wrist", seq))


def test_a_gap_is_refused_by_name_and_nothing_is_kept(tmp_path, fake):
    episode = fake()
    recording = episode.open(tmp_path)
    for seq in range(episode.last_seq + 1):
        for topic, message in episode.tick(seq).items():
            if (topic, seq) != ("/camera/wrist/image", 3):
                recording.message(topic, serialize_message(message))
    with pytest.raises(RecorderError, match="tick 3 lacks /camera/wrist/image; tick 4 lacks") as caught:
        episode.close(recording)
    assert caught.value.code == ErrorCode.EPISODE_GAP
    assert [path.name for path in tmp_path.rglob("*.mcap")] == []


def test_a_wrong_last_tick_is_refused(tmp_path, fake):
    episode = fake()
    recording = episode.open(tmp_path)
    for topic, message in episode.messages():
        recording.message(topic, serialize_message(message))
    with pytest.raises(RecorderError, match="ends with tick 2, but 8 ticks were recorded"):
        episode.close(recording, last_seq=2)


def test_a_topic_that_is_not_recorded_is_a_gap(tmp_path, fake):
    recording = fake().open(tmp_path)
    notice = fake().tick(0)["/sim/ticks"]
    notice.topics = [*notice.topics, "camera/third/image"]
    with pytest.raises(RecorderError, match="camera/third/image.*not recorded"):
        recording.message("/sim/ticks", serialize_message(notice))


def test_extra_topics_are_recorded_with_the_tick_that_they_came_in(tmp_path, fake):
    episode = fake(steps=1, settle=0)
    recording = episode.open(tmp_path, extra_topics={"/mine": "std_msgs/msg/String"})
    for seq in range(2):
        recording.message("/mine", b"\x00\x01\x00\x00\x03\x00\x00\x00hi\x00")
        for topic, message in episode.tick(seq).items():
            recording.message(topic, serialize_message(message))
    reader = BagReader(tmp_path / episode.close(recording))
    assert [(stamp, m.data) for _, stamp, m in reader.messages(["/mine"])] == [(0, "hi"), (100_000_000, "hi")]


@pytest.mark.parametrize("flushed", [True, False])
def test_extra_topics_are_recorded_with_the_tick_that_they_came_in_if_ticks_are_made_later(tmp_path, fake, flushed):
    episode = fake(steps=3, settle=0)
    recording = episode.open(tmp_path, extra_topics={"/mine": "std_msgs/msg/String"})
    for seq in range(4):
        recording.message("/mine", b"\x00\x01\x00\x00\x03\x00\x00\x00hi\x00")
        messages = {topic: memoryview(serialize_message(message)) for topic, message in episode.tick(seq).items()}
        content = TickContent(step=messages.pop(topics.STEP), messages=messages)
        recording.add_tick(seq * 100_000_000, lambda content=content: content)
        if flushed:
            recording.flush()
    reader = BagReader(tmp_path / episode.close(recording))
    assert [stamp for _, stamp, _ in reader.messages(["/mine"])] == [seq * 100_000_000 for seq in range(4)]


def test_a_tick_that_cannot_be_made_is_named(tmp_path, fake):
    def fail():
        raise ValueError("no such number")

    episode = fake()
    recording = episode.open(tmp_path)
    with pytest.raises(RecorderError, match=r"tick 0 of .* cannot be recorded: ValueError: no such number"):
        recording.add_tick(0, fail)
    recording.drop()


def test_an_episode_is_not_recorded_twice(tmp_path, fake):
    fake().record(tmp_path, keep="set_apart")
    with pytest.raises(RecorderError, match="set_apart/demo-0-00000-0 exists") as caught:
        fake().open(tmp_path)
    assert caught.value.code == ErrorCode.EPISODE_EXISTS


@pytest.mark.parametrize("name", ["", "../x", ".x", "a/b"])
def test_an_id_that_is_no_file_name_is_refused(tmp_path, name):
    with pytest.raises(InvalidRequestError, match="needs an id|must be letters, digits"):
        BagWriter(tmp_path, name)


@pytest.mark.parametrize("when", ["write", "close"])
def test_a_full_disk_leaves_nothing_behind(tmp_path, fake, monkeypatch, when):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    episode = fake()
    recording = episode.open(tmp_path)
    for topic, message in episode.messages():
        recording.message(topic, serialize_message(message))
    monkeypatch.setattr(McapFile, "write" if when == "write" else "finish", full)
    with pytest.raises(RecorderError, match="No space left.*free some space") as caught:
        episode.close(recording)
    assert caught.value.code == ErrorCode.DISK
    assert [path.name for path in tmp_path.rglob("*.mcap")] == []
