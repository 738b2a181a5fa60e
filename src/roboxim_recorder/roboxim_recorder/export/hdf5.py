"""Exports bags as an HDF5 dataset in robomimic's layout; `roboxim_datasets.hdf5` writes the file."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_datasets.hdf5 import Hdf5Options
from roboxim_recorder.export.registry import EXPORTERS, FormatExporter
from roboxim_recorder.export.selection import Selection


@dataclass(frozen=True, kw_only=True)
class Hdf5Config(Hdf5Options, Selection):
    """Configuration of an HDF5 export."""


@EXPORTERS.register("hdf5")
class Hdf5Exporter(FormatExporter):
    """Export the bags of a run as HDF5, loadable by robomimic and diffusion_policy."""

    format = "hdf5"
    config = Hdf5Config
