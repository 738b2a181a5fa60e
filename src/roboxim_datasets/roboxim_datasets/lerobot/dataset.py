"""LeRobot as a registered format: finds, opens and writes datasets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roboxim_datasets.dataset import Dataset, Description
from roboxim_datasets.lerobot.content import LeRobotOptions, content_of, layout_of
from roboxim_datasets.lerobot.layout import DEPTH_UNIT_M, INFO_FILE, MAX_DEPTH
from roboxim_datasets.lerobot.reader import LeRobotDataset
from roboxim_datasets.lerobot.writer import LeRobotWriter
from roboxim_datasets.registry import FORMATS


@FORMATS.register("lerobot")
class LeRobotFormat:
    """LeRobot 3.0 and 2.1: lerobot (ACT, Diffusion, SmolVLA, pi0), openpi, GR00T."""

    options = LeRobotOptions
    rounds_depth = f"in units of {DEPTH_UNIT_M:g} m; 0 where it is beyond {MAX_DEPTH * DEPTH_UNIT_M:.2f} m or unknown"

    def find(self, path: Path) -> list[Path]:
        """Return the datasets that a path is, or that the folder holds up to two levels below."""
        patterns = (INFO_FILE, f"*/{INFO_FILE}", f"*/*/{INFO_FILE}")
        folders = sorted({file.parent.parent for pattern in patterns for file in path.glob(pattern)})
        return [at for at in folders if not any(part.startswith(".") for part in at.relative_to(path).parts)]

    def open(self, path: Path) -> Dataset:
        """Open a dataset."""
        return LeRobotDataset(path)

    def open_with_depth(self, path: Path, unit_m: float) -> Dataset:
        """Open a dataset of others whose depth images have a stated unit [m]."""
        return LeRobotDataset(path, depth_unit_m=unit_m)

    def path(self, target: Path, options: LeRobotOptions) -> Path:
        """Return the target: the dataset is this folder."""
        return target

    @contextmanager
    def create(
        self, target: Path, description: Description, options: LeRobotOptions, *, identity: str, overwrite: bool
    ) -> Iterator[LeRobotWriter]:
        """Start a dataset, or continue an interrupted one."""
        content = content_of(description, options)
        layout = layout_of(description, content, options)
        with LeRobotWriter(target, layout, content, identity=identity, overwrite=overwrite) as writer:
            yield writer
