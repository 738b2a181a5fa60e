"""The recorder node: one bag per episode, from the raw messages of the graph.

Publishers of a tick and these subscriptions are transient local, so a tick that is published before both ends have
matched still arrives. Messages that were published before the episode was opened are recognised by their source
timestamps and ignored. Subscriptions are created once and kept, because matching takes time. A tick's messages are
taken together when the loop's step arrives, which ends the tick: waking for each message would slow the sim down.

An additional topic that is latched has a value that is in force when the episode begins. Its subscription is made anew
for each episode, so that the value is received again and recorded.

An evaluator of the same process hands the step over by a call (`roboxim_ros.local.recording`), whose answer replaces
the acknowledgement. The same steps may also arrive as messages, if there are other subscribers; these are then ignored.

A sim of the same process, started before the recorder, provides its ticks as values (`roboxim_ros.local.ticks`). The
recorder then does not subscribe to its topics; it keeps the values and makes a chunk's messages together. The
evaluator's thread does this, and it compresses and stores the chunk while the sim computes the next tick: the other
cores are idle then, and compressing leaves Python to the sim. A separate thread of the recorder would get the
interpreter too late, while the sim draws, which needs all cores.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from rclpy.validate_topic_name import validate_topic_name
from roboxim_interfaces.msg import EpisodeInfo as EpisodeInfoMsg
from roboxim_interfaces.msg import EpisodeStep as EpisodeStepMsg
from roboxim_interfaces.msg import RecordedTick
from roboxim_interfaces.srv import CloseEpisode, OpenEpisode

from roboxim_core import limits
from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, RoboximError, one_of
from roboxim_core.user_folders import expanded
from roboxim_recorder import topics
from roboxim_recorder.bag_writer import bag_path
from roboxim_recorder.output_root import require_inside
from roboxim_recorder.recording import EpisodeRecording, TickContent
from roboxim_ros import qos
from roboxim_ros.local import ticks as local_ticks
from roboxim_ros.local.recording import RECORD_ARRIVING, RECORD_RECEIVED, RECORD_STEP, RECORD_STORE
from roboxim_ros.local.ticks import LocalTick
from roboxim_ros.messages.conversions import from_msg
from roboxim_ros.messages.serialising import to_cdr
from roboxim_ros.node import RoboximNode, parameter
from roboxim_ros.on_demand import OnDemandGroup

TICK_S = 30.0
"""Longest wait for the rest of a tick whose step has been handed over [s]."""
RETRY_S = 0.0005
"""Time between two checks for it [s]."""
_NO_WALL_TIMES: dict[str, Any] = dict.fromkeys(topics.WALL_TIMES[topics.STEP], 0.0)


@dataclass(frozen=True, kw_only=True)
class RecorderConfig:
    """Parameters of the recorder node."""

    output_root: str = parameter(".", "folder that every bag must be in; relative: to where the node was started")
    """Folder that contains the bags of all requests."""


class RecorderNode(RoboximNode):
    """Serves ``recorder/open_episode`` and ``recorder/close_episode``; acknowledges ticks on ``recorder/recorded``."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Make the node; see `RoboximNode`."""
        super().__init__("recorder", context=context, namespace=namespace, parameters=parameters)
        self._root = expanded(self.declare_config(RecorderConfig).output_root).absolute()
        self._recording: EpisodeRecording | None = None
        self._failed = ""
        self._opened_ns = 0
        self._called = False  # whether the open episode's steps come by calls
        self._received: tuple[str, tuple[str, ...]] = ("", ())
        self._fault: RoboximError | None = None
        self._subscribed: dict[str, tuple[tuple[str, str, QoSProfile], Subscription]] = {}
        self._latched: set[str] = set()  # additional topics whose values from before the episode belong to it
        self._recorded_out = self.create_publisher(RecordedTick, "recorder/recorded", qos.EVENTS)
        self._info_out = self.create_publisher(EpisodeInfoMsg, "episode/info", qos.LATCHED)
        self._notices = self.resolve_topic_name(topics.NOTICE[1:])
        self._of_ticks = OnDemandGroup()
        self._subscribe_ticks(topics.ALWAYS)
        self.serve(OpenEpisode, "recorder/open_episode", self._on_open)
        self.serve(CloseEpisode, "recorder/close_episode", self._on_close)
        self.offer(RECORD_STEP, self._on_step_call, inline=True)
        self.offer(RECORD_ARRIVING, self._on_arriving_call)
        self.offer(RECORD_RECEIVED, self._on_received_call)
        self.offer(RECORD_STORE, self._on_store_call, inline=True)

    def destroy_node(self) -> None:
        """Destroy the node; an open bag is removed."""
        self._abort("the recorder is stopped")
        super().destroy_node()

    def _on_open(self, request: OpenEpisode.Request, response: OpenEpisode.Response) -> None:
        info = from_msg(request.info, EpisodeInfo)
        if self._recording is not None:
            self._abort(f"'{info.episode_id}' is opened")
        extra = self._extra_topics(request.topics, {**topics.OWN, **topics.scene_topics(info.scene)})
        recording = EpisodeRecording(
            require_inside(request.output_dir, self._root),
            info,
            serialize_message(request.info),
            {topic: kind for topic, (_, kind) in extra.items()},
        )
        self._opened_ns = time.time_ns()
        self._failed = ""
        self._called = False
        self._subscribe_ticks(recording.expected)
        self._latched = set()
        self._recording = recording
        for topic in recording.extra:
            self._subscribe_extra(topic, *extra[topic])
        self._info_out.publish(request.info)
        response.bag = str(recording.path)

    def _on_close(self, request: CloseEpisode.Request, response: CloseEpisode.Response) -> None:
        episode_id = request.result.episode_id
        recording = self._recording
        if recording is None or recording.info.episode_id != episode_id:
            if request.keep == "drop" and episode_id == self._failed:
                return
            raise self._not_open(episode_id)
        if request.keep == "drop":
            self._abort("it is dropped on request")
            return
        request.result.bag = bag_path(episode_id, request.keep)
        result = from_msg(request.result, EpisodeResult)
        self._recording = None
        received_for, received = self._received
        response.bag = recording.close(
            result, serialize_message(request.result), request.keep, received if received_for == episode_id else ()
        )

    def _on_received_call(self, received: tuple[str, tuple[str, ...]]) -> None:
        self._received = received

    def _not_open(self, episode_id: str) -> RecorderError:
        return RecorderError(
            f"no bag of '{episode_id}' is open"
            + (f", but one of '{self._recording.info.episode_id}'" if self._recording else "")
            + "; call recorder/open_episode first",
            ErrorCode.EPISODE_NOT_OPEN,
        )

    def _abort(self, why: str) -> None:
        if self._recording is not None:
            recording, self._recording = self._recording, None
            recording.drop()
            self.get_logger().warning(f"the bag of '{recording.info.episode_id}' is removed: {why}")

    # ---------------------------------------------------------------- messages

    def _subscribe_ticks(self, expected: Mapping[str, str]) -> None:
        """Subscribe to the topics of ticks, given with their types by their names in the bag.

        Only the step wakes the node. A sim of this process provides its ticks without topics.
        """
        local = local_ticks.announced(self.context, self._notices)
        for topic, kind in expected.items():
            if topic == topics.STEP:
                self._subscribe(topic, self.resolve_topic_name(topic[1:]), kind, qos.EVENTS)
            elif not local:
                self._subscribe(topic, self.resolve_topic_name(topic[1:]), kind, qos.EVENTS, self._of_ticks)

    def _subscribe_extra(self, topic: str, full: str, kind: str) -> None:
        """Subscribe to an additional topic; again if it is latched, to receive the value that is in force."""
        published = self.count_publishers(full) > 0
        profile = qos.offered(self, full, qos.RECORDING.depth) if published else qos.RECORDING
        if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._latched.add(topic)
            if topic in self._subscribed:
                self.destroy_subscription(self._subscribed.pop(topic)[1])
        self._subscribe(topic, full, kind, profile)

    def _subscribe(
        self, topic: str, full: str, kind: str, profile: QoSProfile, group: CallbackGroup | None = None
    ) -> None:
        """Subscribe to a topic, unless that is done; another source, type or QoS replaces it.

        Args:
            topic: Its name in the bag.
            full: Its full name in the graph.
            kind: Its type.
            profile: QoS of the subscription.
            group: Callback group; none: the node's.
        """
        source = full, kind, profile
        known = self._subscribed.get(topic)
        if known is not None:
            if known[0] == source:
                return
            self.destroy_subscription(known[1])
        subscription = self.subscribe(
            _message_class(kind), full, self._callback(topic), profile, raw=True, callback_group=group
        )
        self._subscribed[topic] = (source, subscription)

    def _callback(self, topic: str) -> Callable[[bytes, dict[str, Any]], None]:
        def received(cdr: bytes, info: dict[str, Any]) -> None:  # two parameters: rclpy then passes the source's time
            if topic == topics.STEP and self._called:
                return
            self._on_message(topic, cdr, info["source_timestamp"])
            if topic == topics.STEP:
                self._of_ticks.take()
            if topic == topics.STEP or self._of_ticks.open:  # then the rest of the tick is received as it arrives
                self._of_ticks.open = self._recording is not None and not self._recording.complete

        return received

    def _on_message(self, topic: str, cdr: bytes | memoryview, source_ns: int) -> None:
        recording = self._recording
        if recording is None or not recording.wants(topic):
            return
        if source_ns < self._opened_ns and topic not in self._latched:
            return
        try:
            if topic == topics.STEP:
                self._take_shown(recording, cdr)
            whole = recording.message(topic, cdr, source_ns)
            if not self._called:
                for seq in whole:
                    self._recorded_out.publish(RecordedTick(episode_id=recording.info.episode_id, seq=seq))
                recording.flush()  # while the simulator continues
        except RoboximError as error:
            self._drop_faulty(recording, error)
            if not self._called:
                self._recorded_out.publish(_refusal(recording, error))

    def _take_shown(self, recording: EpisodeRecording, step_cdr: bytes | memoryview) -> None:
        """Give the recording the tick of a step that came as a message, if a sim of this process shows it."""
        step = deserialize_message(bytes(step_cdr), EpisodeStepMsg)
        tick = local_ticks.shown(self.context, self._notices, step.episode_id, int(step.seq))
        if tick is not None:
            for topic, cdr in tick.messages().items():
                recording.message(topics.absolute(topic), cdr)

    def _drop_faulty(self, recording: EpisodeRecording, error: RoboximError) -> None:
        self._fault, self._failed = error, recording.info.episode_id
        self._abort(str(error))

    def _on_step_call(self, step: EpisodeStep) -> bool:
        """Take the values of the tick that a step ends, in the thread of the evaluator.

        Returns:
            Whether it was taken. If not, its messages come from the middleware: call `_on_arriving_call`.
        """
        recording = self._open_recording(step)
        tick = local_ticks.shown(self.context, self._notices, step.episode_id, step.seq)
        if tick is None or recording.next_seq != step.seq:
            return False
        try:
            recording.add_tick(step.stamp_ns, lambda: _content(tick, step))
        except RoboximError as error:
            self._drop_faulty(recording, error)
            raise
        return True

    def _on_store_call(self) -> None:
        """Store the last chunk, if that is not done, in the thread of the evaluator."""
        recording = self._recording
        if recording is not None:
            recording.flush()

    def _on_arriving_call(self, step: EpisodeStep) -> None:
        """Record the tick that a step ends, whose messages come from the middleware."""
        recording = self._open_recording(step)
        self._record_arriving(recording, step)
        if self._fault is not None:
            raise self._fault

    def _open_recording(self, step: EpisodeStep) -> EpisodeRecording:
        recording = self._recording
        if recording is None or recording.info.episode_id != step.episode_id:
            raise self._not_open(step.episode_id)
        self._called, self._fault = True, None
        return recording

    def _record_arriving(self, recording: EpisodeRecording, step: EpisodeStep) -> None:
        """Record the tick whose messages come from the middleware."""
        self._of_ticks.take()
        if recording.next_seq <= step.seq:  # the message may arrive before the first call
            self._on_message(topics.STEP, _step_cdr(step), self._opened_ns)
        deadline = time.monotonic() + TICK_S
        while self._fault is None and recording.next_seq <= step.seq:
            if time.monotonic() > deadline:
                raise RecorderError(
                    f"tick {step.seq} of '{step.episode_id}' lacks {', '.join(recording.missing(step.seq))} "
                    f"after {TICK_S:g} s; is the sim's publisher alive?",
                    ErrorCode.EPISODE_GAP,
                )
            time.sleep(RETRY_S)
            self._of_ticks.take()

    # ---------------------------------------------------------------- extra topics

    def _extra_topics(self, names: Sequence[str], standard: Mapping[str, str]) -> dict[str, tuple[str, str]]:
        """Return the name in the bag of additional topics, with the full name in the graph and the type.

        Args:
            names: Their names in the request.
            standard: Topics that the episode has anyway, by their names in the bag.

        Raises:
            InvalidRequestError: When a topic has no publisher, or its name in the bag is that of another one.
        """
        found: dict[str, tuple[str, str]] = {}
        for name in names:
            full, kind = self._source_of(name)
            topic = topics.absolute(full.removeprefix(f"{self.get_namespace().rstrip('/')}/"))
            own = self.resolve_topic_name(topic[1:])
            other = found[topic][0] if topic in found else own if topic in standard else full
            if other != full:
                raise InvalidRequestError(
                    f"cannot record topic '{name}': in the bag it would have the name of {other}; record one of them"
                )
            found[topic] = full, kind
        return found

    def _source_of(self, name: str) -> tuple[str, str]:
        """Return the full name and the type of a topic that has a publisher."""
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            raise InvalidRequestError(f"cannot record topic {limits.echo(name)}: {error}") from None
        full = self.resolve_topic_name(name)
        found = dict(self.get_topic_names_and_types())
        if full not in found:
            raise InvalidRequestError(f"cannot record topic '{name}': no node publishes it; {one_of(found, full)}")
        return full, str(found[full][0])


def _content(tick: LocalTick, step: EpisodeStep) -> TickContent:
    """Return the messages of a tick of this process."""
    messages = {topics.absolute(topic): cdr for topic, cdr in tick.messages().items()}
    return TickContent(messages=messages, step=_step_cdr(replace(step, **_NO_WALL_TIMES)))


def _step_cdr(step: EpisodeStep) -> memoryview:
    return to_cdr(step, topics.ALWAYS[topics.STEP])


def _refusal(recording: EpisodeRecording, error: RoboximError) -> RecordedTick:
    """Return the acknowledgement of a tick that cannot be recorded."""
    return RecordedTick(
        episode_id=recording.info.episode_id,
        seq=recording.next_seq,
        error_code=int(error.code),
        error_msg=str(error),
    )


def _message_class(kind: str) -> Any:
    package, _, name = kind.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)
