"""Exports bags as an HDF5 dataset in robomimic's layout; `roboxim_datasets.hdf5` writes the file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roboxim_datasets.hdf5 import Hdf5Dataset, Hdf5Options
from roboxim_datasets.statistics import dead_components
from roboxim_recorder.export.registry import EXPORTERS, DatasetContents, FormatExporter
from roboxim_recorder.export.selection import Selection


@dataclass(frozen=True, kw_only=True)
class Hdf5Config(Hdf5Options, Selection):
    """Configuration of an HDF5 export."""


@EXPORTERS.register("hdf5")
class Hdf5Exporter(FormatExporter):
    """Export the bags of a run as HDF5, loadable by robomimic and diffusion_policy."""

    format = "hdf5"
    config = Hdf5Config

    def contents(self, path: Path) -> DatasetContents:
        """Read the description and the statistics of a dataset."""
        dataset = Hdf5Dataset(path)
        dead = dead_components(dataset.features.action, dataset.statistics["actions"]["std"])
        return DatasetContents(splits=dict(dataset.splits), dead_dimensions=dead)
