"""The recorder node against publishers that behave as the sim and the evaluator do."""

from __future__ import annotations

import errno
import queue

import pytest
from rclpy.node import Node
from rclpy.serialization import serialize_message
from roboxim_interfaces import msg as ours
from roboxim_interfaces.srv import CloseEpisode, OpenEpisode
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, RoboximError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import McapFile
from roboxim_recorder.cdr import message_layout
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.node import RecorderNode
from roboxim_recorder.recording import FLUSH_TICKS
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.local import ticks as local_ticks
from roboxim_ros.local.recording import RECORD_ARRIVING, RECORD_STEP
from roboxim_ros.local.ticks import LocalTick
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.messages.schemas import message_schema
from roboxim_ros.testing import PATIENCE_S, eventually, graph_host  # noqa: F401

pytestmark = pytest.mark.ros
VOLATILE = 10
"""QoS by depth alone."""


class FakeGraph:
    """Publishes made-up episodes; camera publishers are made when the first image is, as the sim does."""

    def __init__(self, host):
        self.recorder = host.add(
            lambda context: RecorderNode(context=context, namespace="/w1", parameters={"output_root": "/"})
        )
        self.node = host.add(lambda context: Node("fake", context=context, namespace="/w1"))
        self.clients = Clients("fake_clients", context=host.context, namespace="/w1")
        self.acknowledged = queue.Queue()
        self.node.create_subscription(ours.RecordedTick, "recorder/recorded", self.acknowledged.put, qos.EVENTS)
        self.publishers = {}

    def publish(self, topic, message):
        if topic not in self.publishers:
            profile = qos.SENSOR if topic.startswith("/camera") or topic == "/evaluator/step" else qos.STATE
            self.publishers[topic] = self.node.create_publisher(type(message), topic[1:], profile)
        self.publishers[topic].publish(message)

    def open(self, episode, out, **options):
        info = to_msg(episode.info, ours.EpisodeInfo)
        request = OpenEpisode.Request(info=info, output_dir=str(out), **options)
        return self.clients.call(OpenEpisode, "recorder/open_episode", request)

    def tick(self, episode, seq, without=()):
        for topic, message in episode.tick(seq).items():
            if topic not in without:
                self.publish(topic, message)

    def acknowledgement(self):
        return self.acknowledged.get(timeout=PATIENCE_S)

    def play(self, episode):
        for seq in range(episode.last_seq + 1):
            self.tick(episode, seq)
            answer = self.acknowledgement()
            assert (answer.episode_id, answer.seq, answer.error_code) == (episode.info.episode_id, seq, 0)

    def close(self, episode, keep="keep"):
        request = CloseEpisode.Request(result=to_msg(episode.result, ours.EpisodeResult), keep=keep)
        return self.clients.call(CloseEpisode, "recorder/close_episode", request).bag


@pytest.fixture
def graph(graph_host):  # noqa: F811
    graph = FakeGraph(graph_host)
    yield graph
    graph.clients.close()


def test_episodes_are_recorded_one_after_another(graph, tmp_path, fake):
    for index in range(2):
        episode = fake(index=index)
        graph.open(episode, tmp_path)
        graph.play(episode)
        bag = graph.close(episode)
        assert bag == f"episodes/{episode.info.episode_id}"
        report = check_bag(tmp_path / bag)
        assert report.ok, report.problems
        reader = BagReader(tmp_path / bag)
        assert (reader.info, reader.result.bag, len(reader)) == (episode.info, bag, 8)
        assert reader.counts["/camera/wrist/image"] == 8


def test_what_was_published_before_an_episode_is_not_taken(graph, tmp_path, fake):
    episode = fake(steps=1, settle=0)
    graph.tick(episode, 0)
    graph.tick(episode, 1)
    graph.open(episode, tmp_path)
    graph.tick(episode, 0, without=("/joint_states",))
    eventually(lambda: graph.recorder._recording.missing(0) == ["/joint_states"])
    with pytest.raises(RecorderError, match="tick 0 lacks /joint_states; tick 1 lacks /sim/ticks") as caught:
        graph.close(episode)
    assert caught.value.code == ErrorCode.EPISODE_GAP
    assert list(tmp_path.rglob("*.mcap")) == []


def test_a_new_episode_removes_the_bag_of_a_dead_evaluator(graph, tmp_path, fake):
    graph.open(fake(index=1), tmp_path)
    graph.tick(fake(index=1), 0)
    graph.acknowledgement()
    episode = fake(index=2)
    graph.open(episode, tmp_path)
    assert [path.name for path in (tmp_path / ".partial").iterdir()] == [episode.info.episode_id]
    graph.play(episode)
    graph.close(episode, keep="set_apart")
    assert [path.parent.name for path in tmp_path.rglob("*.mcap")] == [episode.info.episode_id]
    with pytest.raises(RecorderError, match="no bag of 'demo-0-00001-0' is open") as caught:
        graph.close(fake(index=1))
    assert caught.value.code == ErrorCode.EPISODE_NOT_OPEN


def test_a_tick_that_cannot_be_recorded_is_answered(graph, tmp_path, fake):
    episode = fake()
    graph.open(episode, tmp_path)
    tick = episode.tick(0)
    tick["/sim/ticks"].topics = [*tick["/sim/ticks"].topics, "camera/third/image"]
    for topic in ("/sim/ticks", "/evaluator/step"):
        graph.publish(topic, tick[topic])
    answer = graph.acknowledgement()
    assert (answer.seq, answer.error_code) == (0, ErrorCode.EPISODE_GAP)
    assert "camera/third/image" in answer.error_msg
    assert graph.close(episode, keep="drop") == ""
    assert list(tmp_path.rglob("*.mcap")) == []


def test_a_disk_that_fills_up_between_ticks_is_answered(graph, tmp_path, fake, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    episode = fake()
    graph.open(episode, tmp_path)
    monkeypatch.setattr(McapFile, "flush", full)
    graph.tick(episode, 0)  # completes a chunk, which is written after the acknowledgement
    assert graph.acknowledgement().error_code == ErrorCode.OK
    graph.tick(episode, 1)
    answer = graph.acknowledgement()
    assert (answer.seq, answer.error_code) == (1, ErrorCode.DISK)
    assert "No space left" in answer.error_msg
    eventually(lambda: not list(tmp_path.rglob("*.mcap")))


def test_a_tick_whose_step_is_handed_over_is_recorded(graph, tmp_path, fake):
    """The rest of the tick may arrive later, and a step that others listen to arrives twice."""
    episode = fake()
    graph.open(episode, tmp_path)
    for seq in range(episode.last_seq + 1):
        assert not step(graph, episode, seq)
        call = graph.clients.send_local(RECORD_ARRIVING, episode.step(seq))
        for topic, message in episode.tick(seq).items():
            graph.publish(topic, message)
        graph.clients.value_of(call, RECORD_ARRIVING, PATIENCE_S)
    bag = graph.close(episode)
    report = check_bag(tmp_path / bag)
    assert report.ok, report.problems
    assert len(BagReader(tmp_path / bag)) == episode.last_seq + 1


def test_a_tick_of_a_sim_of_the_same_process_needs_no_middleware(graph, tmp_path, fake):
    """The bag has the bytes of one whose messages came from the middleware, wherever its steps come from."""
    episode = fake()

    def show_and_publish_step(seq):
        show(graph, episode, seq)
        graph.publish("/evaluator/step", episode.tick(seq)["/evaluator/step"])
        assert graph.acknowledgement().error_code == ErrorCode.OK

    bags = []
    for number, play_tick in enumerate((None, lambda seq: show_and_step(graph, episode, seq), show_and_publish_step)):
        graph.open(episode, tmp_path / str(number))
        if play_tick is None:
            graph.play(episode)
        else:
            for seq in range(episode.last_seq + 1):
                play_tick(seq)
        bags.append(next((tmp_path / str(number) / graph.close(episode)).glob("*.mcap")).read_bytes())
    assert bags[0] == bags[1] == bags[2]


def show(graph, episode, seq):
    """Show a tick as a sim of the same process does."""
    tick = {topic[1:]: message for topic, message in episode.tick(seq).items()}
    del tick["evaluator/step"]
    kinds = topics.scene_topics(episode.info.scene)
    layouts = {topic: message_layout(message_schema(kinds[topics.absolute(topic)])) for topic in tick}
    messages = {
        topic: memoryview(layouts[topic].clean(serialize_message(message)).data) for topic, message in tick.items()
    }
    shown = LocalTick(state=episode.state(seq), images={}, messages=lambda: messages)
    local_ticks.show(graph.node.context, "/w1/sim/ticks", shown)


def step(graph, episode, seq):
    """Hand a step over; return whether the recorder has taken the whole tick."""
    return graph.clients.value_of(graph.clients.send_local(RECORD_STEP, episode.step(seq)), RECORD_STEP, PATIENCE_S)


def show_and_step(graph, episode, seq):
    show(graph, episode, seq)
    assert step(graph, episode, seq)


def test_a_disk_that_fills_up_ends_an_episode_whose_ticks_are_taken(graph, tmp_path, fake, monkeypatch):
    """The chunk is stored while the episode goes on, which ends in the next chunk at the latest."""

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    episode = fake(steps=2 * FLUSH_TICKS)
    graph.open(episode, tmp_path)
    monkeypatch.setattr(McapFile, "flush", full)

    def play():
        for seq in range(2 * FLUSH_TICKS):
            show_and_step(graph, episode, seq)

    with pytest.raises(RoboximError, match="No space left") as raised:
        play()
    assert raised.value.code == ErrorCode.DISK
    assert graph.close(episode, keep="drop") == ""
    assert not list(tmp_path.rglob("*.mcap"))
    with pytest.raises(RoboximError, match="no bag") as raised:
        step(graph, episode, 1)
    assert raised.value.code == ErrorCode.EPISODE_NOT_OPEN


def test_a_step_that_cannot_be_recorded_is_refused(graph, tmp_path, fake, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def hand_over(seq):
        graph.tick(episode, seq, without=("/evaluator/step",))
        try:
            if not step(graph, episode, seq):
                call = graph.clients.send_local(RECORD_ARRIVING, episode.step(seq))
                graph.clients.value_of(call, RECORD_ARRIVING, PATIENCE_S)
        except RoboximError as error:
            return error.code, str(error)
        return ErrorCode.OK, ""

    episode = fake()
    assert hand_over(0)[0] == ErrorCode.EPISODE_NOT_OPEN
    graph.open(episode, tmp_path)
    monkeypatch.setattr(McapFile, "flush", full)
    assert hand_over(0) == (ErrorCode.OK, "")
    code, message = hand_over(1)
    assert code == ErrorCode.DISK
    assert "No space left" in message
    assert graph.close(episode, keep="drop") == ""
    assert not list(tmp_path.rglob("*.mcap"))


def test_bad_requests_are_refused(graph, tmp_path, fake):
    with pytest.raises(InvalidRequestError, match="absolute"):
        graph.open(fake(), "relative")
    with pytest.raises(InvalidRequestError, match="no node publishes it"):
        graph.open(fake(), tmp_path, topics=["nothing"])
    graph.open(fake(), tmp_path)
    with pytest.raises(InvalidRequestError, match="did you mean 'keep'"):
        graph.close(fake(), keep="kep")
    assert graph.close(fake(), keep="drop") == ""


def test_extra_topics_are_recorded(graph, tmp_path, fake):
    """A latched topic has a value from before the episode; a topic of another graph may have an equal name."""
    outer = graph.node.create_publisher(String, "/note", VOLATILE)
    inner = graph.node.create_publisher(String, "note", VOLATILE)
    graph.publish("/map", String(data="in force"))
    eventually(lambda: {"/note", "/w1/note", "/w1/map"} <= dict(graph.recorder.get_topic_names_and_types()).keys())
    for index, (topic, publisher) in enumerate((("note", inner), ("/note", outer), ("/w1/note", inner))):
        episode = fake(index=index)
        publisher.publish(String(data="before"))
        graph.open(episode, tmp_path, topics=[topic, "map"])
        eventually(lambda publisher=publisher: publisher.get_subscription_count() == 1)
        inner.publish(String(data="inner"))
        outer.publish(String(data="outer"))
        eventually(lambda: len(graph.recorder._recording._extras) == 2)
        graph.play(episode)
        reader = BagReader(tmp_path / graph.close(episode))
        found = {topic: message.data for topic, _, message in reader.messages(["/note", "/map"])}
        assert found == {"/note": "outer" if publisher is outer else "inner", "/map": "in force"}
    for twice in (["note", "/note"], ["/clock"]):
        graph.node.create_publisher(Clock, "/clock", 1)
        eventually(lambda: "/clock" in dict(graph.recorder.get_topic_names_and_types()))
        with pytest.raises(InvalidRequestError, match="in the bag it would have the name of /w1/"):
            graph.open(fake(index=9), tmp_path, topics=twice)


def test_messages_of_another_scene_are_not_taken_for_those_of_tick_0(graph, tmp_path, fake):
    """Both have the stamp 0: the sim was stepped between the opening of the bag and the loading of its scene."""
    episode = fake(steps=0, settle=0)
    graph.open(episode, tmp_path)
    stale = episode.tick(0)
    stale["/joint_states"].position = [9.0]
    stale["/sim/ticks"].episode_id = "other"
    for topic in ("/joint_states", "/sim/ticks"):
        graph.publish(topic, stale[topic])
    graph.tick(episode, 0, without=("/joint_states",))
    eventually(lambda: graph.recorder._recording.missing(0) == ["/joint_states"])
    graph.publish("/joint_states", episode.tick(0)["/joint_states"])
    assert graph.acknowledgement().error_code == ErrorCode.OK
    reader = BagReader(tmp_path / graph.close(episode))
    assert [list(message.position) for _, _, message in reader.messages(["/joint_states"])] == [[0.0]]


@pytest.mark.parametrize("field", ["instruction", "final_state_hash"])
def test_a_result_that_contradicts_the_recording_is_refused(graph, tmp_path, fake, field):
    episode = fake(steps=1, settle=0)
    graph.open(episode, tmp_path)
    graph.play(episode)
    request = CloseEpisode.Request(result=to_msg(episode.result, ours.EpisodeResult), keep="keep")
    setattr(request.result, field, "another")
    with pytest.raises(RecorderError, match=f"its result has {field} 'another'"):
        graph.clients.call(CloseEpisode, "recorder/close_episode", request)
    assert list(tmp_path.rglob("*.mcap")) == []
