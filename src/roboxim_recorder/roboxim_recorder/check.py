"""Checks that a bag is whole: every byte, every tick, every topic, and the same episode throughout.

`check_bag` reads a bag once. It compares its parts with each other: the checksums, ``metadata.yaml``, the names of
folder and file, the metadata record, the first message (`EpisodeInfo`), every tick, the last message (`EpisodeResult`).
"""

from __future__ import annotations

import mmap
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import RoboximError
from roboxim_core.state import StateRecord
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, damage, mcap_file
from roboxim_recorder.bag_writer import FORMAT_VERSION, bag_description, mcap_name
from roboxim_recorder.cdr import CleanMessage, MessageLayout
from roboxim_recorder.container import container_problems, metadata_problems
from roboxim_recorder.recording import outcome_metadata
from roboxim_recorder.repair import REPAIRED
from roboxim_ros.conversions import from_msg, stamp_to_ns

T = TypeVar("T")

MOST_PROBLEMS = 50
"""Further problems of a bag are only counted."""


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """Result of a check."""

    path: Path
    """The bag."""
    episode_id: str = ""
    """Id of its episode; empty if not readable."""
    ticks: int = 0
    """Whole ticks read."""
    outcome: str = ""
    """``success``, ``failure`` or ``error``; empty when not readable."""
    problems: tuple[str, ...] = ()
    """What is wrong; empty: the bag is whole."""

    @property
    def ok(self) -> bool:
        """Whether the bag is whole."""
        return not self.problems


def check_bag(path: Path | str) -> BagReport:
    """Read a whole bag and report what is wrong with it.

    Damage never raises. A wrong checksum ends the check, since no content is reliable then.

    Args:
        path: The bag's folder or its MCAP file.

    Raises:
        ConfigError: When the path is not a bag.
    """
    problems: list[str] = []
    check = None
    try:
        file = mcap_file(path)
        problems += _checksum_problems(file)
        if not problems:
            check = _BagCheck(BagReader(file))
            problems += check.problems()
    except RoboximError as error:
        problems.append(str(error))
    if len(problems) > MOST_PROBLEMS:
        problems[MOST_PROBLEMS:] = [f"and {len(problems) - MOST_PROBLEMS} more problems"]
    return BagReport(
        path=Path(path),
        episode_id=check.info.episode_id if check and check.info else "",
        ticks=check.ticks if check else 0,
        outcome=check.result.outcome if check and check.result else "",
        problems=tuple(problems),
    )


def _checksum_problems(file: Path) -> list[str]:
    with damage(file), file.open("rb") as stream:
        if not file.stat().st_size:
            return ["its MCAP file is empty"]
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data, memoryview(data) as view:
            return list(container_problems(view))


class _BagCheck:
    """One pass over a bag whose checksums are right."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._layouts: dict[str, MessageLayout] = {}
        self._tick: dict[str, CleanMessage] = {}
        self._counts: Counter[str] = Counter()
        self._span_ns: tuple[int, int] | None = None
        self._last_hash = ""
        self._steps = 0
        self._ended = False
        self.info: EpisodeInfo | None = None
        self.result: EpisodeResult | None = None
        self.ticks = 0

    def problems(self) -> Iterator[str]:
        """Yield what is wrong."""
        with damage(self._reader.path):
            for channel, message in _records(self._reader.file):
                yield from self._message(channel.topic, message)
            yield from self._end_problems()
            yield from self._name_problems()
            yield from self._description_problems()

    def _message(self, topic: str, message: Message) -> Iterator[str]:
        self._counts[topic] += 1
        first, last = self._span_ns or (message.log_time, message.log_time)
        self._span_ns = min(first, message.log_time), max(last, message.log_time)
        if self._ended:
            yield f"a message on {topic} follows the episode's result"
        if self.info is None:
            yield from self._begin(topic, message)
        elif topic == topics.INFO:
            yield f"it has more than one message on {topics.INFO}"
        elif topic == topics.RESULT:
            self.result, self._ended = self._value(topic, message.data, EpisodeResult), True
        elif topic in self._expected:
            yield from self._tick_message(topic, message)

    def _begin(self, topic: str, message: Message) -> Iterator[str]:
        if topic != topics.INFO:
            yield f"its first message is on {topic}, expected {topics.INFO}"
        self.info = self._reader.info
        self._expected = topics.scene_topics(self.info.scene)
        for name, kind in {**topics.OWN, **self._expected}.items():
            found = self._reader.types.get(name)
            if found != kind:
                yield f"topic {name} is {f'of type {found}' if found else 'missing'}, expected {kind}"

    def _value(self, topic: str, cdr: bytes, cls: type[T]) -> T:
        value: T = from_msg(self._reader.decode(topic, cdr), cls)
        return value

    def _tick_message(self, topic: str, message: Message) -> Iterator[str]:
        if topic in self._tick:
            yield f"tick {self.ticks} has two messages on {topic}"
        if topic not in self._layouts:
            self._layouts[topic] = self._reader.layout(topic)
        clean = self._tick[topic] = self._layouts[topic].clean(message.data)
        stamp = clean.stamp_ns()
        if not message.log_time == message.publish_time == (message.log_time if stamp is None else stamp):
            yield f"tick {self.ticks}: a message on {topic} is stamped {stamp} ns, recorded at {message.log_time} ns"
        if topic == topics.STEP:  # the last message of every tick
            yield from self._tick_problems(message.log_time)
            self._tick = {}
            self.ticks += 1

    def _tick_problems(self, stamp_ns: int) -> Iterator[str]:
        assert self.info is not None
        seq, tick = self.ticks, self._tick
        missing = [name for name in (topics.NOTICE, topics.STATE) if name not in tick]
        if missing:
            yield f"tick {seq} lacks {', '.join(missing)}"
            return
        step = self._value(topics.STEP, bytes(tick[topics.STEP].data), EpisodeStep)
        state = self._value(topics.STATE, bytes(tick[topics.STATE].data), StateRecord)
        notice = self._reader.decode(topics.NOTICE, bytes(tick[topics.NOTICE].data))
        if not seq == step.seq == state.seq == notice.seq:
            yield (
                f"tick {seq} has the notice of tick {notice.seq}, the state of tick {state.seq} and the step of tick "
                f"{step.seq}"
            )
        others = {step.episode_id, state.episode_id, notice.episode_id} - {self.info.episode_id}
        if others:
            yield f"tick {seq} is of another episode: {', '.join(map(repr, sorted(others)))}"
        if not stamp_ns == stamp_to_ns(notice.stamp) == seq * self.info.scene.tick_ns:
            yield f"tick {seq} is stamped {stamp_ns} ns, expected {seq * self.info.scene.tick_ns}"
        wanted = dict(zip(map(topics.absolute, notice.topics), map(int, notice.image_crc32), strict=True))
        there = tick.keys() - {topics.NOTICE, topics.STEP}
        if missing := sorted(wanted.keys() - there):
            yield f"tick {seq} lacks {', '.join(missing)}"
        if extra := sorted(there - wanted.keys()):
            yield f"tick {seq} has messages that its notice does not name: {', '.join(extra)}"
        for topic, crc32 in wanted.items():
            if crc32 and topic in tick and zlib.crc32(tick[topic].bytes_of("data")) != crc32:
                yield f"tick {seq}: the image on {topic} is not the one that its notice names"
        self._last_hash = state.state_hash
        self._steps += step.phase == "act"

    def _end_problems(self) -> Iterator[str]:
        """Yield where the result differs from the messages."""
        info, result, reader = self.info, self.result, self._reader
        if self._tick:
            yield f"it ends within tick {self.ticks}: {', '.join(sorted(self._tick))}"
        if info is None or result is None:
            what = topics.RESULT if info else topics.INFO
            yield f"it has no message on {what}: its recording was interrupted"
            return
        expected = {
            "episode_id": info.episode_id,
            "index": info.index,
            "attempt": info.attempt,
            "last_seq": self.ticks - 1,
            "steps": self._steps,
            "instruction": info.task.instruction,
            "skill": info.task.skill,
            "final_state_hash": self._last_hash,
        }
        for name, value in expected.items():
            found = getattr(result, name)
            if found != value:
                yield f"its result has {name} {found!r}, expected {value!r}"
        if result.bag and Path(result.bag).name != info.episode_id:
            yield f"its result is that of the bag {result.bag}"
        wanted = {"format_version": FORMAT_VERSION, "episode_id": info.episode_id, **outcome_metadata(info, result)}
        found = reader.metadata
        for key in sorted(wanted.keys() | found.keys()):
            if wanted.get(key) != found.get(key):
                yield f"its metadata record has {key} {found.get(key)!r}, expected {wanted.get(key)!r}"

    def _name_problems(self) -> Iterator[str]:
        """Yield where the names of folder and file differ from the episode."""
        if self.info is None:
            return
        file, name = self._reader.file.absolute(), self.info.episode_id
        if self._reader.metadata.get("repaired") == "true":
            name += REPAIRED
        if file.parent.name != name:
            yield f"its folder is named {file.parent.name}, but it holds episode '{self.info.episode_id}'"
        if file.name != mcap_name(name):
            yield f"its file is named {file.name}, expected {mcap_name(name)}"

    def _description_problems(self) -> Iterator[str]:
        """Yield where the summary and ``metadata.yaml`` differ from the messages."""
        reader = self._reader
        for topic, count in reader.counts.items():
            if count != self._counts[topic]:
                yield f"its summary counts {count} messages on {topic}, there are {self._counts[topic]}"
        described = {
            topic: (kind, reader.type_hashes[topic], self._counts[topic]) for topic, kind in reader.types.items()
        }
        expected = bag_description(reader.file.name, described, self._span_ns or (0, 0), reader.metadata)
        yield from metadata_problems(reader.file.parent, expected)


def _records(file: Path) -> Iterator[tuple[Channel, Message]]:
    """Yield the messages of a file in the order of recording."""
    channels: dict[int, Channel] = {}
    with file.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                yield channels[record.channel_id], record
