"""Checks that a bag is whole: every byte, every tick, every topic, and the same episode throughout.

`check_bag` reads a bag once. It compares its parts with each other: the checksums, ``metadata.yaml``, the names of
folder and file, the metadata record, the first message (`EpisodeInfo`), every tick, the last message (`EpisodeResult`).
"""

from __future__ import annotations

import mmap
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from roboxim_core import limits
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import RoboximError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, NotAnEpisodeError, damage, mcap_file, not_an_episode
from roboxim_recorder.bag_writer import FORMAT_VERSION, REPAIRED, REPAIRED_KEY, bag_description, mcap_name
from roboxim_recorder.integrity.container import container_problems, metadata_problems
from roboxim_recorder.integrity.ticks import TickCheck
from roboxim_recorder.recording import outcome_metadata
from roboxim_ros.messages.conversions import from_msg

MAX_PROBLEMS = 50
"""Number of problems that are listed; further ones are only counted."""
MAX_NAMES = 3
"""Number of listed differences in names and descriptions that another program caused; further ones are only counted."""


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
    reason: str = ""
    """Reason why it is not a success."""
    problems: tuple[str, ...] = ()
    """Faults; empty: the bag is whole."""
    notes: tuple[str, ...] = ()
    """Changes by another program that wrote the bag again, which affect no reader; empty: the recorder wrote it."""
    foreign: bool = False
    """Whether it is a bag of another system, without an episode."""

    @property
    def ok(self) -> bool:
        """Whether the bag is whole."""
        return not self.problems


def check_bag(path: Path | str) -> BagReport:
    """Read a whole bag and report its faults.

    Damage never raises. A wrong checksum ends the check, since no content is reliable then.

    Args:
        path: The bag's folder or its MCAP file.

    Raises:
        ConfigError: When the path is not a bag.
    """
    problems: list[str] = []
    check = None
    foreign = False
    try:
        file = mcap_file(path)
        problems += checksum_problems(file)
        if not problems:
            check = _BagCheck(BagReader(file))
            problems += check.problems()
    except RoboximError as error:
        problems.append(str(error))
        foreign = isinstance(error, NotAnEpisodeError)
    if len(problems) > MAX_PROBLEMS:
        problems[MAX_PROBLEMS:] = [f"and {len(problems) - MAX_PROBLEMS} more problems"]
    return BagReport(
        path=Path(path),
        episode_id=check.info.episode_id if check and check.info else "",
        ticks=check.ticks if check else 0,
        outcome=check.result.outcome if check and check.result else "",
        reason=check.result.reason if check and check.result else "",
        problems=tuple(problems),
        notes=tuple(check.notes) if check else (),
        foreign=foreign,
    )


def checksum_problems(file: Path) -> list[str]:
    """Return the faults that the checksums of an MCAP file show; no message is decoded.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it cannot be read.
    """
    with damage(file), file.open("rb") as stream:
        if not file.stat().st_size:
            return ["its MCAP file is empty"]
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data, memoryview(data) as view:
            return list(container_problems(view))


class _BagCheck:
    """One pass over a bag whose checksums are right."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._check: TickCheck | None = None
        self._counts: Counter[str] = Counter()
        self._span_ns: tuple[int, int] | None = None
        self.result: EpisodeResult | None = None
        self.notes: list[str] = []

    @property
    def info(self) -> EpisodeInfo | None:
        return self._check.info if self._check else None

    @property
    def ticks(self) -> int:
        return self._check.ticks if self._check else 0

    def problems(self) -> Iterator[str]:
        """Yield the faults."""
        if topics.INFO not in self._reader.types:
            raise not_an_episode(self._reader.path, self._reader.counts)
        with damage(self._reader.path):
            for channel, message in _records(self._reader.file):
                yield from self._message(channel.topic, message)
            yield from self._end_problems()
            yield from self._count_problems()
            names = [*self._name_problems(), *self._description_problems()]
            if not self._reader.rewritten:
                yield from (*self._metadata_problems(), *names)
                return
            if self._reader.metadata:
                yield from self._metadata_problems()
        self._note(names)

    def _note(self, names: list[str]) -> None:
        """Note changes by another program that affect no reader."""
        self.notes.append(f"written again by {limits.printable(self._reader.library) or 'another program'}")
        if not self._reader.metadata:
            self.notes.append("without the metadata record, which repeats what its messages say")
        if self._check is not None and self._check.filtered:
            self.notes.append(f"filtered out, and not needed by exports: {', '.join(self._check.filtered)}")
        self.notes += names[:MAX_NAMES]
        if len(names) > MAX_NAMES:
            self.notes.append(f"and {len(names) - MAX_NAMES} more differences of names and metadata.yaml")

    def _message(self, topic: str, message: Message) -> Iterator[str]:
        self._counts[topic] += 1
        first, last = self._span_ns or (message.log_time, message.log_time)
        self._span_ns = min(first, message.log_time), max(last, message.log_time)
        if self.result is not None:
            yield f"a message on {topic} follows the episode's result"
        if self._check is None:
            if topic != topics.INFO:
                yield f"its first message is on {topic}, expected {topics.INFO}"
            self._check = TickCheck(self._reader.decoder, self._reader.info)
            yield from self._check.topic_problems()
        elif topic == topics.INFO:
            yield f"it has more than one message on {topics.INFO}"
        elif topic == topics.RESULT:
            self.result = from_msg(self._reader.decode(topic, message.data), EpisodeResult)
        elif topic in self._check.expected:
            yield from self._check.message(topic, message)

    def _end_problems(self) -> Iterator[str]:
        """Yield differences between the result and the messages."""
        check, result = self._check, self.result
        actors = self._counts[topics.ACTED_BY]
        if actors and result is not None and actors != result.steps:
            yield f"it names the actor of {actors} actions, but it has {result.steps}"
        if check is not None:
            yield from check.end_problems()
        if check is None or result is None:
            what = topics.RESULT if check else topics.INFO
            yield f"it has no message on {what}: its recording was interrupted"
            return
        yield from check.result_problems(result)

    def _metadata_problems(self) -> Iterator[str]:
        """Yield differences between the metadata record and the messages."""
        check, result = self._check, self.result
        if check is None or result is None:
            return
        info, found = check.info, self._reader.metadata
        outcome = outcome_metadata(info, result, self._reader.received)
        wanted = {"format_version": FORMAT_VERSION, "episode_id": info.episode_id, **outcome}
        if found.get(REPAIRED_KEY) == "true":
            wanted[REPAIRED_KEY] = "true"
        for key in sorted(wanted.keys() | found.keys()):
            if wanted.get(key) != found.get(key):
                yield f"its metadata record has {key} {found.get(key)!r}, expected {wanted.get(key)!r}"

    def _name_problems(self) -> Iterator[str]:
        """Yield differences between the names of folder and file and the episode."""
        if self.info is None:
            return
        file, name = self._reader.file.absolute(), self.info.episode_id
        if self._reader.metadata.get(REPAIRED_KEY) == "true":
            name += REPAIRED
        if file.parent.name != name:
            yield f"its folder is named {file.parent.name}, but it holds episode '{self.info.episode_id}'"
        if file.name != mcap_name(name):
            yield f"its file is named {file.name}, expected {mcap_name(name)}"

    def _count_problems(self) -> Iterator[str]:
        """Yield differences between the summary's counts and the messages."""
        for topic, count in self._reader.counts.items():
            if count != self._counts[topic]:
                yield f"its summary counts {count} messages on {topic}, there are {self._counts[topic]}"

    def _description_problems(self) -> Iterator[str]:
        """Yield differences between ``metadata.yaml`` and the messages."""
        reader = self._reader
        reader = self._reader
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
