"""Dataset formats by name.

A format is one file or folder of this package: a `DatasetFormat` registered under the format's name. Another
distribution adds a format through the entry point group ``roboxim.dataset_format``.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from roboxim_core.registry import Registry
from roboxim_datasets.dataset import Dataset, DatasetWriter, Description


class DatasetFormat(Protocol):
    """A format: finds, opens and writes datasets. Its first docstring line names it for people."""

    @property
    def options(self) -> type[Any]:
        """Frozen dataclass of the options for writing; every field has a default and a docstring."""

    def find(self, path: Path) -> list[Path]:
        """Return the datasets of this format that a path is, or that the folder holds; fast, by names of files."""

    def open(self, path: Path) -> Dataset:
        """Open a dataset that `find` returned.

        Raises:
            RecorderError: When its description is damaged, or of a version that is not known.
        """

    def path(self, target: Path, options: Any) -> Path:
        """Return the path of the dataset that `create` writes into ``target``."""

    def create(
        self, target: Path, description: Description, options: Any, *, identity: str, overwrite: bool
    ) -> AbstractContextManager[DatasetWriter]:
        """Start a dataset, or continue an interrupted one of the same identity.

        Args:
            target: Folder to write into.
            description: What its episodes have; an episode with less is refused.
            options: Of class `options`.
            identity: Distinguishes this content from others; another identity starts afresh.
            overwrite: Whether an existing dataset is replaced when the new one is whole.

        Raises:
            InvalidRequestError: On options or features that the format does not allow.
            RecorderError: ``EXPORT_REFUSED`` if the dataset exists and must not be overwritten.
        """


FORMATS: Registry[type[DatasetFormat]] = Registry("dataset format")
"""Format classes by name; they take no arguments."""


@FORMATS.conformance
def has_every_part(name: str, item: type[DatasetFormat]) -> None:
    """Refuse a format that the commands could not offer: it needs help, options, methods."""
    assert (item.__doc__ or "").strip(), "it has no docstring, whose first line is its title"
    made = item()
    missing = [method for method in ("find", "open", "path", "create") if not callable(getattr(made, method, None))]
    assert not missing, f"it has no method {', '.join(missing)}; see DatasetFormat"
    made.options()
