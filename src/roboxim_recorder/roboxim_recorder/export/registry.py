"""Dataset formats that bags are exported to, by name.

A format is one file: a configuration (a subclass of `Selection` with the format's own fields), an `Exporter` registered
under the format's name, and a `DatasetWriter`. `export_bags` does the rest. A distribution of one's own adds a format
through the entry point group ``roboxim.exporter``.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from roboxim_core.registry import Registry
from roboxim_datasets.episode import Episode
from roboxim_recorder.export.selection import Selected, Selection


@dataclass(frozen=True, kw_only=True)
class DatasetContents:
    """What a complete dataset holds."""

    splits: dict[str, int]
    """Split to number of episodes."""
    dead_dimensions: tuple[str, ...] = ()
    """Components of the action that (nearly) never change; a policy cannot learn them."""


class DatasetWriter(Protocol):
    """Writes one dataset. An interruption leaves it resumable; nothing carries its name before it is whole."""

    def resumed(self, split: str) -> int:
        """Count the first episodes of a split that an interrupted export has already written."""

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode to a split, ``train`` or ``val``."""

    def complete(self, files: Mapping[str, str]) -> None:
        """Put the dataset in its place, with further text files by name."""


class Exporter(Protocol):
    """A dataset format. Its first docstring line is the command line's help."""

    @property
    def config(self) -> type[Selection]:
        """Class of its configuration."""

    def path(self, target: Path, config: Any) -> Path:
        """Return where a dataset of a configuration goes."""

    def open(
        self, target: Path, config: Any, selected: Selected, *, identity: str, overwrite: bool
    ) -> AbstractContextManager[DatasetWriter]:
        """Start a dataset, or go on with an interrupted one of the same identity.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` when the dataset exists and is not to be overwritten.
        """

    def contents(self, path: Path) -> DatasetContents:
        """Read what a complete dataset holds."""


EXPORTERS: Registry[type[Exporter]] = Registry("exporter")
"""Formats by name; a format is made without arguments."""
