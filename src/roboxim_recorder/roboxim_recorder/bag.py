"""Reads an episode's bag as values of roboxim_core; bags contain their message definitions, so no ROS is needed."""

from __future__ import annotations

import contextlib
import json
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Footer, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError

from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.state import StateRecord
from roboxim_recorder import topics
from roboxim_recorder.bag_writer import LIBRARY, METADATA, RECEIVED_KEY, BagWriter, find_episode
from roboxim_recorder.chunks import read_messages, refuse_bombs
from roboxim_recorder.decoding import Decoder
from roboxim_ros.messages.conversions import from_msg, image_from_msg, stamp_to_ns
from roboxim_ros.messages.schemas import MessageSchema

T = TypeVar("T")


class NotAnEpisodeError(RecorderError):
    """A bag without an episode of RoboXim; the bag itself may be intact."""


def not_an_episode(path: Path, counts: Mapping[str, int]) -> NotAnEpisodeError:
    """Return an error that names a bag of another system, and its topics.

    Args:
        path: The bag.
        counts: Topic to number of messages.
    """
    shown = ", ".join(f"{topic} ({count} messages)" for topic, count in sorted(counts.items())[:5])
    more = f" and {len(counts) - 5} more topics" if len(counts) > 5 else ""
    return NotAnEpisodeError(
        f"bag {path} is no episode of RoboXim: it has no topic {topics.INFO}; it holds {shown or 'no topic'}{more}. "
        "'roboxim bag play' plays it, and 'roboxim dataset convert' makes a dataset of a driven graph; exports need "
        "episodes, as generate and evaluate record them"
    )


@contextlib.contextmanager
def damage(path: Path) -> Iterator[None]:
    """Turn every exception that a damaged file causes into a `RecorderError` with code ``BAG_DAMAGED``."""
    try:
        yield
    except (McapError, SerdeError, TypesysError, CRCValidationError, zstandard.ZstdError) as error:
        raise damaged(path, str(error) or type(error).__name__) from error
    except (struct.error, EOFError, InvalidRequestError) as error:
        raise damaged(path, str(error)) from error
    except (ValueError, LookupError, OverflowError, MemoryError, AssertionError, RuntimeError) as error:  # also lz4's
        raise damaged(path, f"{type(error).__name__}: {error}") from error
    except OSError as error:
        raise damaged(path, error.strerror or str(error)) from error
    except AttributeError as error:  # a field that this version of RoboXim expects
        raise RecorderError(
            f"bag {path} was recorded by another version of RoboXim, which this one cannot read ({error}); use the "
            "version that recorded it",
            ErrorCode.BAG_DAMAGED,
        ) from error


def damaged(path: Path, what: str) -> RecorderError:
    """Return an error that names a bag and its damage."""
    return RecorderError(
        f"bag {path} is damaged: {what}; 'roboxim bag repair' saves what can be read", ErrorCode.BAG_DAMAGED
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BagTick:
    """One tick of a bag."""

    seq: int
    """Number of the tick, from 0."""
    stamp_ns: int
    """Simulated time since tick 0 [ns]."""
    topics: tuple[str, ...]
    """Names, as in the bag, of the topics that must carry a message of this tick."""
    state: StateRecord
    """State of the world."""
    step: EpisodeStep
    """Data that the episode loop added: actions, phase, verdict."""
    images: dict[str, npt.NDArray[np.uint8]] = field(default_factory=dict)
    """Camera to RGB image, uint8, shape (height, width, 3), read-only."""
    depth: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    """Camera to distance along the optical axis [m], float32, shape (height, width), read-only."""
    segmentation: dict[str, npt.NDArray[np.uint16]] = field(default_factory=dict)
    """Camera to entity ids, uint16, shape (height, width), read-only."""


def mcap_file(path: Path | str) -> Path:
    """Return the MCAP file of a bag, given its folder or the file itself.

    Raises:
        ConfigError: When the path is not a bag: it does not exist, is another kind of file, or is a run.
        RecorderError: With code ``BAG_DAMAGED`` when the file is missing.
    """
    path = Path(path)
    if path.is_file():
        if path.suffix != ".mcap" and not _has_magic(path):
            raise ConfigError(f"{path} is not a bag; expected a bag's folder or its .mcap file")
        return path
    if not path.exists():
        raise ConfigError(f"no such bag: {path}")
    files = sorted(path.glob("*.mcap"))
    if not files and any(path.glob("*.db3")):
        raise ConfigError(f"{path} is a bag of SQLite, not MCAP; convert it with 'ros2 bag convert' or rosbags-convert")
    if len(files) != 1:
        inside = path / "episodes" if (path / "episodes").is_dir() else path
        bags = sorted(file.parent for file in inside.glob("[!.]*/*.mcap"))
        if bags and not files:
            kind = "a folder of bags" if inside == path else "a run"
            raise ConfigError(f"{path} is {kind}, not one bag; name one, e.g. {bags[0]}")
        raise RecorderError(
            f"{path} is not an episode's bag: expected one .mcap file in it, found {len(files)}",
            ErrorCode.BAG_DAMAGED,
        )
    return files[0]


def _has_magic(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC


class BagReader:
    """An episode's bag. Messages are decoded on request; no file stays open between calls."""

    def __init__(self, path: Path | str, *, info: EpisodeInfo | None = None) -> None:
        """Open a bag.

        Args:
            path: The bag's folder, or its ``.mcap`` file.
            info: Its info from an earlier reading, so that `info` need not decompress a chunk; None: not known.

        Raises:
            ConfigError: When the path is not a bag.
            RecorderError: With code ``BAG_DAMAGED`` when it is not a complete bag.
        """
        self.file = mcap_file(path)
        self.path, self._known_info = Path(path), info
        with damage(self.path), self.file.open("rb") as stream:
            refuse_bombs(stream)
            reader = SeekingReader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                summary = counted(stream)
            self._summary = summary
            self.library = reader.get_header().library
            """The program that wrote the file."""
            self.metadata = {record.name: record.metadata for record in reader.iter_metadata()}.get(METADATA, {})
            """The bag's metadata record: episode id, outcome, instruction, format version."""
            assert summary.statistics is not None
            counts = summary.statistics.channel_message_counts
            self.counts = {c.topic: counts.get(c.id, 0) for c in summary.channels.values()}
            """Topic to number of messages."""
            self.type_hashes = {c.topic: c.metadata.get("topic_type_hash", "") for c in summary.channels.values()}
            """Topic to the hash of its message type."""
            schemas = {s.id: _schema(s) for s in summary.schemas.values() if s.encoding == "ros2msg"}
            self._schemas = {c.topic: schemas[c.schema_id] for c in summary.channels.values() if c.schema_id in schemas}
            self.types = {topic: schema.name for topic, schema in self._schemas.items()}
            """Topic to message type, of the topics with ROS 2's definitions."""

    @property
    def rewritten(self) -> bool:
        """Whether another program than RoboXim's recorder wrote the file, e.g. a converter or a filter."""
        return self.library != LIBRARY

    @cached_property
    def decoder(self) -> Decoder:
        """Decodes its messages.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when its definitions of messages cannot be read.
        """
        with damage(self.path):
            return Decoder(self._schemas)

    @cached_property
    def info(self) -> EpisodeInfo:
        """Everything needed to reproduce the episode.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``.
        """
        return self._known_info or self._only(topics.INFO, EpisodeInfo)

    @cached_property
    def result(self) -> EpisodeResult:
        """How the episode ended.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``.
        """
        return self._only(topics.RESULT, EpisodeResult)

    @property
    def received(self) -> tuple[str, ...]:
        """Instructions that the policy was given in the episode, each once; empty: unknown.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``.
        """
        encoded = self.metadata.get(RECEIVED_KEY, "[]")
        with damage(self.path):
            found = json.loads(encoded)
            if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
                raise ValueError(f"its metadata record has {RECEIVED_KEY} {encoded!r}, expected a list of instructions")
            return tuple(found)

    def __len__(self) -> int:
        """Count the ticks."""
        return self.counts.get(topics.STEP, 0)

    def _only(self, topic: str, cls: type[T]) -> T:
        if topics.INFO not in self.types:
            raise not_an_episode(self.path, self.counts)
        if topic not in self.types:
            raise damaged(self.path, f"it has no topic {topic}: it was filtered, or its recording was interrupted")
        with damage(self.path):
            for _, _, message in self.messages((topic,)):
                value: T = from_msg(message, cls)
                return value
        raise damaged(self.path, f"it has no message on {topic}, its recording was interrupted")

    def messages(self, names: Sequence[str] | None = None) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, stamp [ns] and decoded message in the order of recording.

        Args:
            names: Topics; None: all.

        Raises:
            InvalidRequestError: On a topic that the bag does not have.
            RecorderError: With code ``BAG_DAMAGED``.
        """
        for name in names or ():
            if name not in self.types:
                raise InvalidRequestError(f"bag {self.path} has no topic '{name}'; {one_of(self.types, name)}")
        for topic, stamp, data in self._read(names):
            yield topic, stamp, self.decode(topic, data)

    def raw(self) -> Iterator[tuple[str, bytes]]:
        """Yield topic and serialised message of everything in the order of recording.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``.
        """
        for topic, _, data in self._read(None):
            yield topic, bytes(data)

    def _read(self, names: Sequence[str] | None) -> Iterator[tuple[str, int, memoryview]]:
        with (
            damage(self.path),
            self.file.open("rb") as stream,
            contextlib.closing(read_messages(stream, self._summary, names)) as found,
        ):
            for channel, stamp, data in found:
                yield channel.topic, stamp, data

    def decode(self, topic: str, cdr: bytes | memoryview) -> Any:
        """Decode a message of a topic.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``.
        """
        with damage(self.path):
            return self.decoder.decode(topic, cdr)

    def encode(self, topic: str, message: Any) -> bytes:
        """Serialise a message that `decode` or `messages` returned, e.g. after a change.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when the message does not fit its topic.
        """
        with damage(self.path):
            return self.decoder.encode(topic, message)

    def ticks(
        self, cameras: Sequence[str] | None = None, kinds: Collection[str] = topics.IMAGE_KINDS
    ) -> Iterator[BagTick]:
        """Yield the ticks in order.

        Args:
            cameras: Cameras whose images to read; None: all.
            kinds: Which of ``image``, ``depth`` and ``segmentation`` to read of them.

        Raises:
            InvalidRequestError: On a camera that the bag does not have.
            RecorderError: With code ``BAG_DAMAGED``, naming the tick that is not whole.
        """
        if lost := [name for name in (topics.NOTICE, topics.STATE, topics.STEP) if name not in self.types]:
            if topics.INFO not in self.types:
                raise not_an_episode(self.path, self.counts)
            raise damaged(
                self.path, f"it has no topic {', '.join(lost)}, which every reader needs: it was filtered out"
            )
        wanted = self._camera_topics(cameras, kinds)
        names = (topics.NOTICE, topics.STATE, topics.STEP, *wanted)
        found: dict[str, Any] = {}
        for topic, _, message in self.messages(names):
            found[topic] = message
            if topic == topics.STEP:  # the last message of every tick
                with damage(self.path):
                    yield self._tick(found, wanted)
                found = {}

    def _camera_topics(self, cameras: Sequence[str] | None, kinds: Collection[str]) -> dict[str, tuple[str, str]]:
        """Return topic to (camera, kind)."""
        have = [camera.name for camera in self.info.scene.cameras]
        for camera in cameras or ():
            if camera not in have:
                raise InvalidRequestError(f"bag {self.path} has no camera '{camera}'; {one_of(have, camera)}")
        named = {
            topics.image_topic(c, kind): (c, kind) for c in (have if cameras is None else cameras) for kind in kinds
        }
        recorded = topics.scene_topics(self.info.scene)
        if lost := [topic for topic in named if topic in recorded and topic not in self.types]:
            others = [camera for camera in have if topics.image_topic(camera) in self.types]
            raise damaged(
                self.path,
                f"it lacks the images of {', '.join(lost)}: they were filtered out (cameras with images: "
                f"{', '.join(others) or 'none'})",
            )
        return {topic: value for topic, value in named.items() if topic in self.types}

    def _tick(self, found: dict[str, Any], wanted: dict[str, tuple[str, str]]) -> BagTick:
        step = from_msg(found[topics.STEP], EpisodeStep)
        missing = [name for name in (topics.NOTICE, topics.STATE) if name not in found]
        if missing:
            raise damaged(self.path, f"tick {step.seq} lacks {', '.join(missing)}")
        notice = found[topics.NOTICE]
        named = tuple(map(topics.absolute, notice.topics))
        missing = [name for name in named if name in wanted and name not in found]
        if missing:
            raise damaged(self.path, f"tick {step.seq} lacks {', '.join(missing)}")
        images: dict[str, dict[str, Any]] = {"image": {}, "depth": {}, "segmentation": {}}
        for topic, (camera, kind) in wanted.items():
            if topic in found:
                images[kind][camera] = image_from_msg(found[topic])
        return BagTick(
            seq=step.seq,
            stamp_ns=stamp_to_ns(notice.stamp),
            topics=named,
            state=from_msg(found[topics.STATE], StateRecord),
            step=step,
            images=images["image"],
            depth=images["depth"],
            segmentation=images["segmentation"],
        )


def counted(stream: IO[bytes]) -> Summary:
    """Return the summary of a complete file that was written without one, or without counts.

    Raises:
        ValueError: When the file has no end.
    """
    stream.seek(0)
    summary, counts = Summary(), Counter[int]()
    ended = False
    for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, Message):
            counts[record.channel_id] += 1
        ended = ended or isinstance(record, Footer)
    if not ended:
        raise ValueError("it has no index, its recording was interrupted")
    summary.statistics = Statistics(
        attachment_count=0, channel_count=len(summary.channels), channel_message_counts=dict(counts), chunk_count=0,
        message_count=counts.total(), message_end_time=0, message_start_time=0, metadata_count=0,
        schema_count=len(summary.schemas),
    )  # fmt: skip
    return summary


def _schema(schema: Schema) -> MessageSchema:
    return MessageSchema(name=schema.name, text=schema.data.decode())


__all__ = [
    "BagReader", "BagTick", "BagWriter", "NotAnEpisodeError", "counted", "damage", "damaged", "find_episode",
    "mcap_file", "not_an_episode",
]  # fmt: skip
