"""Exports bags as an RLDS dataset, without TensorFlow; `roboxim_datasets.rlds` writes the files."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_datasets.rlds import RldsOptions
from roboxim_recorder.export.registry import EXPORTERS, FormatExporter
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
