"""Dataset formats that bags are exported to, by name.

An exporter is one file: a configuration (a subclass of `Selection` with the format's options) and an `Exporter`
registered under the format's name. `export_bags` does the rest. The exporter of a format of
`roboxim_datasets.registry.FORMATS` is a `FormatExporter`. Another distribution adds an exporter through the entry point
group ``roboxim.exporter``.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from roboxim_core.registry import Registry
from roboxim_datasets.card import dead_action_components
from roboxim_datasets.dataset import DatasetWriter, Description
from roboxim_datasets.formats import FORMATS
from roboxim_recorder.export.selection import Selection


@dataclass(frozen=True, kw_only=True)
class DatasetContents:
    """Content of a complete dataset."""

    splits: dict[str, int]
    """Split to number of episodes."""
    dead_dimensions: tuple[str, ...] = ()
    """Components of the action that (nearly) never change; a policy cannot learn them."""


class Exporter(Protocol):
    """A dataset format. Its first docstring line is the command line's help."""

    @property
    def config(self) -> type[Selection]:
        """Class of the format's configuration."""

    def path(self, target: Path, config: Any) -> Path:
        """Return the path of the dataset of a configuration."""

    def open(
        self, target: Path, config: Any, description: Description, *, identity: str, overwrite: bool
    ) -> AbstractContextManager[DatasetWriter]:
        """Start a dataset, or continue an interrupted one of the same identity.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` if the dataset exists and must not be overwritten.
        """

    def contents(self, path: Path) -> DatasetContents:
        """Read the content of a complete dataset."""


class FormatExporter:
    """Base class of the exporters to formats of `roboxim_datasets`.

    A subclass names ``format`` and ``config``, whose class derives from `Selection` and from the format's options.
    """

    format: ClassVar[str]
    config: ClassVar[type[Selection]]

    def path(self, target: Path, config: Any) -> Path:
        """Return the path of the dataset of a configuration."""
        return FORMATS[self.format]().path(target, config)

    def open(
        self, target: Path, config: Any, description: Description, *, identity: str, overwrite: bool
    ) -> AbstractContextManager[DatasetWriter]:
        """Start a dataset, or continue an interrupted one of the same identity."""
        made = FORMATS[self.format]()
        return made.create(target, description, config, identity=identity, overwrite=overwrite)

    def contents(self, path: Path) -> DatasetContents:
        """Read the number of episodes of a dataset."""
        dataset = FORMATS[self.format]().open(path)
        return DatasetContents(splits=dict(dataset.splits), dead_dimensions=dead_action_components(dataset))


EXPORTERS: Registry[type[Exporter]] = Registry("exporter")
"""Exporter classes by format name; they take no arguments."""


@EXPORTERS.conformance
def says_what_it_writes(name: str, item: type[Exporter]) -> None:
    """Refuse a format that lacks a part for the command line: help, configuration or methods."""
    assert (item.__doc__ or "").strip(), "it has no docstring, whose first line is the command line's help"
    exporter = item()
    assert isinstance(exporter.config, type), "config is no class"
    assert issubclass(exporter.config, Selection), "config does not derive from Selection"
    missing = [method for method in ("path", "open", "contents") if not callable(getattr(exporter, method, None))]
    assert not missing, f"it has no method {', '.join(missing)}; see Exporter"
