"""Dataset formats that bags are exported to, by name.

A format is one file: a configuration (a subclass of `Selection` with the format's own fields), an `Exporter` registered
under the format's name, and a `DatasetWriter`. `export_bags` does the rest. Another distribution adds a format through
the entry point group ``roboxim.exporter``.
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
    """Content of a complete dataset."""

    splits: dict[str, int]
    """Split to number of episodes."""
    dead_dimensions: tuple[str, ...] = ()
    """Components of the action that (nearly) never change; a policy cannot learn them."""


class DatasetWriter(Protocol):
    """Writes one dataset. An interruption leaves it resumable; its folder gets the final name only when it is whole."""

    def resumed(self, split: str) -> int:
        """Return how many leading episodes of a split an interrupted export has already written."""

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode to a split, ``train`` or ``val``."""

    def complete(self, files: Mapping[str, str]) -> None:
        """Move the dataset to its final place, with further text files by name."""


class Exporter(Protocol):
    """A dataset format. Its first docstring line is the command line's help."""

    @property
    def config(self) -> type[Selection]:
        """Class of the format's configuration."""

    def path(self, target: Path, config: Any) -> Path:
        """Return the path of the dataset of a configuration."""

    def open(
        self, target: Path, config: Any, selected: Selected, *, identity: str, overwrite: bool
    ) -> AbstractContextManager[DatasetWriter]:
        """Start a dataset, or continue an interrupted one of the same identity.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` if the dataset exists and must not be overwritten.
        """

    def contents(self, path: Path) -> DatasetContents:
        """Read the content of a complete dataset."""


EXPORTERS: Registry[type[Exporter]] = Registry("exporter")
"""Exporter classes by format name; they take no arguments."""


@EXPORTERS.conformance
def says_what_it_writes(name: str, item: type[Exporter]) -> None:
    """Refuse a format that the command line could not offer: it needs help, a configuration, methods."""
    assert (item.__doc__ or "").strip(), "it has no docstring, whose first line is the command line's help"
    exporter = item()
    assert isinstance(exporter.config, type), "config is no class"
    assert issubclass(exporter.config, Selection), "config does not derive from Selection"
    missing = [method for method in ("path", "open", "contents") if not callable(getattr(exporter, method, None))]
    assert not missing, f"it has no method {', '.join(missing)}; see Exporter"
