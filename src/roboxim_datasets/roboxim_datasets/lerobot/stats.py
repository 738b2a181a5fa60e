"""Statistics as LeRobot stores them: by column, for an episode and for the whole dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from roboxim_datasets.lerobot.layout import LeRobotLayout
from roboxim_datasets.lerobot.pieces import SAMPLE, Array, Piece
from roboxim_datasets.statistics import ImageStatistics, Summary, VectorStatistics, summary_of

Stats = dict[str, dict[str, Any]]
"""Column to statistic to (nested) lists of numbers."""


def episode_stats(layout: LeRobotLayout, piece: Piece, indices: Mapping[str, Array]) -> Stats:
    """Return the statistics of an episode.

    Args:
        layout: Layout of the dataset.
        piece: The episode.
        indices: Its values of `LeRobotLayout.index_columns`.
    """
    found: Stats = {}
    for key in layout.cameras:
        images = ImageStatistics()
        images.merge(piece.facts["histograms"][key], piece.facts["images"])
        found[key] = _plain(images.summary(), images.count, image=True)
    for key in layout.depth:
        values = piece.column(SAMPLE + key)
        found[key] = _plain(summary_of(values.reshape(-1, 1)), len(values), image=True)
    for key in layout.columns:
        found[key] = _plain(summary_of(piece.column(key)), len(piece))
    for key, values in indices.items():
        found[key] = _plain(summary_of(values.reshape(-1, 1)), len(piece))
    return found


class DatasetStatistics:
    """Collects episodes and returns the exact statistics of the whole dataset."""

    def __init__(self, layout: LeRobotLayout) -> None:
        """Start without episodes."""
        self._layout = layout
        self._images = {key: ImageStatistics() for key in layout.cameras}
        self._depth = {key: VectorStatistics(1) for key in layout.depth}
        self._depth_images = 0
        columns = {**layout.columns, **layout.index_columns}
        self._columns = {
            key: VectorStatistics(column.size, "int64" if column.dtype in ("int64", "bool") else column.dtype)
            for key, column in columns.items()
        }

    def add(self, piece: Piece, indices: Mapping[str, Array]) -> None:
        """Add an episode; arguments as `episode_stats`."""
        for key, images in self._images.items():
            images.merge(piece.facts["histograms"][key], piece.facts["images"])
        for key, values in self._depth.items():
            values.add(piece.column(SAMPLE + key).reshape(-1, 1))
        self._depth_images += len(piece)
        for key, values in self._columns.items():
            values.add(indices[key].reshape(-1, 1) if key in indices else piece.column(key))

    def stats(self) -> Stats:
        """Return the statistics."""
        found = {key: _plain(images.summary(), images.count, image=True) for key, images in self._images.items()}
        for key, depth in self._depth.items():
            found[key] = _plain(depth.summary(), self._depth_images, image=True)
        for key, values in self._columns.items():
            found[key] = _plain(values.summary(), values.count)
        return found


def _plain(summary: Summary, count: int, *, image: bool = False) -> dict[str, Any]:
    shaped = {name: values.reshape(-1, 1, 1) if image else values for name, values in summary.items()}
    return {**{name: np.asarray(values).tolist() for name, values in shaped.items()}, "count": [count]}
