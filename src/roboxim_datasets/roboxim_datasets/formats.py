"""Opens a dataset of any registered format: `open_dataset` finds the format from the files."""

from __future__ import annotations

from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_datasets import hdf5, lerobot, rlds  # importing a format registers it
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.files import reading
from roboxim_datasets.registry import FORMATS, DatasetFormat

__all__ = ["FORMATS", "DatasetFormat", "hdf5", "lerobot", "open_dataset", "rlds"]


def open_dataset(path: Path | str, *, format: str = "") -> Dataset:
    """Open a dataset of any registered format.

    Args:
        path: The dataset's folder or file, or a folder above it that holds a single dataset.
        format: Name of the format; empty: found from the files.

    Raises:
        ConfigError: When there is no dataset, or more than one, or the format is not known.
        RecorderError: When the dataset's description is damaged, or of a version that is not known.
    """
    place = Path(path)
    if not place.exists():
        raise ConfigError(f"no such folder: {place}; expected a dataset, as 'roboxim export' makes it")
    found = [(name, at) for name in ([format] if format else FORMATS) for at in FORMATS[name]().find(place)]
    found = [(name, at) for name, at in found if at == place] or found  # not what lies below it, as by a link to it
    if len(found) == 1:
        name, at = found[0]
        with reading(at):
            return FORMATS[name]().open(at)
    raise ConfigError(_not_one(place, found, format))


def _not_one(path: Path, found: list[tuple[str, Path]], format: str) -> str:
    """Return the error message for a path that is not one dataset."""
    if found:
        names = ", ".join(f"{at} ({name})" for name, at in found[:5]) + (", ..." if len(found) > 5 else "")
        return f"{path} holds {len(found)} datasets; name one of {names}"
    if any((path / name).exists() for name in ("episodes", "run.json")) or any(path.glob("**/*.mcap")):
        return f"{path} holds bags, not a dataset; export them first: roboxim export rlds {path} --out {path}-rlds"
    kinds = format or ", ".join(FORMATS)
    return f"{path} holds no dataset (formats: {kinds}); name the folder that 'roboxim export' or another tool wrote"
