"""The numbers of one episode on their way into a dataset: an Arrow file with the episode's facts in its metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.lerobot.layout import LeRobotLayout, image_type

if TYPE_CHECKING:
    import pyarrow as pa

Array = npt.NDArray[Any]
SAMPLE = "sample:"
"""Prefix of columns that hold sampled pixels of depth or segmentation; they only serve statistics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """One episode of T steps, without videos."""

    table: pa.Table
    """Columns of the data files, without those that depend on the other episodes, and those of `SAMPLE`."""
    facts: dict[str, Any]
    """Facts of the episode: ``episode`` (what `ROBOXIM_EPISODES_FILE` says), ``histograms`` (column of a camera to the
    levels of its sampled pixels), ``images`` (number of images)."""

    def __len__(self) -> int:
        """Count the steps."""
        return int(self.table.num_rows)

    def write(self, path: Path) -> None:
        """Write the piece; it appears under its name when it is whole.

        Raises:
            OSError: When the disk is full.
        """
        import pyarrow as pa

        table = self.table.replace_schema_metadata({"facts": json.dumps(self.facts)})
        scratch = path.with_suffix(".tmp")
        with pa.OSFile(str(scratch), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)
        scratch.replace(path)

    @staticmethod
    def read(path: Path) -> Piece:
        """Read a piece."""
        import pyarrow as pa

        with pa.OSFile(str(path), "rb") as file:
            table = pa.ipc.open_file(file).read_all()
        return Piece(table=table, facts=json.loads(table.schema.metadata[b"facts"]))

    def column(self, name: str) -> Array:
        """Return a column of numbers, shape (T, size)."""
        return column_array(self.table.column(name)).reshape(len(self), -1)


def column_array(column: pa.ChunkedArray) -> Array:
    """Return a column of numbers or of lists of numbers of equal length, shape (T,) or (T, size)."""
    import pyarrow as pa

    flat = column.combine_chunks()
    if pa.types.is_list(flat.type) or pa.types.is_large_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        values = np.asarray(flat.flatten().to_numpy(zero_copy_only=False))
        return values.reshape(len(flat), -1)
    return np.asarray(flat.to_numpy(zero_copy_only=False))


def numbers_table(layout: LeRobotLayout, rows: Mapping[str, Array]) -> pa.Table:
    """Return the columns of numbers of an episode.

    Args:
        layout: Layout of the dataset.
        rows: Column to its values, shape (T, size) or (T,).

    Raises:
        InvalidRequestError: When a column is missing, unknown, of another shape, or not finite.
    """
    import pyarrow as pa

    if set(rows) != set(layout.columns):
        raise InvalidRequestError(f"an episode needs the columns {sorted(layout.columns)}, got {sorted(rows)}")
    count = {len(values) for values in rows.values()}
    columns = {}
    for key, column in layout.columns.items():
        values = np.asarray(rows[key], column.dtype).reshape(len(rows[key]), -1)
        if len(count) != 1 or values.shape[1] != column.size or not len(values) or not np.isfinite(values).all():
            raise InvalidRequestError(
                f"column '{key}' must hold at least one row of {column.size} finite numbers, as many as the other "
                f"columns; got shape {values.shape}"
            )
        columns[key] = _arrow(values, column.arrow)
    return pa.table(columns)


def _arrow(values: Array, kind: pa.DataType) -> pa.Array:
    import pyarrow as pa

    flat = np.ascontiguousarray(values).reshape(-1)
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(pa.array(flat, kind.value_type), type=kind)
    return pa.array(flat, kind)


def image_column(images: list[bytes]) -> pa.Array:
    """Return a column of encoded images."""
    import pyarrow as pa

    return pa.array(
        [{"bytes": image, "path": f"frame-{index:06d}.png"} for index, image in enumerate(images)], image_type()
    )


def sample_column(samples: list[Array]) -> pa.Array:
    """Return a column of sampled pixels, one row for each image."""
    import pyarrow as pa

    values = np.stack([np.asarray(sample, np.float32).reshape(-1) for sample in samples])
    return _arrow(values, pa.list_(pa.float32(), values.shape[1]))


def index_arrays(count: int, *, fps: int, episode: int, first: int, task: Array) -> dict[str, Array]:
    """Return the values of `INDEX_COLUMNS` for an episode.

    Args:
        count: Number of its steps.
        fps: Steps per second.
        episode: Number of the episode.
        first: Number of its first step in the dataset.
        task: Number of each step's instruction.
    """
    steps = np.arange(count)
    return {
        "timestamp": (steps / fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(count, episode),
        "index": first + steps,
        "task_index": task,
    }


def complete_table(layout: LeRobotLayout, piece: Piece, indices: Mapping[str, Array]) -> pa.Table:
    """Return the rows of the data files for a piece."""
    import pyarrow as pa

    schema = layout.schema()
    own = {key: _arrow(values, layout.index_columns[key].arrow) for key, values in indices.items()}
    arrays = [own[name] if name in own else piece.table.column(name).combine_chunks() for name in schema.names]
    return pa.Table.from_arrays(arrays, schema=schema)
