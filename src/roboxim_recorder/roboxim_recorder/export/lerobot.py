"""Exports bags as a LeRobot dataset, without lerobot; `roboxim_datasets.lerobot` writes the files."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_recorder.export.registry import EXPORTERS, FormatExporter
from roboxim_recorder.export.selection import Selection


@dataclass(frozen=True, kw_only=True)
class LeRobotConfig(LeRobotOptions, Selection):
    """Configuration of a LeRobot export."""

    def __post_init__(self) -> None:
        """Check the fields of both parts.

        Raises:
            InvalidRequestError: On a value out of range, or options that do not fit together.
        """
        Selection.__post_init__(self)
        LeRobotOptions.__post_init__(self)


@EXPORTERS.register("lerobot")
class LeRobotExporter(FormatExporter):
    """Export the bags of a run as a LeRobot dataset, loadable by lerobot, openpi and GR00T; needs no lerobot."""

    format = "lerobot"
    config = LeRobotConfig
