"""Exports recorded episodes as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_bringup.executors import Cancellation, CancelledError
from roboxim_bringup.runs.events import (
    Notice,
    OnEvent,
    StageFinished,
    StageProgress,
    StageStarted,
    ignore,
    telling_interruption,
)
from roboxim_bringup.runs.folder import RUN_FILE, RunFolder, checked_path, command_of
from roboxim_recorder.export import ExportReport, Selection, export_bags
from roboxim_recorder.export.rlds import ExportConfig

__all__ = ["ExportConfig", "ExportReport", "export_dataset", "export_rlds", "unfinished"]


def export_dataset(
    name: str,
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: Selection | None = None,
    *,
    overwrite: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> ExportReport:
    """Export the bags of runs as a dataset.

    The same call continues an interrupted export. An existing dataset of the same bags and configuration is kept.

    Args:
        name: Registered format, e.g. ``rlds``.
        source: A run's folder, a folder of bags, or one bag; or several of them.
        target: Folder to write the dataset into.
        config: Configuration of the format's class; none: the defaults.
        overwrite: Replace an existing dataset.
        on_event: Receives the run's events.
        cancellation: Ends the export when it is set.

    Raises:
        CancelledError: When the export was cancelled.
        ConfigError: On an unknown format.
        InvalidRequestError: On a name, camera or size that does not fit.
        RecorderError: ``EXPORT_REFUSED`` when there is nothing to export, when bags are missing or do not fit together,
            or when the dataset exists; ``BAG_DAMAGED`` naming the bag; ``DISK`` when it cannot be written.
    """
    checked_path(target)
    sources = [Path(source)] if isinstance(source, str | Path) else [Path(path) for path in source]
    for note in filter(None, map(unfinished, sources)):
        on_event(Notice(text=f"{note}; later episodes need another export with --overwrite or overwrite=True"))

    def progress(done: int, total: int) -> None:
        if cancellation is not None and cancellation.is_set():
            raise CancelledError("the export was cancelled")
        on_event(StageProgress(done=done, total=total))

    with telling_interruption(on_event, lambda: "the same call or command continues the export"):
        on_event(StageStarted(title="exporting", total=1, unit="episodes"))
        report = export_bags(
            name, sources, target, config, if_exists="overwrite" if overwrite else "keep", progress=progress
        )
        on_event(StageFinished())
    return report


def export_rlds(
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: ExportConfig | None = None,
    *,
    overwrite: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> ExportReport:
    """Export as RLDS, loadable by TensorFlow Datasets, Octo and OpenVLA; see `export_dataset`."""
    return export_dataset(
        "rlds", source, target, config, overwrite=overwrite, on_event=on_event, cancellation=cancellation
    )


def unfinished(source: Path) -> str:
    """Return the progress of an unfinished source run; empty when it is finished, or when the source is not a run."""
    folder = RunFolder(source.parent if source.name == "episodes" else source)
    if not (folder.path / RUN_FILE).exists():
        return ""
    config, done = folder.config(), len(folder.results())
    wanted = int(config.get("episodes", done))
    running = folder.in_use
    if not running and done >= wanted:
        return ""
    far = f"{done} of {wanted} episodes are done" if "episodes" in config else f"{done} episodes are done"
    command = f"'roboxim {command_of(config)}'"
    return f"{far}; " + (f"{command} is still running there" if running else f"{command} was stopped there")
