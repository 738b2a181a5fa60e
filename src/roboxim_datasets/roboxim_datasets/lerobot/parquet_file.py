"""Opens Parquet files that do not unpack to far more than they weigh.

Run lengths, dictionaries and zstd let a file of a kilobyte hold gigabytes of equal values. What a file holds once it is
unpacked stands in its footer, so it is judged before anything is unpacked.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_datasets.files import file_in

if TYPE_CHECKING:
    import pyarrow.parquet as pq

FREE_BYTES = 2**28
"""Unpacked size that is believed of any file [B]."""
MOST_TIMES = 1100
"""Beyond it, largest ratio of the unpacked size to the file's."""
_VALUE_BYTES = 8


def open_parquet(folder: Path, name: Path | str) -> pq.ParquetFile:
    """Open a Parquet file of a dataset.

    Args:
        folder: The dataset's folder.
        name: Path relative to it; an absolute one must lie in it.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it lies elsewhere or holds more than its size allows.
    """
    import pyarrow.parquet as pq

    place = file_in(folder, name)
    file, stored = pq.ParquetFile(place), place.stat().st_size
    unpacked = 0
    for group in range(file.num_row_groups):
        about = file.metadata.row_group(group)
        for column in range(about.num_columns):
            chunk = about.column(column)
            unpacked += max(chunk.total_uncompressed_size, _VALUE_BYTES * chunk.num_values)
    if unpacked > max(FREE_BYTES, MOST_TIMES * stored):
        raise RecorderError(
            f"{place} has {stored} bytes and unpacks to {unpacked}; at most {MOST_TIMES} times its size is read. Leave "
            "the file out, or take the dataset from its source again",
            ErrorCode.BAG_DAMAGED,
        )
    return file
