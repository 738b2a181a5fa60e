"""Datasets that unpack to far more than they weigh are refused before memory is taken."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import zlib
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, hdf5, lerobot30, rlds
from PIL import Image

from roboxim_core.errors import RoboximError
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import parquet_file
from roboxim_datasets.rewrite import plan_of, write_dataset
from roboxim_datasets.rlds.tfrecord import decode_example, encode_example, read_records, write_record
from roboxim_datasets.video.client import VideoWriters

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


def jpeg(width: int, height: int) -> bytes:
    """A small picture whose head claims another size."""
    out = io.BytesIO()
    Image.new("RGB", (SIDE, SIDE)).save(out, "JPEG")
    data = bytearray(out.getvalue())
    at = data.index(b"\xff\xc0") + 5  # height and width in the start of the frame
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize(
    "picture", [jpeg(65_500, 65_500), jpeg(8192, 8193), png(2048, 2048)], ids=["4 G", "67 M", "png"]
)
def test_pictures_of_rlds_are_held_against_their_description(picture: bytes, tmp_path: Path) -> None:
    path = rlds(tmp_path / "bomb" / "1.0.0", ids=(0, 1))
    file = next(path.glob("*tfrecord*"))
    records = [decode_example(record) for record in read_records(file)]
    with file.open("wb") as handle:
        for record in records:
            write_record(handle, encode_example({**record, "steps/observation/image": [picture] * STEPS}))
    tracemalloc.start()
    with pytest.raises(RoboximError, match=r"claims more than|claims 8192 x 8193|shape"):
        read_all(path)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


def test_a_record_of_rlds_that_claims_more_steps_than_it_has_is_refused(tmp_path: Path) -> None:
    path = rlds(tmp_path / "bomb" / "1.0.0", ids=(0,))
    file = next(path.glob("*tfrecord*"))
    (record,) = [decode_example(one) for one in read_records(file)]
    with file.open("wb") as handle:
        write_record(handle, encode_example({**record, "steps/reward": np.zeros(2**22, np.float32)}))
    with pytest.raises(RoboximError, match="reward|steps"):
        read_all(path)


@pytest.mark.slow
def test_a_video_of_more_pixels_than_its_description_says_is_refused(tmp_path: Path) -> None:
    path = lerobot30(tmp_path / "a")
    made = write_dataset(plan_of(open_dataset(path)), tmp_path / "b", "lerobot", how="convert").path
    info = json.loads((made / "meta/info.json").read_text())
    (key,) = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
    video = next(made.glob("**/*.mp4"))
    with VideoWriters(1) as writers:
        written = writers.open(video.with_suffix(".new.mp4"), codec="h264", rate=Fraction(10), height=128, width=128)
        for _ in range(ROWS):
            written.add(np.zeros((128, 128, 3), np.uint8))
        written.close().result()
    video.with_suffix(".new.mp4").replace(video)
    assert key
    with pytest.raises(RoboximError, match="128"):
        read_all(made)
