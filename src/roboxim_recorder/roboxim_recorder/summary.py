"""Summaries of bags and of folders of bags, as values and as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_recorder.bag import BagReader, NotAnEpisodeError, mcap_file
from roboxim_recorder.bag_writer import PLACES, REPAIRED_KEY
from roboxim_recorder.integrity.check import checksum_problems
from roboxim_recorder.integrity.repair import survey_bag
from roboxim_recorder.run_bags import list_bags


def bag_info(path: Path | str) -> str:
    """Return a readable description of a bag.

    Raises:
        ConfigError: When the path is not a bag.
        RecorderError: ``BAG_DAMAGED`` with what can be saved of a damaged one; `NotAnEpisodeError` for a bag of another
            system.
    """
    reader = _whole(path)
    if reader is None:
        raise RecorderError(
            f"{path} is damaged: {survey_bag(path).text}; 'roboxim bag repair' saves what it can",
            ErrorCode.BAG_DAMAGED,
        )
    info = reader.info
    seconds = (len(reader) - 1) * info.scene.tick_ns / 1e9
    lines = [
        f"episode       {info.episode_id}",
        f"file          {reader.file} ({reader.file.stat().st_size / 2**20:.2f} MiB)",
        f"instruction   {info.task.instruction}",
        f"task          {info.task.skill}: " + ", ".join(f"{r}={o.entity}" for r, o in info.task.objects.items()),
        f"outcome       {_outcome(reader)}",
        *([f"repaired      {reader.result.message or 'nothing was lost'}"] if REPAIRED_KEY in reader.metadata else []),
        f"ticks         {len(reader)} ({seconds:g} s at {info.scene.control_rate_hz:g} Hz)",
        f"robot         {info.scene.robot.model}",
        "actor         "
        + " ".join(filter(None, (info.actor, info.actor_version, "(privileged)" * info.actor_privileged))),
        f"seed          run {info.run_seed}, {info.purpose}, index {info.index}, attempt {info.attempt}",
        "cameras       " + ", ".join(f"{c.name} {c.width}x{c.height}" for c in info.scene.cameras),
        f"renderer      {info.renderer}",
        *([f"written by    {reader.library or 'another program'}, which wrote it again"] if reader.rewritten else []),
        "models        " + ", ".join(f"{name} {digest[:16]}" for name, digest in sorted(info.models.items())),
        "versions      " + ", ".join(f"{name} {value}" for name, value in sorted(info.versions.items())),
        "topics",
    ]
    width = max(map(len, reader.types))
    lines += [f"  {name:<{width}}  {reader.counts[name]:>5}  {reader.types[name]}" for name in sorted(reader.types)]
    return "\n".join(lines)


def _whole(path: Path | str) -> BagReader | None:
    """Return the reader of a bag; None if its checksums are wrong, or its info or result is lost.

    Its ticks are not decoded.

    Raises:
        NotAnEpisodeError: For a bag of another system.
    """
    try:
        if checksum_problems(mcap_file(path)):
            return None
        reader = BagReader(path)
        _ = reader.info, reader.result
        return reader
    except NotAnEpisodeError:
        raise
    except RecorderError:
        return None


def _outcome(reader: BagReader) -> str:
    result = reader.result
    return _named(result) + (f" ({result.reason})" if result.reason else "")


def _named(result: EpisodeResult) -> str:
    return f"{result.outcome}, recovered" if result.recovered else result.outcome


@dataclass(frozen=True, kw_only=True)
class DatasetSummary:
    """Summary of a folder of bags."""

    path: Path
    """The folder."""
    episodes: int
    """Bags kept."""
    set_apart: int
    """Bags set apart."""
    ticks: int
    """Ticks in the kept bags."""
    size_bytes: int
    """Size of the kept bags [B]."""
    outcomes: dict[str, int]
    """Outcome (with ``, recovered`` if the actor had to try again) to number of kept bags."""
    reasons: dict[str, int]
    """Reason of failure to number of bags, set apart ones included."""
    instructions: dict[str, int]
    """Instruction to number of kept bags."""
    robots: dict[str, int]
    """Robot to number of kept bags; a good dataset has one."""
    semantics: tuple[ActionSemantics, ...]
    """Action semantics that occur; a good dataset has one."""
    damaged: tuple[Path, ...] = ()
    """Kept bags that are damaged; they are in no other count."""

    @property
    def text(self) -> str:
        """Readable text of the summary."""

        def listed(counts: dict[str, int]) -> str:
            return ", ".join(f"{name} x{count}" for name, count in counts.items()) or "-"

        return "\n".join(
            [
                f"folder        {self.path}",
                f"episodes      {self.episodes} kept ({listed(self.outcomes)}), {self.set_apart} set apart"
                + (f", {len(self.damaged)} damaged" if self.damaged else ""),
                f"ticks         {self.ticks}",
                f"size          {self.size_bytes / 2**20:.1f} MiB",
                f"failures      {listed(self.reasons)}",
                f"instructions  {listed(self.instructions)}",
                f"robots        {listed(self.robots)}",
                f"semantics     {len(self.semantics)} kind(s)",
                *(f"damaged       {path}: {survey_bag(path).text}" for path in self.damaged),
            ]
        )


def dataset_summary(path: Path | str) -> DatasetSummary:
    """Summarise a run's folder or a folder of bags.

    Raises:
        RecorderError: When there are no bags, or one that was set apart is damaged.
    """
    bags = list_bags(path)
    outcomes: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    instructions: Counter[str] = Counter()
    robots: Counter[str] = Counter()
    semantics: dict[ActionSemantics, None] = {}
    ticks = size = 0
    damaged = []
    for bag in bags:
        reader = _whole(bag)
        if reader is None:
            damaged.append(bag)
            continue
        outcomes[_named(reader.result)] += 1
        instructions[reader.info.task.instruction] += 1
        robots[reader.info.scene.robot.model] += 1
        semantics[reader.info.semantics] = None
        ticks += len(reader)
        size += reader.file.stat().st_size
        reasons.update(_reason(reader.result))
    apart = sorted((Path(path) / PLACES["set_apart"]).glob("*/*.mcap"))
    for file in apart:
        reasons.update(_reason(BagReader(file).result))
    return DatasetSummary(
        path=Path(path),
        episodes=len(bags) - len(damaged),
        set_apart=len(apart),
        ticks=ticks,
        size_bytes=size,
        outcomes=dict(outcomes.most_common()),
        reasons=dict(reasons.most_common()),
        instructions=dict(instructions.most_common()),
        robots=dict(robots.most_common()),
        semantics=tuple(semantics),
        damaged=tuple(damaged),
    )


def _reason(result: EpisodeResult) -> Iterator[str]:
    if result.reason:
        yield result.reason
