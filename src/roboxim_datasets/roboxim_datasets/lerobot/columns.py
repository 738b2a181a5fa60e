"""Columns of a LeRobot dataset's data files as arrays, checked before they are believed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboxim_datasets.episode import Floats
from roboxim_datasets.files import reading
from roboxim_datasets.lerobot.parquet_file import open_parquet
from roboxim_datasets.lerobot.tables import damaged

if TYPE_CHECKING:
    import pyarrow as pa


def floats(table: pa.Table, key: str, size: int, where: str) -> Floats:
    """Return a column of numbers or of (nested) lists of numbers as float32, shape (T, size).

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the step, when a row is empty or of another size.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    values = table.column(key).combine_chunks()
    count = len(values)
    if values.null_count:
        step = int(np.flatnonzero(np.asarray(values.is_null()))[0])
        raise damaged(f"{where}: '{key}' is empty (null) at step {step}")
    if _is_list(values.type):
        while _is_list(values.type):
            sizes = np.asarray(pc.list_value_length(values).to_numpy(zero_copy_only=False), np.float64)
            wrong: Any = np.flatnonzero(sizes != sizes[0]) if len(sizes) else []
            if len(wrong) or not len(sizes) or np.isnan(sizes[0]):
                step = int(wrong[0]) * count // max(len(sizes), 1) if len(wrong) else 0
                raise damaged(f"{where}: '{key}' has another number of values at step {step} than before")
            values = values.flatten()
    if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type) or pa.types.is_boolean(values.type)):
        raise damaged(f"{where}: '{key}' holds {values.type}, expected numbers")
    if len(values) != count * size:
        raise damaged(
            f"{where}: '{key}' holds {len(values)} numbers in {count} steps; meta/info.json says {size} a step"
        )
    with np.errstate(over="ignore"):  # an infinity is found where numbers are checked
        flat = np.asarray(values.to_numpy(zero_copy_only=False), np.float32)
    return flat.reshape(count, size)


def cells(table: pa.Table, key: str, step: int, where: str) -> Mapping[str, Any]:
    """Return an image of a column as it is stored: its bytes, or a path.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when there is none.
    """
    cell = table.column(key)[step].as_py()
    if isinstance(cell, bytes):
        return {"bytes": cell}
    if not isinstance(cell, dict) or not (cell.get("bytes") or cell.get("path")):
        raise damaged(f"{where}: '{key}' has no image at step {step}")
    return cell


def peek(folder: Path, name: str) -> dict[str, Any]:
    """Return the columns of a data file, each with its first value; that of a column of lists is None.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the file.
    """
    import pyarrow as pa

    with reading(folder / name):
        file = open_parquet(folder, name)
        found: dict[str, Any] = {}
        for column in file.schema_arrow:
            found[column.name] = None
            if pa.types.is_struct(column.type) and file.metadata.num_rows:
                batch = next(file.iter_batches(batch_size=1, columns=[column.name]), None)
                found[column.name] = batch.column(0)[0].as_py() if batch is not None and len(batch) else None
        return found


def _is_list(kind: pa.DataType) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))
