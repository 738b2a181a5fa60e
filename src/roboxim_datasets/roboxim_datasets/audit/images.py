"""Summaries of an episode's images, one pass: what the checks of cameras need, in a few kilobytes per episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_datasets.episode import Episode

CELLS = 32
"""Cells along each side of a summary."""

Values = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageTrack:
    """One camera's images of an episode."""

    cells: Values
    """Mean brightness of `CELLS` x `CELLS` cells, 0..255, shape (T, CELLS, CELLS)."""
    deviation: Values
    """Standard deviation of the brightness in each image, 0..255, shape (T,)."""

    @property
    def change(self) -> Values:
        """Largest change of a cell from image to image, 0..255, shape (T - 1,)."""
        return np.asarray(np.abs(np.diff(self.cells, axis=0)).max(axis=(1, 2)))

    @property
    def motion(self) -> Values:
        """Mean change of the cells from image to image, 0..255, shape (T - 1,)."""
        return np.asarray(np.abs(np.diff(self.cells, axis=0)).mean(axis=(1, 2)))


def image_tracks(episode: Episode) -> dict[str, ImageTrack]:
    """Read all images of an episode and summarise each camera's.

    Raises:
        RecorderError: When an image cannot be read.
    """
    cells: dict[str, list[Values]] = {camera: [] for camera in episode.cameras}
    deviation: dict[str, list[float]] = {camera: [] for camera in episode.cameras}
    for step in episode.steps() if episode.cameras else ():
        for camera, image in step.images.items():
            gray = image.mean(axis=2, dtype=np.float32)
            cells[camera].append(cells_of(gray))
            deviation[camera].append(float(gray.std()))
    return {
        camera: ImageTrack(cells=np.stack(cells[camera]), deviation=np.array(deviation[camera], np.float32))
        for camera in episode.cameras
    }


def cells_of(gray: Values) -> Values:
    """Return the mean of each cell; cells may differ by a row or a column."""
    rows, columns = (np.linspace(0, size, min(CELLS, size), endpoint=False).astype(int) for size in gray.shape)
    sums = np.add.reduceat(np.add.reduceat(gray, rows, axis=0), columns, axis=1)
    heights, widths = np.diff(np.r_[rows, gray.shape[0]]), np.diff(np.r_[columns, gray.shape[1]])
    return np.asarray(sums / np.outer(heights, widths), np.float32)
