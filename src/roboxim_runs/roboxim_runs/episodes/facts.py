"""Facts of recorded episodes that reports need: recorded draws, and where the first object started.

Reading them from a bag takes a tenth of a second, so they are stored in ``facts.jsonl`` beside the results. They
survive the loss of the bags.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_runs.storage.results_log import ResultsLog

FACTS_FILE = "facts.jsonl"


@dataclass(frozen=True, kw_only=True)
class EpisodeFacts:
    """Facts of one episode."""

    episode_id: str
    """The episode."""
    drawn: dict[str, str] = field(default_factory=dict)
    """Named draws of its reset components."""
    start: tuple[float, float] | None = None
    """Place of the task's first object at the start: x away from the robot, y to its left [m]; none: it has none."""


def episode_facts(
    folder: Path, results: Iterable[EpisodeResult], *, bags: Path | None = None
) -> dict[str, EpisodeFacts]:
    """Return the facts of a run's episodes by episode id; those without a bag and stored facts are left out.

    Args:
        folder: The run's folder, in which facts are stored.
        results: Its results.
        bags: Folder with the bags, under their paths in the run; none: the run's.

    Raises:
        ConfigError: When the stored facts are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag is not whole.
    """
    log = ResultsLog(folder / FACTS_FILE)
    found = {entry.key: from_plain(entry.data, EpisodeFacts, source=str(log.path)) for entry in log.read()}
    bags = folder if bags is None else bags
    for result in results:
        if result.episode_id not in found and result.bag and (bags / result.bag).exists():
            found[result.episode_id] = _facts(bags / result.bag)
            log.append(result.episode_id, to_plain(found[result.episode_id]))
    return found


def _facts(bag: Path) -> EpisodeFacts:
    from roboxim_recorder.bag import BagReader

    info = BagReader(bag).info
    return EpisodeFacts(episode_id=info.episode_id, drawn=dict(info.task.drawn), start=_start(info))


def _start(info: EpisodeInfo) -> tuple[float, float] | None:
    roles = info.task.objects
    first = roles.get("target") or next(iter(roles.values()), None)
    entity = next((e for e in info.scene.entities if first is not None and e.name == first.entity), None)
    if entity is None:
        return None
    return float(entity.pose.position[0]), float(entity.pose.position[1])
