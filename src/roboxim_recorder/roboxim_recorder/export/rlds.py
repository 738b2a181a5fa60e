"""Exports bags as an RLDS dataset, without TensorFlow; `roboxim_datasets.rlds` writes the files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from roboxim_datasets.rlds import RldsOptions
from roboxim_datasets.rlds.loader_files import action_statistics, dead_dimensions
from roboxim_datasets.rlds.reader import RldsDataset
from roboxim_recorder.export.registry import EXPORTERS, DatasetContents, FormatExporter
from roboxim_recorder.export.run import ExportReport, Progress, export_bags
from roboxim_recorder.export.selection import Selection


@dataclass(frozen=True, kw_only=True)
class ExportConfig(RldsOptions, Selection):
    """Configuration of an RLDS export."""

    def __post_init__(self) -> None:
        """Check the fields of both parts.

        Raises:
            InvalidRequestError: On a value out of range, or a name of another dataset's family.
        """
        Selection.__post_init__(self)
        RldsOptions.__post_init__(self)


@EXPORTERS.register("rlds")
class RldsExporter(FormatExporter):
    """Export the bags of a run as RLDS, loadable by TensorFlow Datasets, Octo and OpenVLA; needs no TensorFlow."""

    format = "rlds"
    config = ExportConfig

    def contents(self, path: Path) -> DatasetContents:
        """Read the description and the statistics of a dataset."""
        dataset = RldsDataset(path)
        dead = dead_dimensions(action_statistics(path), dataset.features.action)
        return DatasetContents(splits=dict(dataset.splits), dead_dimensions=dead)


def export_rlds(
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: ExportConfig | None = None,
    *,
    if_exists: Literal["refuse", "overwrite", "keep"] = "refuse",
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> ExportReport:
    """Export bags as RLDS; see `export_bags`."""
    return export_bags("rlds", source, target, config, if_exists=if_exists, workers=workers, progress=progress)
