"""Datasets that unpack to far more than they weigh are refused before memory is taken."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, hdf5, lerobot30

from roboxim_core.errors import RoboximError
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import parquet_file

DATA = "data/chunk-000/file-000.parquet"
ROWS = EPISODES * STEPS


def replaced(file: Path, column: str, values: pa.Array) -> None:
    table = pq.read_table(file)
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, column, values), file, compression="zstd")


def read_all(path: Path) -> int:
    return sum(1 for episode in open_dataset(path).episodes() for _ in episode.steps())


def long_task(folder: Path) -> Path:
    pq.write_table(
        pa.table({"task_index": [0], "task": ["a" * 2**24]}), folder / "meta/tasks.parquet", compression="zstd"
    )
    return folder


def long_rows(folder: Path) -> Path:
    each = 2**18
    starts = pa.array(np.arange(ROWS + 1) * each, pa.int32())
    values = pa.ListArray.from_arrays(starts, pa.array(np.zeros(ROWS * each, "f4")))
    replaced(folder / DATA, "observation.state", values)
    return folder


def many_episodes(folder: Path) -> Path:
    file = folder / "meta/episodes/chunk-000/file-000.parquet"
    names = [name for name in pq.read_schema(file).names if name != "tasks"]
    pq.write_table(pa.table({name: np.zeros(2**20, np.int64) for name in names}), file, compression="zstd")
    return folder


@pytest.mark.parametrize("bomb", [long_task, long_rows, many_episodes])
def test_parquet_that_unpacks_to_far_more_is_refused(bomb, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(parquet_file, "FREE_BYTES", 2**22)
    path = bomb(lerobot30(tmp_path / "bomb"))
    tracemalloc.start()
    with pytest.raises(RoboximError, match=r"parquet has \d+ bytes and unpacks to \d+; at most 1100 times"):
        read_all(path)
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, text: int = 0) -> bytes:
    """A picture of zeros, with a compressed text."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    texts = chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(text), 9)) if text else b""
    rows = zlib.compress(bytes((1 + 3 * width) * height), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + texts + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("picture", "problem"),
    [
        (png(2048, 2048), "has the shape"),
        (png(SIDE, SIDE, 2**27), "that are no picture"),
        (png(2, 2).replace(struct.pack(">II", 2, 2), struct.pack(">II", 100_000, 100_000)), "picture"),
    ],
    ids=["larger than declared", "a text", "claimed"],
)
def test_pictures_that_unpack_to_far_more_are_refused(picture: bytes, problem: str, tmp_path: Path) -> None:
    path = lerobot30(tmp_path / "bomb")
    cells = pa.array(
        [{"bytes": picture, "path": None}] * ROWS, pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    )
    replaced(path / DATA, CAMERA, cells)
    with pytest.raises(RoboximError, match=problem):
        read_all(path)


def with_actions(path: Path, **settings) -> Path:
    file = next(path.glob("**/*.hdf5"))
    with h5py.File(file, "a") as handle:
        demo = handle["data/demo_0"]
        del demo["actions"]
        actions = demo.create_dataset("actions", **settings)
        if settings["dtype"] == "f4":
            actions[: settings["chunks"][0]] = 0
    return path


@pytest.mark.parametrize(
    "settings",
    [
        {"shape": (10**9, 7), "dtype": "f4", "chunks": (10**5, 7), "compression": "gzip", "compression_opts": 9},
        {"shape": (12,), "dtype": h5py.vlen_dtype(np.float32)},
        {"shape": (12,), "dtype": h5py.ref_dtype},
        {"shape": (12,), "dtype": h5py.string_dtype()},
    ],
    ids=["a filter", "lists", "references", "texts"],
)
def test_hdf5_bombs_and_objects_are_named_and_the_rest_is_read(settings, tmp_path: Path) -> None:
    dataset = open_dataset(with_actions(hdf5(tmp_path / "bomb"), **settings))
    assert [part.name for part in dataset.account.left_out if part.kind == "episode"] == ["demo_0"]
    assert len(list(dataset.episodes())) > 0
