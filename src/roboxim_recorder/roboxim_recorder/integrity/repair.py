"""Repairs damaged bags: saves the whole ticks before the first gap as a new bag.

Readers need an episode without gaps, so the new bag ends at the first gap. Readable ticks after it are counted and
reported. The original is only read.

A bag that has lost its result gets a new one: outcome ``error``, reason `OUTCOME_UNKNOWN`. No export then counts it as
a success, unless the saved actions are executed and judged again (`Rejudge`).
"""

from __future__ import annotations

import contextlib
import filecmp
import mmap
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mcap.records import Channel, Message, Schema

from roboxim_core import limits
from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, RoboximError
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_recorder import topics
from roboxim_recorder.bag import damage, damaged, mcap_file
from roboxim_recorder.bag_writer import FORMAT_VERSION, REPAIRED, REPAIRED_KEY, McapFile, disk_errors
from roboxim_recorder.decoding import Decoder
from roboxim_recorder.integrity.check import BagReport, check_bag
from roboxim_recorder.integrity.salvage import Bytes, Damage, SalvagedChunk, salvage
from roboxim_recorder.integrity.ticks import TickCheck
from roboxim_recorder.recording import FLUSH_TICKS, outcome_metadata
from roboxim_ros.messages.conversions import from_msg
from roboxim_ros.messages.schemas import MessageSchema, message_schema

OUTCOME_UNKNOWN = "outcome_unknown"
"""Reason of the result of a bag whose own result is lost."""

State = Literal["whole", "lossy", "nothing"]
Rejudge = Callable[[EpisodeInfo, Sequence[StateRecord]], Verdict | None]
"""Executes the actions of saved ticks again, from the episode's scene, and judges them; None: the states differ."""


@dataclass(frozen=True, kw_only=True)
class RepairReport:
    """Saved and lost parts of a bag."""

    source: Path
    """The bag."""
    target: Path | None = None
    """The new bag; None: none was written."""
    state: State
    """``whole`` when nothing is lost, ``lossy``, or ``nothing`` when not a single tick can be saved."""
    episode_id: str = ""
    """Id of the episode; empty: not readable."""
    kept: int = 0
    """Ticks saved: all before the first gap."""
    lost: int = 0
    """Ticks of the episode that are not saved, as far as the rest of the file shows: a lower bound."""
    behind: int = 0
    """Lost ticks that are readable but come after the gap."""
    total_bytes: int = 0
    """Size of the damaged MCAP file [B]."""
    damaged_bytes: int = 0
    """Bytes of it that cannot be read."""
    outcome: str = ""
    """Outcome of the saved episode; empty: nothing is saved."""
    reason: str = ""
    """Why it is not a success; `OUTCOME_UNKNOWN` when its result is lost."""
    reasons: tuple[str, ...] = ()
    """Faults of the bag, in the order of the file."""

    @property
    def text(self) -> str:
        """Saved and lost parts in one line."""
        if self.state == "nothing":
            return f"nothing can be saved: {self.reasons[-1]}"
        ticks = f"{self.kept} of {self.kept + self.lost} ticks"
        if self.state == "whole":
            return f"whole, {ticks}, {self.outcome}" if not self.reasons else f"all {self.kept} ticks, {self.outcome}"
        parts = [f"{ticks} before the first gap", f"{self.damaged_bytes} of {self.total_bytes} bytes unreadable"]
        if self.behind:
            parts.insert(1, f"{self.behind} more readable behind it")
        outcome = "outcome unknown" if self.reason == OUTCOME_UNKNOWN else self.outcome
        return f"{', '.join(parts)}; {outcome}" + (f"; {self.reasons[0]}" if self.reasons else "")

    @property
    def further(self) -> tuple[str, ...]:
        """Faults that `text` does not name."""
        return tuple(reason for reason in self.reasons if reason not in self.text)


def survey_bag(path: Path | str) -> RepairReport:
    """Report what a repair of a bag would save, without writing anything.

    Raises:
        ConfigError: When the path is not a bag.
    """
    report = check_bag(path)
    return _whole(report) if report.ok else _Repair(Path(path), report).survey()


def repair_bag(path: Path | str, out: Path | str | None = None, *, rejudge: Rejudge | None = None) -> RepairReport:
    """Save the whole ticks of a damaged bag, up to the first gap, as ``<out>/<episode id>.repaired``.

    A whole bag is not written again. The same call on the same bag gives the same bytes and changes nothing.

    Args:
        path: The bag's folder or its MCAP file; also a folder that a killed recorder left in ``.partial``.
        out: Folder for the new bag; None: the folder that the bag lies in.
        rejudge: Judges the saved ticks when the episode's result is lost; None: the outcome stays unknown.

    Raises:
        ConfigError: When the path is not a bag, or the new bag would lie within it.
        RecorderError: ``EPISODE_EXISTS`` when another bag has the new one's name, ``DISK`` when it cannot be written.
    """
    report = check_bag(path)
    return _whole(report) if report.ok else _Repair(Path(path), report).save(out, rejudge)


def _whole(report: BagReport) -> RepairReport:
    return RepairReport(
        source=report.path, state="whole", episode_id=report.episode_id, kept=report.ticks, outcome=report.outcome,
        reason=report.reason,
    )  # fmt: skip


@dataclass
class _Found:
    """Findings of one reading of a damaged file."""

    damages: list[Damage] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    """Why a tick is not whole."""
    types: dict[str, MessageSchema] = field(default_factory=dict)
    """Topic to schema, in the order of announcement."""
    check: TickCheck | None = None
    """Check of the ticks; None: the episode's info was not found."""
    kept: int = 0
    """Whole ticks before the first gap."""
    states: list[StateRecord] = field(default_factory=list)
    """Their states."""
    step: EpisodeStep | None = None
    """Step of the last of them."""
    facts: dict[str, Any] = field(default_factory=dict)
    """The result, as far as it follows from the kept ticks."""
    gap: bool = False
    """Whether a tick is lost."""
    result: EpisodeResult | None = None
    """The result, if it is readable; after a gap it describes the longer episode."""
    result_cdr: bytes = b""
    """The recorded result as a serialised message."""
    behind: int = 0
    """Number of ticks after the gap with a readable step."""
    last_seq: int = -1
    """Last tick with any readable message."""

    @property
    def whole(self) -> bool:
        """Whether nothing of the episode is lost."""
        if self.gap or self.result is None or self.check is None or list(self.check.result_problems(self.result)):
            return False
        known = {*topics.OWN, *self.check.expected}
        return not (self.damages and self.types.keys() - known)  # a gap in additional topics cannot be seen

    @property
    def lost(self) -> int:
        """Ticks that are not kept, as far as is known."""
        last = max(self.last_seq, self.result.last_seq if self.result else -1)
        return max(0, last + 1 - self.kept)


class _Repair:
    """Repair of one bag."""

    def __init__(self, path: Path, report: BagReport) -> None:
        self._source, self._report = path, report

    def survey(self) -> RepairReport:
        """Report what `save` would save."""
        found = _Found()
        try:
            file = mcap_file(self._source)
            with _mapped(file) as data, damage(file):
                for _ in _Reading(found, file).messages(data):
                    pass
        except RecorderError as error:
            found.problems.append(str(error))
            found.kept = 0
            return self._report_of(found, None, 0, None)
        result = _result(found, None) if found.kept else None
        return self._report_of(found, result, file.stat().st_size, None)

    def save(self, out: Path | str | None, rejudge: Rejudge | None) -> RepairReport:
        """Write the new bag, check it, and give it its final name."""
        survey = self.survey()
        if survey.state == "nothing":
            return survey
        file = mcap_file(self._source)
        name = survey.episode_id + REPAIRED
        target = (Path(out) if out is not None else file.absolute().parent.parent) / name
        if file.parent.resolve() in target.resolve().parents:
            raise ConfigError(f"{target} would lie in the bag {file.parent}; name another folder")
        partial = target.with_name(f".{name}.partial")
        with disk_errors(target):
            shutil.rmtree(partial, ignore_errors=True)
            try:
                with _mapped(file) as data:
                    found, result = self._write(file, data, partial / name, rejudge)
                _require_whole(partial / name)
                _publish(partial / name, target)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
        return self._report_of(found, result, file.stat().st_size, target)

    def _write(self, file: Path, data: Bytes, folder: Path, rejudge: Rejudge | None) -> tuple[_Found, EpisodeResult]:
        """Write the new bag: the kept ticks, the result, the metadata record."""
        found = _Found()
        bag: McapFile | None = None
        stamp_ns = 0
        for topic, message in _Reading(found, file).messages(data):
            if bag is None:
                bag = McapFile(folder, folder.name)
                for announced, schema in found.types.items():
                    bag.add_topic(announced, schema)
            if topic == topics.NOTICE and _ends_chunk(bag):
                bag.flush()
            bag.write(topic, message.data, message.log_time)
            stamp_ns = message.log_time
        assert bag is not None, "the survey found ticks"
        assert found.check is not None
        result = _result(found, rejudge)
        if _ends_chunk(bag):
            bag.flush()
        cdr = found.result_cdr if found.whole else found.check.decoder.encode_result(topics.RESULT, result)
        bag.write(topics.RESULT, cdr, stamp_ns)
        info = found.check.info
        bag.finish(
            {
                "format_version": FORMAT_VERSION,
                "episode_id": info.episode_id,
                **outcome_metadata(info, result),
                REPAIRED_KEY: "true",
            }
        )
        return found, result

    def _report_of(
        self, found: _Found, result: EpisodeResult | None, total_bytes: int, target: Path | None
    ) -> RepairReport:
        reasons = [damaged.text for damaged in found.damages] + found.problems
        if not found.damages:
            reasons += [problem for problem in self._report.problems if problem not in reasons]
        if self._report.foreign:
            reasons = list(self._report.problems)
        elif not found.kept and found.check is None:
            reasons.append(found.problems[-1] if found.problems else "the episode's info is lost")
        elif not found.kept:
            reasons.append("no tick before the gap is complete")
        return RepairReport(
            source=self._source,
            target=target,
            state="nothing" if not found.kept else "whole" if found.whole else "lossy",
            episode_id=found.check.info.episode_id if found.check else "",
            kept=found.kept,
            lost=found.lost,
            behind=found.behind,
            total_bytes=total_bytes,
            damaged_bytes=sum(damaged.end - damaged.start for damaged in found.damages),
            outcome=result.outcome if result else "",
            reason=result.reason if result else "",
            reasons=tuple(reasons),
        )


class _Reading:
    """One reading of a damaged file: decides for each message whether it is kept."""

    def __init__(self, found: _Found, file: Path) -> None:
        self._found, self._file = found, file
        self._schemas: dict[int, MessageSchema] = {}
        self._channels: dict[int, Channel] = {}
        self._tick: list[tuple[str, Message]] = []

    def messages(self, data: Bytes) -> Iterator[tuple[str, Message]]:
        """Yield the info and the messages of all whole ticks before the first gap, with additional topics' messages."""
        for chunk in salvage(data):  # another program may announce a topic as late as its first message
            for record in chunk.records if isinstance(chunk, SalvagedChunk) else ():
                if not isinstance(record, Message):
                    self._announce(record)
        for part in salvage(data):
            if isinstance(part, Damage):
                self._found.damages.append(part)
                continue
            for record in part.records:
                if isinstance(record, Message) and record.channel_id in self._channels:
                    yield from self._take(self._channels[record.channel_id].topic, record)

    def _announce(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema) and record.encoding != "ros2msg":
            return
        if isinstance(record, Schema):
            self._schemas[record.id] = MessageSchema(name=record.name, text=record.data.decode())
        else:
            self._channels[record.id] = record
            if record.schema_id in self._schemas:
                self._found.types.setdefault(record.topic, self._schemas[record.schema_id])

    def _take(self, topic: str, message: Message) -> Iterator[tuple[str, Message]]:
        """Take the next message; yield the messages of a tick that it completes."""
        found = self._found
        if found.check is None:
            if topic == topics.INFO and not found.gap:
                self._begin(message)
                yield topic, message
            found.gap = found.check is None
        elif topic == topics.RESULT:
            with damage(self._file):
                found.result = from_msg(found.check.decoder.decode(topic, message.data), EpisodeResult)
                found.result_cdr = message.data
        elif found.gap:
            self._count_behind(topic, message)
        elif topic in found.check.expected or topic == topics.INFO:
            yield from self._tick_message(topic, message)
        elif not self._tick:  # a message of an additional topic follows the tick's step
            yield topic, message

    def _begin(self, message: Message) -> None:
        # Another program may announce the result's topic as late as the result.
        self._found.types.setdefault(topics.RESULT, message_schema(topics.OWN[topics.RESULT]))
        decoder = Decoder(self._found.types)
        with damage(self._file):
            info = from_msg(decoder.decode(topics.INFO, message.data), EpisodeInfo)
            limits.require_episode_id(info.episode_id)
            check = TickCheck(decoder, info)
            for problem in check.topic_problems():
                raise damaged(self._file, problem)
        self._found.check = check

    def _tick_message(self, topic: str, message: Message) -> Iterator[tuple[str, Message]]:
        found, check = self._found, self._found.check
        assert check is not None
        try:
            with damage(self._file):
                problems = list(check.message(topic, message))
        except RoboximError as error:
            problems = [str(error)]
        self._tick.append((topic, message))
        if problems:
            found.gap = True
            found.problems += problems[:1]
            self._count_behind(topic, message)
        elif topic == topics.STEP:
            assert check.state is not None
            found.kept, found.step, found.facts = check.ticks, check.step, check.result_facts
            found.states.append(check.state)
            found.last_seq = max(found.last_seq, check.ticks - 1)
            yield from self._tick
            self._tick = []

    def _count_behind(self, topic: str, message: Message) -> None:
        """Count a tick behind the gap by its step."""
        found = self._found
        if topic != topics.STEP or found.check is None:
            return
        with contextlib.suppress(RoboximError), damage(self._file):
            step = from_msg(found.check.decoder.decode(topic, message.data), EpisodeStep)
            found.behind += step.seq >= found.kept
            found.last_seq = max(found.last_seq, step.seq)


def _result(found: _Found, rejudge: Rejudge | None) -> EpisodeResult:
    """Return the recorded result of a whole episode, or a new one for the saved ticks."""
    if found.whole:
        assert found.result is not None
        return found.result
    assert found.check is not None
    assert found.step is not None
    saved = f"repaired: {found.kept} ticks saved, at least {found.lost} lost"
    verdict = rejudge(found.check.info, found.states) if rejudge else None
    if verdict is None:
        last = found.step.verdict
        outcome, reason, verdict = "error", OUTCOME_UNKNOWN, replace(last, success=False)
    else:
        outcome = "success" if verdict.success else "failure"
        reason = "" if verdict.success else verdict.reason or "not_solved"
        saved += "; judged again by executing the saved actions"
    return EpisodeResult(
        **found.facts,
        outcome=outcome,
        reason=reason,
        message=saved,
        success_ever=verdict.success_ever,
        recovered=bool(found.result and found.result.recovered),
        verdict=verdict,
    )


def _ends_chunk(bag: McapFile) -> bool:
    """Whether the recorder ends a chunk after the newest tick, so that a repaired bag has the same chunks."""
    ticks = bag.counts[topics.STEP]
    return not ticks or (ticks - 1) % FLUSH_TICKS == 0


def _require_whole(folder: Path) -> None:
    report = check_bag(folder)
    if not report.ok:
        raise RecorderError(
            f"the repaired bag of {report.episode_id} is not whole ({report.problems[0]}); please report this as a bug",
            ErrorCode.BAG_DAMAGED,
        )


def _publish(new: Path, target: Path) -> None:
    """Give the new bag its final place; an equal one that already exists stays."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        new.rename(target)
        return
    for file in new.iterdir():
        there = target / file.name
        if not there.is_file() or not filecmp.cmp(file, there, shallow=False):
            raise RecorderError(
                f"{target} exists and is another bag; move or remove it to repair again", ErrorCode.EPISODE_EXISTS
            )


@contextmanager
def _mapped(file: Path) -> Iterator[Bytes]:
    if not file.stat().st_size:
        yield b""
        return
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield data
