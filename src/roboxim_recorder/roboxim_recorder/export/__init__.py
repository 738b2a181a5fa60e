"""Exports bags as datasets; one file per format."""

from roboxim_recorder.export import hdf5, lerobot, rlds  # importing a format registers it
from roboxim_recorder.export.registry import EXPORTERS, DatasetContents, Exporter, FormatExporter
from roboxim_recorder.export.run import ExportReport, export_bags
from roboxim_recorder.export.selection import Selection

__all__ = [
    "EXPORTERS",
    "DatasetContents",
    "ExportReport",
    "Exporter",
    "FormatExporter",
    "Selection",
    "export_bags",
    "hdf5",
    "lerobot",
    "rlds",
]
