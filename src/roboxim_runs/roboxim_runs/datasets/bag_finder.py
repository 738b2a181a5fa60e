"""Finds the bags that a dataset was exported from, by episode id and final state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_datasets.episode import Episode, whole_id
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import PLACES, REPAIRED

LEVELS_UP = 4
"""Number of folders above a dataset in whose runs its bags are sought."""


class BagFinder:
    """Finds the bags of a dataset's episodes by id and final state."""

    def __init__(self, dataset: Path, places: Sequence[Path]) -> None:
        """Prepare to search.

        Args:
            dataset: The dataset's folder or file.
            places: Runs, folders of bags or bags; none: the runs beside the dataset and beside the folders above it.

        Raises:
            ConfigError: When a place does not exist.
        """
        for place in places:
            if not place.exists():
                raise ConfigError(f"no such folder: {place}; expected a run, a folder of bags or a bag")
        self._places = list(places)
        self._above = list(dataset.resolve().parents[:LEVELS_UP])

    def find(self, episode: Episode) -> tuple[Path | None, str]:
        """Return an episode's bag and an empty text, or None and why there is none."""
        name = episode.episode_id
        if not name:
            return None, "the dataset does not say which episode it is"
        if Path(name).name != name or name.startswith("."):
            return None, f"{name!r} is no episode's id"
        expected = episode.metadata.get("final_state_hash")
        others, whole = 0, whole_id(name)
        for path in self._candidates(whole):
            try:
                reader = BagReader(path)
                fits = reader.info.episode_id == whole and expected in (None, reader.result.final_state_hash)
            except RecorderError as error:
                if error.code != ErrorCode.BAG_DAMAGED:
                    raise
                continue
            if fits and whole != name:
                return None, f"it has the steps of one actor of {path}; export the complete episode, without --acted-by"
            if fits:
                trimmed = _trimmed(episode, reader)
                return (None, trimmed) if trimmed else (path, "")
            others += 1
        if others:
            return None, f"{others} bags have its name, but another final state; name the run that it was exported from"
        return None, "its bag was not found; name the run that it was exported from"

    def _candidates(self, name: str) -> Iterator[Path]:
        """Yield folders of bags that have an episode's name."""
        names = (name, name + REPAIRED)
        for place in self._places:
            bag = place.parent if place.is_file() else place
            if bag.name in names:
                yield bag
            yield from _below(place, names)
        if not self._places:
            for folder in self._above:
                yield from _below(folder, names)
                for run in sorted(folder.glob("[!.]*")):
                    yield from _below(run, names)


def _trimmed(episode: Episode, bag: BagReader) -> str:
    """Return why an episode cannot be replayed if it lacks steps of its bag; empty: it has all, at its rate."""
    recorded_hz = bag.info.scene.control_rate_hz
    whole = bag.result.steps * (episode.fps or recorded_hz) / recorded_hz
    if abs(episode.length - whole) < 1:
        return ""
    return f"it was trimmed ({episode.length} steps, its bag has {whole:.0f} at this rate); export it untrimmed"


def _below(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    for place in ("", *PLACES.values()):
        for name in names:
            if (folder / place / name).is_dir():
                yield folder / place / name
