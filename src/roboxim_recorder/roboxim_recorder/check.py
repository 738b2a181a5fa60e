"""Checks that a bag is whole, and saves what can be read of a broken one."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, RoboximError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, BagTick, damage, damaged, mcap_file
from roboxim_recorder.bag_writer import PLACES, McapFile, disk_errors
from roboxim_recorder.schemas import MessageSchema


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """What a check found."""

    path: Path
    """The bag."""
    episode_id: str = ""
    """Its episode; empty when not readable."""
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
    """Read a bag as a whole and report what is wrong with it; never raises for damage."""
    problems: list[str] = []
    episode_id = outcome = ""
    ticks = 0
    try:
        reader = BagReader(path)
        info = reader.info
        episode_id = info.episode_id
        present = _messages_by_tick(reader)
        for tick in reader.ticks(cameras=()):
            problems += _tick_problems(tick, ticks, info.scene.tick_ns, present)
            ticks += 1
        result = reader.result
        outcome = result.outcome
        if result.last_seq != ticks - 1:
            problems.append(f"the result names tick {result.last_seq} as the last, the bag has {ticks} ticks")
        if result.episode_id != episode_id:
            problems.append(f"the result is of another episode, '{result.episode_id}'")
    except RoboximError as error:
        problems.append(str(error))
    return BagReport(path=Path(path), episode_id=episode_id, ticks=ticks, outcome=outcome, problems=tuple(problems))


def _messages_by_tick(reader: BagReader) -> set[tuple[str, int]]:
    """Return every (topic, stamp) of which the bag has a message; decodes none."""
    with damage(reader.path):
        return {(channel.topic, message.log_time) for channel, message in _records(reader.file)}


def _tick_problems(tick: BagTick, expected_seq: int, tick_ns: int, present: set[tuple[str, int]]) -> list[str]:
    problems = []
    if tick.seq != expected_seq:
        problems.append(f"tick {expected_seq} is followed by tick {tick.seq}" if expected_seq else "tick 0 is missing")
    if tick.state.seq != tick.seq or tick.step.episode_id != tick.state.episode_id:
        problems.append(f"tick {tick.seq} holds the state of tick {tick.state.seq} of '{tick.state.episode_id}'")
    if tick.stamp_ns != tick.seq * tick_ns:
        problems.append(f"tick {tick.seq} is stamped {tick.stamp_ns} ns, expected {tick.seq * tick_ns}")
    missing = [name for name in tick.topics if (name, tick.stamp_ns) not in present]
    if missing:
        problems.append(f"tick {tick.seq} lacks {', '.join(missing)}")
    return problems


def _records(file: Path) -> Iterator[tuple[Channel, Message]]:
    """Yield the messages of a file in the order of recording, up to where it breaks off, then raise."""
    channels: dict[int, Channel] = {}
    with file.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                yield channels[record.channel_id], record


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
    target = source.with_name(f"{source.name}.repaired")
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
            if topic in (topics.INFO, topics.STEP, topics.RESULT):
                for entry, message in tick:
                    bag.write(entry, message.data, message.log_time)
                tick, copied = [], True
    bag.finish({"repaired": "true"})
    return copied


def _until_broken(file: Path) -> Iterator[object]:
    try:
        with damage(file), file.open("rb") as stream:
            yield from StreamReader(stream, validate_crcs=True).records
    except RecorderError:
        return


def list_bags(path: Path | str) -> list[Path]:
    """Return the bags of a run's folder or of a folder of bags, sorted by name; set apart ones are not among them.

    A bag that has lost its ``.mcap`` file counts, so that whoever reads it learns of the loss.

    Args:
        path: A run's folder (its ``episodes/`` is meant), a folder of bags, or one bag.

    Raises:
        ConfigError: When there is no such folder.
        RecorderError: When no bag is in it.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "is a file; expected a run's folder or a folder of bags"
        raise ConfigError(f"{folder} {what}" if folder.exists() else f"no such folder: {folder}")
    apart = len(list((folder / PLACES["set_apart"]).glob("[!.]*/*.mcap")))
    if (folder / "episodes").is_dir():
        folder = folder / "episodes"
    bags = (
        [folder]
        if list(folder.glob("*.mcap"))
        else sorted({path.parent for name in ("*.mcap", "metadata.yaml") for path in folder.glob(f"[!.]*/{name}")})
    )
    if not bags:
        failed = (
            f"; the {apart} in set_apart did not succeed" if apart else "; expected folders that hold an .mcap file"
        )
        raise RecorderError(f"{folder} has no bags{failed}")
    return bags
