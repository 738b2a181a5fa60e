"""Exports recorded episodes as a dataset."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, one_of
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_core.user_folders import expanded
from roboxim_core.whole_files import write_whole
from roboxim_datasets.build import replace_whole, restore
from roboxim_datasets.dataset import EXPORT_FILE
from roboxim_recorder.bag_writer import disk_errors
from roboxim_recorder.export import EXPORTERS, ExportReport, Selection, export_bags
from roboxim_recorder.export.hdf5 import Hdf5Config
from roboxim_recorder.export.lerobot import LeRobotConfig
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.storage.folder import RunFolder, path_as_given, wanted_indices
from roboxim_runs.storage.occupied import command_of, require_free_for_dataset

REPLAY_FILE = "replay.json"
"""File beside a dataset that has passed or not passed the gate, with every episode and tick."""
STAGED = ".gate"
"""Ending of the folder of an export until it has passed the gate."""
REFUSED = ".refused"
"""Ending of the folder of an export that has not passed the gate."""
TRAINERS: dict[str, tuple[str, dict[str, str]]] = {
    **{name: ("lerobot", {"version": "3.0", "columns": "lerobot"}) for name in ("act", "diffusion", "smolvla", "pi0")},
    "openpi": ("lerobot", {"version": "2.1", "columns": "openpi"}),
    "groot": ("lerobot", {"version": "2.1", "columns": "groot"}),
    **{name: ("rlds", {}) for name in ("bc", "rt1s", "octo", "openvla")},
    **{name: ("hdf5", {}) for name in ("robomimic", "diffusion_policy", "libero")},
}
"""Trainer to the format that it reads, and the options of its export."""
IfExists = Literal["refuse", "overwrite", "keep"]

__all__ = [
    "ExportConfig",
    "TRAINERS",
    "ExportReport",
    "Hdf5Config",
    "LeRobotConfig",
    "export_dataset",
    "trainer_options",
    "unfinished",
]


def trainer_options(trainer: str, form: str, given: Mapping[str, str]) -> dict[str, str]:
    """Return the options of an export that a trainer reads.

    Args:
        trainer: One of `TRAINERS`.
        form: Format of the export.
        given: Options that were chosen, which must be the trainer's.

    Raises:
        ConfigError: When the trainer is unknown, reads another format, or needs another option than the given one.
    """
    if trainer not in TRAINERS:
        raise ConfigError(f"unknown trainer '{trainer}'; {one_of(TRAINERS, trainer)}")
    reads, options = TRAINERS[trainer]
    if reads != form:
        raise ConfigError(f"{trainer} reads {reads}: roboxim export {reads} ... --for {trainer}")
    for name, value in options.items():
        if given.get(name, value) != value:
            raise ConfigError(f"{trainer} needs --{name} {value}, got --{name} {given[name]}; leave it out")
    return options


def export_dataset(
    format: str,
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: Selection | None = None,
    *,
    overwrite: bool = False,
    gate: int = 0,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> ExportReport:
    """Export the bags of runs as a dataset.

    The same call continues an interrupted export. An existing dataset of the same bags and configuration is kept.

    With a gate, the dataset gets its place only after some of its episodes were executed again and retained their
    successes (`roboxim_runs.datasets.replay_gate`); a refused one is left in ``<target>.refused``. The result is in the
    dataset's `REPLAY_FILE`.

    Args:
        format: Registered format, e.g. ``rlds``.
        source: A run's folder, a folder of bags, or one bag; or several of them.
        target: Folder to write the dataset into.
        config: Configuration of the format's class; none: the defaults.
        overwrite: Replace an existing dataset.
        gate: Number of episodes to execute again, spread evenly; 0: no gate.
        workers: Processes that read and encode episodes (see `export_bags`) and that execute them again.
        on_event: Receives the run's events.
        cancellation: Ends the export when it is set.

    Raises:
        CancelledError: When the export was cancelled.
        ConfigError: On an unknown format, or when the target is a run, a training or another command's folder.
        InvalidRequestError: On a name, camera or size that does not fit.
        RecorderError: ``EXPORT_REFUSED`` when there is nothing to export, when bags are missing or do not fit together,
            when the dataset exists, or when it does not pass the gate; ``BAG_DAMAGED`` naming the bag; ``DISK`` when it
            cannot be written.
    """
    target = path_as_given(target)
    sources = [expanded(path) for path in ([source] if isinstance(source, str | Path) else source)]
    exporter = EXPORTERS[format]()
    settings = config if config is not None else exporter.config()
    if isinstance(settings, exporter.config):  # else `export_bags` refuses it
        require_free_for_dataset(target, exporter.path(target, settings), format, f"export {format}")
    reporter = Reporter(on_event, cancellation)
    for note in filter(None, map(unfinished, sources)):
        reporter.notice(f"{note}; later episodes need another export with --overwrite or overwrite=True")

    def export(place: Path, if_exists: IfExists) -> ExportReport:
        with (
            reporter.resumable("the same call or command continues the export"),
            reporter.stage("exporting", unit="episodes") as progress,
        ):
            return export_bags(format, sources, place, config, if_exists=if_exists, workers=workers, progress=progress)

    def refusal(dataset: Path) -> str:
        from roboxim_runs.datasets.replay_gate import replay_dataset  # imports the simulator

        replayed = replay_dataset(
            dataset, sources, episodes=gate, workers=max(1, workers), on_event=on_event, cancellation=cancellation
        )
        folder = dataset if dataset.is_dir() else dataset.parent
        write_whole(folder / REPLAY_FILE, replayed.to_json())
        reporter.notice("\n".join(list(replayed.lines)[1:]))
        return replayed.refusal

    if gate:
        return gated(target, exporter.path(target, settings), export, refusal, overwrite=overwrite)
    return export(target, "overwrite" if overwrite else "keep")


def gated(
    target: Path,
    place: Path,
    export: Callable[[Path, IfExists], ExportReport],
    refusal: Callable[[Path], str],
    *,
    overwrite: bool = False,
) -> ExportReport:
    """Export to a folder beside the target, and move the dataset to the target if it is not refused.

    Args:
        target: Folder that the dataset belongs into.
        place: Path of the dataset, which is the target or lies in it.
        export: Exports into a folder.
        refusal: Returns why a dataset is refused; empty: it passes.
        overwrite: Whether a dataset that is there already is replaced.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` when the dataset is refused, or when something else has its place; as
            ``export`` does.
    """
    aside = place.with_name(f".{place.name}.old")
    with disk_errors(place):
        restore(place, aside)
    taken = place.is_file() or (place.is_dir() and any(place.iterdir()))
    if taken and overwrite and not (place / EXPORT_FILE).is_file():
        raise RecorderError(f"{place} exists and is not an export; choose another folder", ErrorCode.EXPORT_REFUSED)
    if taken and not overwrite:  # a dataset of the same bags and settings, or another: an error
        report, stage = export(target, "keep"), None
    else:
        stage = target.with_name(f"{target.name}{STAGED}")
        report = export(stage, "overwrite")
    if why := refusal(report.path):
        if stage is not None:
            kept = target.with_name(f"{target.name}{REFUSED}")
            with disk_errors(kept):
                shutil.rmtree(kept, ignore_errors=True)
                stage.rename(kept)
            why += f"; the refused dataset is in {kept}"
        raise RecorderError(f"the export does not pass the replay gate: {why}", ErrorCode.EXPORT_REFUSED)
    if stage is None:
        return report
    with disk_errors(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        replace_whole(report.path, place, aside)
        restore(place, aside)
        shutil.rmtree(stage, ignore_errors=True)
    return replace(report, path=place)


def unfinished(source: Path) -> str:
    """Return the progress of an unfinished source run; empty when it is finished, or when the source is not a run."""
    folder = RunFolder(source.parent if source.name == "episodes" else source)
    if not (folder.path / RUN_FILE).exists():
        return ""
    config, done = folder.config(), len(folder.results())
    wanted = len(wanted_indices(config)) if "episodes" in config else done
    running = folder.in_use
    if not running and done >= wanted:
        return ""
    far = f"{done} of {wanted} episodes are done" if "episodes" in config else f"{done} episodes are done"
    command = f"'roboxim {command_of(config)}'"
    return f"{far}; " + (f"{command} is still running there" if running else f"{command} was stopped there")
