"""Repairs damaged bags: saves the ticks that can be read."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_recorder import topics
from roboxim_recorder.bag import damage, damaged, mcap_file
from roboxim_recorder.bag_writer import FORMAT_VERSION, McapFile, disk_errors
from roboxim_recorder.schemas import MessageSchema, message_layout

REPAIRED = ".repaired"
"""Ending of the folder of a repaired bag."""


def repair_bag(path: Path | str) -> Path:
    """Save the whole ticks of a broken bag as a new bag beside it, ``<name>.repaired``.

    Args:
        path: The bag's folder; also one left in ``.partial`` by a killed recorder.

    Returns:
        The new bag's folder.

    Raises:
        RecorderError: ``BAG_DAMAGED`` when not even the episode's info can be read, ``EPISODE_EXISTS`` when it was
            repaired before, ``DISK`` when the new bag cannot be written.
    """
    file = mcap_file(path)
    source = file.parent
    target = source.with_name(f"{source.name}{REPAIRED}")
    if target.exists():
        raise RecorderError(f"{target} exists; remove it to repair again", ErrorCode.EPISODE_EXISTS)
    partial = target.with_name(f".{target.name}")
    shutil.rmtree(partial, ignore_errors=True)
    with disk_errors(target):
        written = _rewrite(file, partial, target.name)
        if not written:
            shutil.rmtree(partial)
            raise damaged(source, "not even the episode's info can be read")
        partial.rename(target)
    return target


def _rewrite(file: Path, folder: Path, name: str) -> bool:
    """Copy the whole ticks; return whether there was at least the episode's info."""
    schemas: dict[int, MessageSchema] = {}
    metadata = {"format_version": FORMAT_VERSION, "repaired": "true"}
    channels: dict[int, Channel] = {}
    bag = McapFile(folder, name)
    tick: list[tuple[str, Message]] = []
    copied = False
    for record in _until_broken(file):
        if isinstance(record, Schema):
            schemas[record.id] = MessageSchema(name=record.name, text=record.data.decode())
        elif isinstance(record, Channel):
            if record.id not in channels:
                bag.add_topic(record.topic, schemas[record.schema_id])
            channels[record.id] = record
        elif isinstance(record, Message):
            topic = channels[record.channel_id].topic
            tick.append((topic, record))
            if topic == topics.INFO:
                layout = message_layout(schemas[channels[record.channel_id].schema_id])
                metadata["episode_id"] = layout.clean(record.data).text("episode_id")
            if topic in (topics.INFO, topics.STEP, topics.RESULT):
                for entry, message in tick:
                    bag.write(entry, message.data, message.log_time)
                tick, copied = [], True
    bag.finish(metadata)
    return copied


def _until_broken(file: Path) -> Iterator[object]:
    try:
        with damage(file), file.open("rb") as stream:
            yield from StreamReader(stream, validate_crcs=True).records
    except RecorderError:
        return
