"""Opens a dataset of any registered format: `open_dataset` finds the format from the files."""

from __future__ import annotations

from pathlib import Path

from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.user_folders import expanded
from roboxim_datasets import hdf5, lerobot, rlds  # importing a format registers it
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.depth import checked_unit, is_named_depth
from roboxim_datasets.files import reading
from roboxim_datasets.registry import FORMATS, DatasetFormat

__all__ = ["FORMATS", "DatasetFormat", "hdf5", "lerobot", "open_dataset", "rlds"]


def open_dataset(path: Path | str, *, format: str = "", depth_unit_m: float = 0.0) -> Dataset:
    """Open a dataset of any registered format.

    Args:
        path: The dataset's folder or file, or a folder above it that holds a single dataset.
        format: Name of the format; empty: found from the files.
        depth_unit_m: Unit of the depth images of a dataset that does not say it [m]; 0: they are left out.

    Raises:
        ConfigError: When there is no dataset, or more than one, or the format is not known.
        InvalidRequestError: When a unit of depth is stated of a dataset that says it itself or has no depth images.
        RecorderError: When the dataset's description is damaged, or of a version that is not known.
    """
    place = expanded(path)
    if not place.exists():
        raise ConfigError(f"no such folder: {place}; expected a dataset, as 'roboxim export' makes it")
    found = [(name, at) for name in ([format] if format else FORMATS) for at in FORMATS[name]().find(place)]
    found = [(name, at) for name, at in found if at == place] or found  # not what lies below it, as by a link to it
    if len(found) == 1:
        name, at = found[0]
        with reading(at):
            return _with_depth(name, at, depth_unit_m) if depth_unit_m else FORMATS[name]().open(at)
    raise ConfigError(_not_one(place, found, format))


def _with_depth(name: str, path: Path, unit_m: float) -> Dataset:
    """Open a dataset whose unit of depth a user states."""
    open_with_depth = getattr(FORMATS[name](), "open_with_depth", None)
    dataset: Dataset | None = open_with_depth(path, checked_unit(unit_m)) if open_with_depth else None
    if dataset is not None and dataset.features.depth:
        return dataset
    lost = "" if dataset is None else "; ".join(
        f"{part.name}: {part.why}" for part in dataset.account.left_out if is_named_depth(f"{part.name} {part.why}")
    )  # fmt: skip
    raise InvalidRequestError(
        f"{path} has no depth images that could be read ({lost or f'format {name}'}); leave --depth-unit out"
    )


def _not_one(path: Path, found: list[tuple[str, Path]], format: str) -> str:
    """Return the error message for a path that is not one dataset."""
    if found:
        names = ", ".join(f"{at} ({name})" for name, at in found[:5]) + (", ..." if len(found) > 5 else "")
        return f"{path} holds {len(found)} datasets; name one of {names}"
    if any((path / name).exists() for name in ("episodes", RUN_FILE)) or any(path.glob("**/*.mcap")):
        export = shell_line("roboxim", "export", "rlds", path, "--out", f"{path}-rlds")
        return f"{path} holds bags, not a dataset; export them first: {export}"
    kinds = format or ", ".join(FORMATS)
    return f"{path} holds no dataset (formats: {kinds}); name the folder that 'roboxim export' or another tool wrote"
