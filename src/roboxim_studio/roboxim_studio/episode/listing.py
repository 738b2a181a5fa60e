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
    """Its id, in an evaluation after the policy's name; of a bag that cannot be read, its folder's name."""
    episode: str = ""
    """Its id; empty: the bag cannot be read."""
    policy: str = ""
    """Folder of its policy in an evaluation; empty: the run has no such folders."""
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


def list_entries(bags: Sequence[Path], folder: Path) -> tuple[Entry, ...]:
    """Return the episodes of bags; a damaged one is listed as unreadable.

    Args:
        bags: The bags.
        folder: Folder of the run, or of the evaluation.

    Raises:
        ConfigError: When the results of their run are not readable.
    """
    runs = {bag.parent.parent for bag in bags}
    results = {(run, result.episode_id): result for run in runs for result in read_results(run)}
    return tuple(_entry(bag, results.get((bag.parent.parent, bag.name)), folder) for bag in bags)


def _entry(bag: Path, result: EpisodeResult | None, folder: Path) -> Entry:
    run = bag.parent.parent
    policy = run.name if run.parent == folder else ""
    before = f"{policy}/" if policy else ""
    try:
        if result is None:
            result = BagReader(bag).result
    except RoboximError as error:
        return Entry(name=before + bag.name, path=bag, policy=policy, reason=str(error))
    return Entry(
        name=before + result.episode_id,
        episode=result.episode_id, path=bag, policy=policy, skill=result.skill, instruction=result.instruction,
        outcome=result.outcome, reason=result.reason,
    )  # fmt: skip
