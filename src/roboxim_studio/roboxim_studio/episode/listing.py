"""The episodes of a folder, each in one line: from the run's results, else from the bags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import RoboximError
from roboxim_recorder.bag import BagReader
from roboxim_recorder.run_bags import read_results


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One episode."""

    name: str
    """Its id; of a bag that cannot be read, its folder's name."""
    path: Path
    """The bag."""
    skill: str = ""
    """Skill of its task."""
    instruction: str = ""
    """Its instruction."""
    outcome: str = "unreadable"
    """``success``, ``failure``, ``error`` or ``unreadable``."""
    reason: str = ""
    """Why it did not succeed, or cannot be read."""

    @property
    def ending(self) -> str:
        """Outcome and reason."""
        return self.outcome if not self.reason else f"{self.outcome}, {self.reason}"


def list_entries(bags: Sequence[Path]) -> tuple[Entry, ...]:
    """Return the episodes of bags; a damaged one is listed as unreadable.

    Raises:
        ConfigError: When the results of their run are not readable.
    """
    results = {
        result.episode_id: result for run in sorted({bag.parent.parent for bag in bags}) for result in read_results(run)
    }
    return tuple(_entry(bag, results.get(bag.name)) for bag in bags)


def _entry(bag: Path, result: EpisodeResult | None) -> Entry:
    try:
        if result is None:
            result = BagReader(bag).result
    except RoboximError as error:
        return Entry(name=bag.name, path=bag, reason=str(error))
    return Entry(
        name=result.episode_id, path=bag, skill=result.skill, instruction=result.instruction, outcome=result.outcome,
        reason=result.reason,
    )  # fmt: skip
