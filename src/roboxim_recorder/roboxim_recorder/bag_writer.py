"""Writes one episode's bag: a rosbag2 folder with one MCAP file, which appears in its final place only when complete.

The bag grows in ``<out>/.partial/<id>`` and is renamed into ``<out>/episodes`` or ``<out>/set_apart`` when closed. A
killed recorder loses the messages since the last `BagWriter.flush`; `repair.repair_bag` recovers the rest.
"""

from __future__ import annotations

import contextlib
import errno
import shutil
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from roboxim_core import limits
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_recorder.cdr import Cdr
from roboxim_recorder.mcap_writer import McapWriter
from roboxim_recorder.topics import OF_SCENE
from roboxim_ros.messages.schemas import MessageSchema

PLACES = {"keep": "episodes", "set_apart": "set_apart"}
"""Value of ``keep`` to the folder of the bag."""
PARTIAL = ".partial"
METADATA = "roboxim"
"""Name of the MCAP metadata record."""
METADATA_FILE = "metadata.yaml"
FORMAT_VERSION = "2"
REPAIRED = ".repaired"
"""Ending of the folder of a repaired bag."""
REPAIRED_KEY = "repaired"
"""Key of the metadata record of a repaired bag, with the value ``true``."""
RECEIVED_KEY = "received"
"""Key of the metadata record, with the instructions that the policy was given, as a JSON list; left out: unknown."""
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


def _qos(topic: str) -> dict[str, Any]:
    """Return the QoS that a player offers; the topics of a scene are latched for late subscribers."""
    latched = topic in OF_SCENE
    return {
        "history": "keep_last",
        "depth": 1 if latched else 10,
        "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@cache
def _qos_text(topic: str) -> str:
    return metadata_text([_qos(topic)])


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an operating system's error into a `RecorderError` with code ``DISK``."""
    try:
        yield
    except OSError as error:
        raise _disk_error(path, error) from error


def _disk_error(path: Path, error: OSError) -> RecorderError:
    advice = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check the folder"
    return RecorderError(f"cannot write {path}: {error.strerror or error}; {advice} and run again", ErrorCode.DISK)


def find_episode(output_dir: Path, episode_id: str) -> Path | None:
    """Return the folder of an episode that a run already has, kept or set apart; None when it has none."""
    candidates = (output_dir / place / episode_id for place in PLACES.values())
    return next((path for path in candidates if path.exists()), None)


LIBRARY = "roboxim"
"""The program that an MCAP file of the recorder names as its writer."""


class McapFile:
    """An MCAP file with rosbag2's profile, and the ``metadata.yaml`` that describes it."""

    def __init__(self, folder: Path, name: str) -> None:
        """Make the folder and ``<name>_0.mcap`` in it; an OSError is the caller's."""
        folder.mkdir(parents=True)
        self.path = folder / mcap_name(name)
        self._file = self.path.open("wb")
        self._writer = McapWriter(self._file, profile="ros2", library=LIBRARY)
        self._channels: dict[str, int] = {}
        self._schema_ids: dict[str, int] = {}
        self._schemas: dict[str, MessageSchema] = {}
        self.counts: dict[str, int] = {}

    def add_topic(self, topic: str, schema: MessageSchema) -> None:
        """Announce a topic."""
        if schema.name not in self._schema_ids:
            data = schema.text.encode()
            self._schema_ids[schema.name] = self._writer.add_schema(schema.name, "ros2msg", data)
        self._channels[topic] = self._writer.add_channel(
            topic,
            "cdr",
            self._schema_ids[schema.name],
            {
                "offered_qos_profiles": _qos_text(topic),
                "topic_type_hash": schema.type_hash,
            },
        )
        self._schemas[topic] = schema
        self.counts[topic] = 0

    def write(self, topic: str, cdr: Cdr, stamp_ns: int) -> None:
        """Append a serialised message, which may not change until its chunk ends."""
        self._writer.add_message(self._channels[topic], stamp_ns, cdr, self.counts[topic])
        self.counts[topic] += 1

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system."""
        self._writer.flush()

    def finish(self, metadata: Mapping[str, str]) -> None:
        """Write the index and ``metadata.yaml`` and close the file."""
        if metadata:
            self._writer.add_metadata(METADATA, metadata)
        self._writer.finish()
        self._file.close()
        topics = {
            topic: (self._schemas[topic].name, self._schemas[topic].type_hash, count)
            for topic, count in self.counts.items()
        }
        description = bag_description(self.path.name, topics, self._writer.span, metadata)
        (self.path.parent / METADATA_FILE).write_text(metadata_text(description))

    def abandon(self) -> None:
        """Close the file without finishing it."""
        with contextlib.suppress(OSError):
            self._file.close()


def mcap_name(name: str) -> str:
    """Return the name of the MCAP file in a bag's folder of that name."""
    return f"{name}_0.mcap"


def metadata_text(content: Any) -> str:
    """Return the text of ``metadata.yaml``, or of a part of it."""
    text: str = yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=200)
    return text


def bag_description(
    file_name: str, topics: Mapping[str, tuple[str, str, int]], span_ns: tuple[int, int], metadata: Mapping[str, str]
) -> dict[str, Any]:
    """Return the content of rosbag2's ``metadata.yaml`` for a bag, as plain data.

    Args:
        file_name: Name of the MCAP file.
        topics: Topic to its type, the type's hash and its number of messages, in the order of announcement.
        span_ns: Stamps of the first and the last message [ns].
        metadata: The bag's metadata record.
    """
    total = sum(count for _, _, count in topics.values())
    start = {"nanoseconds_since_epoch": span_ns[0]}
    duration = {"nanoseconds": span_ns[1] - span_ns[0]}
    listed = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": [_qos(topic)],
                "type_description_hash": type_hash,
            },
            "message_count": count,
        }
        for topic, (kind, type_hash, count) in topics.items()
    ]
    file = {"path": file_name, "starting_time": dict(start), "duration": dict(duration), "message_count": total}
    return {
        "rosbag2_bagfile_information": {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": total,
            "topics_with_message_count": listed,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file_name],
            "files": [file],
            "custom_data": dict(metadata),
            "ros_distro": "jazzy",
        }
    }


class BagWriter:
    """Writes an episode's bag below a run's folder. Every fault of the disk is a `RecorderError` with code ``DISK``."""

    def __init__(self, output_dir: Path, episode_id: str) -> None:
        """Open the bag; remove files of the same episode that a killed recorder has left.

        Args:
            output_dir: The run's folder, absolute.
            episode_id: Unique id, usable as a file name.

        Raises:
            InvalidRequestError: On a relative folder or an id that is not usable as a file name.
            RecorderError: ``EPISODE_EXISTS`` when the run has the episode, ``DISK`` when it cannot be written.
        """
        if not output_dir.is_absolute():
            raise InvalidRequestError(f"the recorder's output folder must be absolute, got '{output_dir}'")
        if not episode_id:
            raise InvalidRequestError("an episode needs an id")
        limits.require_episode_id(episode_id)
        existing = find_episode(output_dir, episode_id)
        if existing is not None:
            raise RecorderError(
                f"{existing} exists; choose another folder or remove it to record the episode again",
                ErrorCode.EPISODE_EXISTS,
            )
        self.output_dir, self.episode_id = output_dir, episode_id
        self.partial = output_dir / PARTIAL / episode_id
        with disk_errors(self.partial):
            if self.partial.exists():
                shutil.rmtree(self.partial)
            self._mcap = McapFile(self.partial, episode_id)

    def add_topic(self, topic: str, schema: MessageSchema) -> None:
        """Announce a topic; its messages may follow."""
        self._mcap.add_topic(topic, schema)

    def write(self, topic: str, cdr: Cdr, stamp_ns: int) -> None:
        """Append a serialised message.

        Args:
            topic: An announced topic.
            cdr: The message as CDR with its encapsulation header.
            stamp_ns: Time of its tick [ns].
        """
        try:  # a context manager costs more than the message
            self._mcap.write(topic, cdr, stamp_ns)
        except OSError as error:
            raise _disk_error(self.partial, error) from error

    def flush(self) -> None:
        """Hand everything to the operating system: a SIGKILL of this process loses only later messages."""
        with disk_errors(self.partial):
            self._mcap.flush()

    def close(self, keep: str, metadata: Mapping[str, str]) -> str:
        """Finish the bag and move it to its final place; a bag that cannot be finished is removed.

        Args:
            keep: ``keep`` or ``set_apart``.
            metadata: For the bag's metadata record.

        Returns:
            The bag's path relative to the run's folder.
        """
        place = bag_path(self.episode_id, keep)
        try:
            with disk_errors(self.partial):
                self._mcap.finish({"format_version": FORMAT_VERSION, "episode_id": self.episode_id, **metadata})
                (self.output_dir / place).parent.mkdir(exist_ok=True)
                self.partial.rename(self.output_dir / place)
        except RecorderError:
            self.drop()
            raise
        return place

    def drop(self) -> None:
        """Remove the bag."""
        self._mcap.abandon()
        shutil.rmtree(self.partial, ignore_errors=True)


def bag_path(episode_id: str, keep: str) -> str:
    """Return a finished bag's path relative to the run's folder.

    Raises:
        InvalidRequestError: On an unknown value of ``keep``.
    """
    if keep not in PLACES:
        raise InvalidRequestError(f"cannot keep an episode as '{keep}'; {one_of((*PLACES, 'drop'), keep)}")
    return f"{PLACES[keep]}/{episode_id}"
