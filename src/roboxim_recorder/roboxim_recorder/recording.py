"""Assembles an episode's messages tick by tick and writes each tick once it is whole.

Messages arrive raw and in any order of topics. A tick is whole when the sim's notice of it, every message that the
notice names, and the loop's step have arrived. It is then written in a fixed order. Undefined bytes and wall times do
not go into a bag, so two recordings of one episode are equal, byte for byte; this does not hold for topics that a user
adds. This module does not use rclpy.
"""

from __future__ import annotations

import json
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from operator import itemgetter
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from rosbags.serde import SerdeError

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_recorder import topics
from roboxim_recorder.bag_writer import RECEIVED_KEY, BagWriter
from roboxim_recorder.cdr import Cdr, CleanMessage, message_layout
from roboxim_ros.messages.conversions import stamp_to_ns
from roboxim_ros.messages.schemas import message_schema, typestore

P = ParamSpec("P")
R = TypeVar("R")
FLUSH_TICKS = 4
"""Ticks per chunk. Two 256 x 256 cameras, 53 ticks, measured: 7.2 MiB with one tick per chunk, 4.6 with four, 4.3 with
eight; at zstd's levels 1, 3 and 4: 6.8, 4.5, 4.4 MiB in 49, 72, 88 ms."""


@dataclass(frozen=True, kw_only=True)
class _Notice:
    """The sim's notice of a tick."""

    message: CleanMessage
    """The notice itself."""
    stamp_ns: int
    """The tick's stamp [ns]."""
    wanted: dict[str, int]
    """Topic, by its name in the bag, to the CRC-32 of the image on it; 0: not an image."""


@dataclass(frozen=True, kw_only=True)
class TickContent:
    """The messages of a whole tick, serialised."""

    messages: Mapping[str, memoryview]
    """The sim's messages by their topics in the bag, the notice among them, without undefined bytes (`CleanMessage`),
    as `roboxim_ros.messages.serialising` makes them (`tests/test_serialised_ticks.py` asserts it)."""
    step: memoryview
    """The loop's step, in the same way and without wall times (`topics.WALL_TIMES`)."""


def outcome_metadata(info: EpisodeInfo, result: EpisodeResult, received: Sequence[str] = ()) -> dict[str, str]:
    """Return the bag's metadata record of the episode, its outcome, and the instructions that the policy was given."""
    instructions = {RECEIVED_KEY: json.dumps(list(received))} if received else {}
    return instructions | {
        "outcome": result.outcome,
        "reason": result.reason,
        "instruction": info.task.instruction,
        "skill": info.task.skill,
        "ticks": str(result.last_seq + 1),
    }


def result_facts(info: EpisodeInfo, last_seq: int, state_hash: str) -> dict[str, object]:
    """Return the fields of an episode's result that follow from its info and its last tick, with their values.

    Args:
        info: The episode.
        last_seq: Its last tick.
        state_hash: Hash of that tick's state.
    """
    return {
        "episode_id": info.episode_id,
        "index": info.index,
        "attempt": info.attempt,
        "last_seq": last_seq,
        "instruction": info.task.instruction,
        "skill": info.task.skill,
        "final_state_hash": state_hash,
    }


def _alone(method: Callable[Concatenate[EpisodeRecording, P], R]) -> Callable[Concatenate[EpisodeRecording, P], R]:
    """Make a method run in one thread at a time per recording."""

    @wraps(method)
    def locked(self: EpisodeRecording, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._lock:
            return method(self, *args, **kwargs)

    return locked


class EpisodeRecording:
    """The bag of a running episode. Several threads may use it."""

    def __init__(
        self, output_dir: Path, info: EpisodeInfo, info_cdr: bytes, extra_topics: Mapping[str, str] | None = None
    ) -> None:
        """Open the bag and write the episode's info.

        Args:
            output_dir: The run's folder, absolute.
            info: Everything needed to reproduce the episode.
            info_cdr: The same as a serialised ``EpisodeInfo`` message.
            extra_topics: Topic to type of additional topics to record; a tick is whole without them.

        Raises:
            RoboximError: See `BagWriter`; ``INVALID_REQUEST`` on a message type that is not installed.
        """
        self._lock = threading.RLock()
        self.info = info
        self.expected = topics.scene_topics(info.scene)
        standard = {**topics.OWN, **self.expected}
        self.extra = {name: kind for name, kind in (extra_topics or {}).items() if name not in standard}
        kinds = {**standard, **self.extra}
        schemas = {topic: message_schema(kind) for topic, kind in kinds.items()}
        self._layouts = {topic: message_layout(schema) for topic, schema in schemas.items()}
        self._notice_store = typestore((schemas[topics.NOTICE],))
        self._next = 0
        self._last_stamp_ns = 0
        self._notices: dict[int, _Notice] = {}
        self._steps: dict[int, CleanMessage] = {}
        self._arrived: dict[tuple[str, int | None], tuple[int | None, CleanMessage]] = {}
        """Topic and stamp to the source's time and the message; the stamp is None for types without one."""
        self._stale_ns = -1
        self._last_state: Cdr = b""
        self._extras: deque[tuple[str, CleanMessage]] = deque()
        self._due: deque[tuple[int, int, Callable[[], TickContent], list[tuple[str, CleanMessage]]]] = deque()
        self._flush_due = False
        self._flush_error: RecorderError | None = None
        self._writer = BagWriter(output_dir, info.episode_id)
        for topic, schema in schemas.items():
            self._writer.add_topic(topic, schema)
        try:
            self._writer.write(topics.INFO, self._clean(topics.INFO, info_cdr).data, 0)
            self._writer.flush()
        except RecorderError:
            self._writer.drop()
            raise

    @property
    def path(self) -> Path:
        """Path of the growing bag."""
        return self._writer.partial

    @property
    def next_seq(self) -> int:
        """The first tick that is not yet in the bag."""
        return self._next

    @property
    def begun(self) -> bool:
        """Whether some messages of a tick that is not yet in the bag have arrived."""
        return bool(self._steps or self._notices)

    @property
    def complete(self) -> bool:
        """Whether every tick whose step has arrived is in the bag."""
        return not self._steps

    def wants(self, topic: str) -> bool:
        """Return whether a topic, by its name in the bag, is recorded."""
        return topic in self.expected or topic in self.extra

    @_alone
    def message(self, topic: str, cdr: bytes | memoryview, source_ns: int | None = None) -> list[int]:
        """Add a message.

        The sim publishes a tick's notice last. A message that it has published before the notice of another episode
        belongs to that one and is dropped, even if its stamp is that of a tick of this episode.

        Args:
            topic: Its name in the bag.
            cdr: The serialised message.
            source_ns: Time at which it was published [ns]; None: it is known to be of this episode.

        Returns:
            The ticks that this message completed; they need no further message. Acknowledge them, then call `flush`.

        Raises:
            RecorderError: ``EPISODE_GAP`` when a tick needs a topic that is not recorded, ``DISK`` when it cannot be
                written.
        """
        self._raise_flush_error()
        message = self._clean(topic, cdr)
        if topic in self.extra:
            self._extras.append((topic, message))
            return []
        if "episode_id" in message and message.text("episode_id") != self.info.episode_id:
            if topic == topics.NOTICE and source_ns is not None:
                self._drop_until(source_ns)
            return []
        if topic == topics.NOTICE:
            self._take_notice(message)
        elif topic == topics.STEP:
            self._steps[message.uint32("seq")] = message
        elif source_ns is None or source_ns > self._stale_ns:
            self._arrived[topic, message.stamp_ns()] = source_ns, message
        return self._write_whole_ticks()

    def _drop_until(self, source_ns: int) -> None:
        """Drop the sim's messages up to the notice of another episode; those that arrive later are dropped as well."""
        self._stale_ns = max(self._stale_ns, source_ns)
        self._arrived = {
            key: (sent_ns, message)
            for key, (sent_ns, message) in self._arrived.items()
            if sent_ns is None or sent_ns > self._stale_ns
        }

    def _clean(self, topic: str, cdr: bytes | memoryview) -> CleanMessage:
        try:
            message = self._layouts[topic].clean(cdr)
        except SerdeError as error:
            raise RecorderError(
                f"a message on {topic} cannot be read ({error}); is its publisher of another version?"
            ) from None
        for field in topics.WALL_TIMES.get(topic, ()):
            message.clear(field)
        return message

    def _take_notice(self, message: CleanMessage) -> None:
        notice: Any = self._notice_store.deserialize_cdr(bytes(message.data), message.name)
        names = [topics.absolute(name) for name in notice.topics]
        tick = f"tick {notice.seq} of '{self.info.episode_id}'"
        self._require_expected(tick, names)
        if len(names) != len(notice.image_crc32):
            raise RecorderError(
                f"{tick}: expected a checksum for each of {len(names)} topics, got {len(notice.image_crc32)}"
            )
        wanted = dict(zip(names, map(int, notice.image_crc32), strict=True))
        self._notices[notice.seq] = _Notice(message=message, stamp_ns=stamp_to_ns(notice.stamp), wanted=wanted)

    def _require_expected(self, tick: str, names: Iterable[str]) -> None:
        unknown = [name for name in names if name not in self.expected]
        if unknown:
            raise RecorderError(
                f"{tick} has messages on {', '.join(unknown)}, which are not recorded; the episode's scene has the "
                f"cameras {[c.name for c in self.info.scene.cameras]}",
                ErrorCode.EPISODE_GAP,
            )

    @_alone
    def add_tick(self, stamp_ns: int, content: Callable[[], TickContent]) -> None:
        """Add the next tick. The messages of a chunk's ticks are made together, when it ends: it costs less than half.

        Args:
            stamp_ns: Its stamp [ns].
            content: Returns the tick's messages; called by this method or by `close`.

        Raises:
            RecorderError: When a tick cannot be made, or an earlier `flush` failed.
        """
        self._raise_flush_error()
        extras = [self._extras.popleft() for _ in range(len(self._extras))]  # another thread may append
        self._due.append((self._next, stamp_ns, content, extras))
        self._next += 1
        if (self._next - 1) % FLUSH_TICKS == 0:
            self._write_due()
            self._raise_flush_error()

    def _write_due(self) -> None:
        """Make and write the messages of the added ticks, and store each chunk before the next one begins."""
        while self._due and self._flush_error is None:
            self.flush()
            seq, stamp_ns, content, extras = self._due.popleft()
            tick = f"tick {seq} of '{self.info.episode_id}'"
            try:
                made = content()
            except Exception as error:
                raise RecorderError(f"{tick} cannot be recorded: {type(error).__name__}: {error}") from error
            self._require_expected(tick, made.messages)
            notice = made.messages[topics.NOTICE]
            others = [(topic, made.messages[topic]) for topic in sorted(made.messages) if topic != topics.NOTICE]
            self._write(stamp_ns, notice, others, made.step)
            self._write_extras(extras)
            self._flush_due = seq % FLUSH_TICKS == 0

    def missing(self, seq: int) -> list[str]:
        """Return the names of the messages that tick ``seq`` lacks."""
        missing = [] if seq in self._steps else [topics.STEP]
        if seq not in self._notices:
            return [topics.NOTICE, *missing]
        notice = self._notices[seq]
        missing += [topic for topic in notice.wanted if self._found(topic, notice.stamp_ns) is None]
        if missing:
            return missing  # checksums are compared once, when all messages are there
        return [
            topic
            for topic, crc32 in notice.wanted.items()
            if crc32 and not self._is_image(topic, notice.stamp_ns, crc32)
        ]

    def _found(self, topic: str, stamp_ns: int) -> CleanMessage | None:
        found = self._arrived.get((topic, stamp_ns)) or self._arrived.get((topic, None))
        return None if found is None else found[1]

    def _is_image(self, topic: str, stamp_ns: int, crc32: int) -> bool:
        """Return whether an image belongs to the tick. If not, it is of an earlier scene and is dropped."""
        image = self._found(topic, stamp_ns)
        if image is not None and zlib.crc32(image.bytes_of("data")) == crc32:
            return True
        self._arrived.pop((topic, stamp_ns), None)
        return False

    def _write_whole_ticks(self) -> list[int]:
        written = []
        while self._next in self._notices and self._next in self._steps and not self.missing(self._next):
            self._write_arrived(self._next)
            written.append(self._next)
            self._next += 1
        return written

    @_alone
    def flush(self) -> None:
        """Compress and store the last ticks if they complete a chunk; call it while no caller waits for the recording.

        An error is raised by the next `message`, `add_tick` or `close`.
        """
        if not self._flush_due:
            return
        self._flush_due = False
        try:
            self._writer.flush()
        except RecorderError as error:
            self._flush_error = error
        except Exception as error:
            self._flush_error = RecorderError(
                f"the ticks of '{self.info.episode_id}' cannot be stored: {type(error).__name__}: {error}"
            )

    def _raise_flush_error(self) -> None:
        if self._flush_error is not None:
            raise self._flush_error

    def _write_arrived(self, seq: int) -> None:
        notice = self._notices.pop(seq)
        stamp = notice.stamp_ns
        found = {topic: self._found(topic, stamp) for topic in sorted(notice.wanted)}
        others = {topic: message for topic, message in found.items() if message is not None}
        assert others.keys() == found.keys(), found  # `missing` has checked this
        self._write_tick(seq, stamp, notice.message, others, self._steps.pop(seq))
        self._arrived = {
            (topic, of_ns): value
            for (topic, of_ns), value in self._arrived.items()
            if (topic not in others if of_ns is None else of_ns > stamp)
        }

    def _write_tick(
        self, seq: int, stamp_ns: int, notice: CleanMessage, others: Mapping[str, CleanMessage], step: CleanMessage
    ) -> None:
        self._write_due()
        self.flush()
        self._raise_flush_error()
        self._write(stamp_ns, notice.data, [(topic, message.data) for topic, message in others.items()], step.data)
        self._write_extras(self._extras)
        self._extras.clear()
        self._flush_due = seq % FLUSH_TICKS == 0

    def _write(self, stamp_ns: int, notice: Cdr, others: Iterable[tuple[str, Cdr]], step: Cdr) -> None:
        self._last_stamp_ns = stamp_ns
        self._writer.write(topics.NOTICE, notice, stamp_ns)
        for topic, message in others:
            self._writer.write(topic, message, stamp_ns)
            if topic == topics.STATE:
                self._last_state = message
        self._writer.write(topics.STEP, step, stamp_ns)

    def _write_extras(self, extras: Iterable[tuple[str, CleanMessage]]) -> None:
        """Write messages on additional topics, with the stamp of the last tick."""
        for topic, message in sorted(extras, key=itemgetter(0)):
            self._writer.write(topic, message.data, self._last_stamp_ns)

    @_alone
    def close(self, result: EpisodeResult, result_cdr: bytes, keep: str, received: Sequence[str] = ()) -> str:
        """Write the result and finish the bag; a bag with a gap is removed.

        Args:
            result: How the episode ended.
            result_cdr: The same as a serialised ``EpisodeResult`` message.
            keep: ``keep`` or ``set_apart``.
            received: Instructions that the policy was given, each once; empty: unknown.

        Returns:
            The bag's path relative to the run's folder.

        Raises:
            RecorderError: ``EPISODE_GAP`` naming the missing ticks and topics, ``DISK`` when it cannot be written. Or
                when the result is not that of the recorded episode.
        """
        if result.last_seq != self._next - 1:
            gap = self._name_gap(result.last_seq)
            self.drop()
            raise RecorderError(gap, ErrorCode.EPISODE_GAP)
        try:
            self._write_due()
            self.flush()
            self._raise_flush_error()
            self._require_own(result)
            self._write_extras(self._extras)
            self._writer.write(topics.RESULT, self._clean(topics.RESULT, result_cdr).data, self._last_stamp_ns)
        except RecorderError:
            self.drop()
            raise
        return self._writer.close(keep, outcome_metadata(self.info, result, received))

    def _require_own(self, result: EpisodeResult) -> None:
        """Refuse the result of another episode."""
        state_hash = (
            self._layouts[topics.STATE].clean(bytes(self._last_state)).text("state_hash") if self._last_state else ""
        )
        for name, recorded in result_facts(self.info, self._next - 1, state_hash).items():
            if (found := getattr(result, name)) != recorded:
                raise RecorderError(
                    f"'{self.info.episode_id}' is not kept: its result has {name} {found!r}, recorded was {recorded!r}"
                )

    def _name_gap(self, last_seq: int) -> str:
        if last_seq < self._next:
            return (
                f"'{self.info.episode_id}' ends with tick {last_seq}, but {self._next} ticks were recorded; "
                "the bag is not kept"
            )
        ticks = [f"tick {seq} lacks {', '.join(self.missing(seq))}" for seq in range(self._next, last_seq + 1)]
        shown = "; ".join(ticks[:5]) + (f"; and {len(ticks) - 5} more ticks" if len(ticks) > 5 else "")
        return f"'{self.info.episode_id}' has a gap and is not kept: {shown}"

    @_alone
    def drop(self) -> None:
        """Remove the bag."""
        self._flush_due = False
        self._writer.drop()
