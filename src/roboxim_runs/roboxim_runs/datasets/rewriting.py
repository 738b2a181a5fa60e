"""Converts, merges, splits and compares datasets of any format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.user_folders import expanded
from roboxim_datasets.choosing import chosen_plan
from roboxim_datasets.compare import LOWEST_PSNR_DB, Comparison, Images, compare
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.formats import FORMATS, open_dataset
from roboxim_datasets.plans import Plan, plan_of, split_plan
from roboxim_datasets.rewrite import Written, options_like, require_all_shards, write_dataset
from roboxim_recorder.driven import DrivenDataset, is_driven
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.storage.folder import path_as_given
from roboxim_runs.storage.occupied import require_free_for_dataset

__all__ = ["Comparison", "Written", "compare_datasets", "convert_dataset", "merge_datasets", "split_dataset"]


def convert_dataset(
    source: Path | str,
    target: Path | str,
    format: str,
    options: Any = None,
    *,
    fps: float = 0.0,
    depth_unit_m: float = 0.0,
    instruction: str = "",
    where: Sequence[str] = (),
    overwrite: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> Written:
    """Write a dataset in another format. The same call continues an interrupted conversion.

    Args:
        source: The dataset, or a bag of a driven graph (`roboxim_recorder.driven`); it is only read.
        target: Folder to write into.
        format: Registered name of the format.
        options: Options of the format; None: the defaults.
        fps: Steps per second of a source that does not say it; 0: unknown.
        depth_unit_m: Unit of depth images of a source that does not say it [m]; 0: they are left out.
        instruction: What was done in a bag of a driven graph, which does not say it.
        where: Conditions and edits, see `roboxim_datasets.choosing.chosen_plan`; empty: every episode as it is.
        overwrite: Replace an existing dataset.
        on_event: Receives the run's events.
        cancellation: Ends the conversion when it is set.

    Raises:
        CancelledError: When the conversion was cancelled.
        ConfigError: When there is no such dataset or format, or the target is a run, a training or another command's
            folder.
        InvalidRequestError: When the format does not hold what the episodes have.
        RecorderError: ``EXPORT_REFUSED`` when the target exists or lies in the source; ``BAG_DAMAGED`` when the source
            cannot be read.
    """
    opened = _opened(expanded(source), instruction, depth_unit_m)
    plan = chosen_plan(opened, where) if where else plan_of(opened)
    reporter = Reporter(on_event, cancellation)
    more: dict[str, Any] = {"overwrite": overwrite, "fps": fps, "where": where}
    return _write(plan, expanded(target), format, options, "convert", reporter, **more)


def _opened(source: Path, instruction: str, depth_unit_m: float) -> Dataset:
    if source.exists() and is_driven(source):
        if depth_unit_m:
            raise ConfigError(f"{source} is a bag, whose depth is in metres; leave --depth-unit out")
        if not instruction:
            raise ConfigError(f"{source} is a bag of a driven graph, which states no instruction: give --instruction")
        return DrivenDataset(source, instruction)
    if instruction:
        raise ConfigError(f"{source} is no bag of a driven graph: a dataset has instructions of its own")
    return open_dataset(source, depth_unit_m=depth_unit_m)


def merge_datasets(
    sources: Sequence[Path | str],
    target: Path | str,
    *,
    partial: bool = False,
    overwrite: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> Written:
    """Write several datasets of one format as one, split by split. The same call continues an interrupted merge.

    Args:
        sources: The datasets; they are only read. They must have the same features, meaning of actions and robot.
        target: Folder to write into.
        partial: Accept that shards of an export are missing.
        overwrite: Replace an existing dataset.
        on_event: Receives the run's events.
        cancellation: Ends the merge when it is set.

    Raises:
        CancelledError: When the merge was cancelled.
        ConfigError: When there is no such dataset, or the formats differ.
        RecorderError: ``EXPORT_REFUSED`` when the datasets do not fit together, an episode occurs twice, or shards of
            an export are missing.
    """
    datasets = [open_dataset(source) for source in sources]
    kinds = {dataset.format for dataset in datasets}
    if len(kinds) > 1:
        raise ConfigError(f"datasets of several formats ({', '.join(sorted(kinds))}); convert them to one first")
    if not partial:
        require_all_shards(datasets)
    plan = plan_of(*datasets)
    return _write_like(datasets[0], plan, expanded(target), "merge", Reporter(on_event, cancellation), overwrite)


def split_dataset(
    source: Path | str,
    target: Path | str,
    counts: Mapping[str, int],
    *,
    apart: bool = False,
    overwrite: bool = False,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> dict[str, Written]:
    """Divide a dataset into other splits. The same call continues an interrupted one.

    Args:
        source: The dataset; it is only read.
        target: Folder to write into.
        counts: Split to its number of episodes; 0: the rest.
        apart: Whether each split becomes a separate dataset, ``target/<split>``, for trainers that ignore splits.
        overwrite: Replace existing datasets.
        on_event: Receives the run's events.
        cancellation: Ends it when it is set.

    Returns:
        Split to the dataset that holds it.

    Raises:
        CancelledError: When it was cancelled.
        ConfigError: When there is no such dataset.
        InvalidRequestError: When the counts are not those of the dataset.
        RecorderError: ``EXPORT_REFUSED`` when the target exists or lies in the source.
    """
    dataset = open_dataset(source)
    plan = split_plan(dataset, counts)
    target, reporter = expanded(target), Reporter(on_event, cancellation)
    if not apart:
        return dict.fromkeys(plan, _write_like(dataset, plan, target, "split", reporter, overwrite))
    return {
        split: _write_like(dataset, {"train": places}, target / split, "split", reporter, overwrite)
        for split, places in plan.items()
    }


def compare_datasets(
    a: Path | str,
    b: Path | str,
    *,
    images: Images = "auto",
    lowest_psnr_db: float = LOWEST_PSNR_DB,
    ignore_names: Sequence[str] = (),
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> Comparison:
    """Compare two datasets of any formats; see `roboxim_datasets.compare.compare`.

    Raises:
        CancelledError: When it was cancelled.
        ConfigError: When there is no such dataset.
        RecorderError: With code ``BAG_DAMAGED`` when one cannot be read.
    """
    one, other = open_dataset(a), open_dataset(b)
    with Reporter(on_event, cancellation).stage("comparing", len(one), "episodes") as progress:
        return compare(
            one, other, images=images, lowest_psnr_db=lowest_psnr_db, ignore=ignore_names, progress=progress
        )  # fmt: skip


def _write_like(
    dataset: Dataset, plan: Plan, target: Path, how: str, reporter: Reporter, overwrite: bool
) -> Written:  # fmt: skip
    """Write a dataset in the format and with the options of another one."""
    return _write(plan, target, dataset.format, options_like(dataset), how, reporter, overwrite=overwrite)


def _write(
    plan: Plan, target: Path, format: str, options: Any, how: str, reporter: Reporter, **more: Any
) -> Written:  # fmt: skip
    target = path_as_given(target)
    made = FORMATS[format]()
    place = made.path(target, options if options is not None else made.options())
    require_free_for_dataset(target, place, format, f"dataset {how}")
    with (
        reporter.resumable("the same call or command continues it"),
        reporter.stage(f"writing {format}", sum(map(len, plan.values())), "episodes") as progress,
    ):
        return write_dataset(
            plan, target, format, options, how=how, keep_keys=how != "convert", progress=progress, **more
        )  # fmt: skip
