"""HDF5 as a registered format: finds, opens and writes datasets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roboxim_datasets.dataset import Dataset, Description
from roboxim_datasets.hdf5.layout import Hdf5Options
from roboxim_datasets.hdf5.reader import Hdf5Dataset
from roboxim_datasets.hdf5.writer import Hdf5Writer
from roboxim_datasets.registry import FORMATS

_SUFFIXES = (".hdf5", ".h5")


@FORMATS.register("hdf5")
class Hdf5Format:
    """HDF5 in robomimic's layout: robomimic, LIBERO, diffusion_policy."""

    options = Hdf5Options

    def find(self, path: Path) -> list[Path]:
        """Return the datasets that a path is, or that the folder holds up to two levels below."""
        if path.is_file():
            return [path] if path.suffix in _SUFFIXES else []
        files = sorted(f for pattern in ("*", "*/*", "*/*/*") for f in path.glob(pattern) if f.suffix in _SUFFIXES)
        found = [f for f in files if not any(part.startswith(".") for part in f.relative_to(path).parts)]
        single = [f for f in found if sum(other.parent == f.parent for other in found) == 1]
        return sorted(f.parent if f in single else f for f in found)

    def open(self, path: Path) -> Dataset:
        """Open a dataset."""
        return Hdf5Dataset(path)

    def open_with_depth(self, path: Path, unit_m: float) -> Dataset:
        """Open a dataset of others whose depth images have a stated unit [m]."""
        return Hdf5Dataset(path, depth_unit_m=unit_m)

    def path(self, target: Path, options: Hdf5Options) -> Path:
        """Return the target: the dataset is this folder."""
        return target

    @contextmanager
    def create(
        self, target: Path, description: Description, options: Hdf5Options, *, identity: str, overwrite: bool
    ) -> Iterator[Hdf5Writer]:
        """Start a dataset, or continue an interrupted one."""
        yield Hdf5Writer(target, description, options, identity=identity, overwrite=overwrite)
