"""Datasets that unpack to far more than they weigh are refused before memory is taken."""

from __future__ import annotations

import io
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, hdf5, lerobot30, rlds
from PIL import Image
from traced_memory import peak_below

from roboxim_core.errors import RoboximError
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import parquet_file
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.tfrecord import decode_example, encode_example, read_records, write_record

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
    refused = pytest.raises(RoboximError, match=r"parquet has \d+ bytes and unpacks to \d+; at most 1100 times")
    with peak_below(2**22), refused:
        read_all(path)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, text: int = 0) -> bytes:
    """A picture of zeros, with a compressed text."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    texts = chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(text), 9)) if text else b""
    rows = zlib.compress(bytes((1 + 3 * width) * height), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + texts + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """A small picture whose head claims another size."""
    out = io.BytesIO()
    Image.new("RGB", (SIDE, SIDE)).save(out, "JPEG")
    data = bytearray(out.getvalue())
    at = data.index(b"\xff\xc0") + 5  # height and width in the start of the frame
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def bmp(width: int, height: int) -> bytes:
    """A file of one pixel whose head claims more."""
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 58, 0, 0, 54) + head + bytes(4)


@pytest.mark.parametrize(
    ("picture", "problem"),
    [
        (png(2048, 2048), "a picture has the size 2048 x 2048, expected 8 x 8"),
        (png(SIDE, SIDE, 2**27), "that are no picture"),
        (png(2, 2).replace(struct.pack(">II", 2, 2), struct.pack(">II", 100_000, 100_000)), "picture"),
        (jpeg(65_500, 65_500), "claims more than"),
        (bmp(8192, 8192), "claims 8192 x 8192 pixels, which its 58 bytes cannot hold"),
    ],
    ids=["larger than declared", "a text", "claimed", "claimed by a JPEG", "claimed by a BMP"],
)
def test_pictures_that_unpack_to_far_more_are_refused(picture: bytes, problem: str, tmp_path: Path) -> None:
    path = lerobot30(tmp_path / "bomb")
    cells = pa.array(
        [{"bytes": picture, "path": None}] * ROWS, pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    )
    replaced(path / DATA, CAMERA, cells)
    with peak_below(2**26), pytest.raises(RoboximError, match=problem):
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
    refused = pytest.raises(
        RoboximError, match=r"claims (more than|8192 x 8193)|has the size 2048 x 2048, expected 8 x 8"
    )
    with peak_below(2**26), refused:
        read_all(path)


def test_a_record_of_rlds_that_claims_more_steps_than_it_has_is_refused(tmp_path: Path) -> None:
    path = rlds(tmp_path / "bomb" / "1.0.0", ids=(0,))
    file = next(path.glob("*tfrecord*"))
    (record,) = [decode_example(one) for one in read_records(file)]
    with file.open("wb") as handle:
        write_record(handle, encode_example({**record, "steps/reward": np.zeros(2**22, np.float32)}))
    with pytest.raises(RoboximError, match="reward|steps"):
        read_all(path)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("filmed")
    return write_dataset(plan_of(open_dataset(lerobot30(folder / "a"))), folder / "b", "lerobot", how="convert").path


def video(path: Path, codec: str = "libx264", side: int = SIDE) -> bytes:
    """A video of a colour."""
    import av

    from roboxim_datasets.video.worker import give_up_priority

    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream(codec, rate=10)
        stream.width = stream.height = side
        stream.pix_fmt = "yuv420p"
        for _ in range(ROWS):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((side, side, 3), np.uint8), format="rgb24")))
        file.mux(stream.encode(None))
    give_up_priority()
    return path.read_bytes()


def many_frames(folder: Path) -> bytes:
    """A video whose table has ten million frames of equal sizes, without an entry for each."""
    data, count = bytearray(video(folder / "v.mp4")), struct.pack(">I", 10**7)
    for kind, at, new in ((b"stsz", 8, struct.pack(">I", 10) + count), (b"stts", 12, count), (b"stsc", 16, count)):
        start = data.index(kind) + at
        data[start : start + len(new)] = new
    return bytes(data)


def another_file(folder: Path) -> bytes:
    """A list that FFmpeg's concat format reads as the video of another file."""
    return b"ffconcat version 1.0\nfile other.mp4\n"


def large_av1(folder: Path) -> bytes:
    """AV1 whose sequence header claims 65536 x 65536 pixels. Source: AV1 specification, 5.5 (sequence header OBU)."""
    import av

    def claimed(body: bytes) -> bytes:
        bits, at = "".join(f"{byte:08b}" for byte in body), 7  # profile, still, reduced, timing, delay
        at += 5 + 12 + 5 + (int(bits[at + 17 : at + 22], 2) > 7)  # of one operating point
        sizes = 2 + int(bits[at : at + 4], 2) + int(bits[at + 4 : at + 8], 2)
        bits = bits[:at] + "1" * 40 + bits[at + 8 + sizes :].rstrip("0")
        bits += "0" * (-len(bits) % 8)
        return bytes(int(bits[k : k + 8], 2) for k in range(0, len(bits), 8))

    def changed(data: bytes) -> bytes:
        parts = b""
        while data:
            size, head = data[1], data[:1]
            assert size < 128, "a longer one has a longer size"
            body, data = data[2 : 2 + size], data[2 + size :]
            body = claimed(body) if head[0] >> 3 == 1 else body
            parts += head + bytes([len(body)]) + body
        return parts

    video(folder / "small.mp4", "libsvtav1", 64)
    with av.open(str(folder / "small.mp4")) as small, av.open(str(folder / "v.mp4"), "w", format="mp4") as large:
        (source,) = small.streams.video
        target = large.add_stream_from_template(source, opaque=True)
        extra = source.codec_context.extradata
        target.codec_context.extradata = extra[:4] + changed(extra[4:])
        for packet in small.demux(source):
            if packet.dts is not None:
                new = av.Packet(changed(bytes(packet)))
                new.pts, new.dts, new.time_base, new.stream = packet.pts, packet.dts, packet.time_base, target
                large.mux(new)
    return (folder / "v.mp4").read_bytes()


@pytest.mark.parametrize(
    ("made", "problem"),
    [
        (lambda folder: video(folder / "v.mp4", side=128), "frames of 128 x 128 pixels, expected 8 x 8"),
        (many_frames, "10000000 frames of 10 bytes are declared, the file has "),
        (large_av1, "frames of more than 18496 pixels, expected 8 x 8"),
        (another_file, "Invalid data"),
    ],
)
def test_videos_that_claim_more_than_they_are_or_name_other_files_are_refused(
    made: Callable[[Path], bytes], problem: str, filmed: Path, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(filmed, tmp_path / "bomb"))
    file = next(path.glob("**/*.mp4"))
    shutil.copy(file, file.with_name("other.mp4"))
    data = made(tmp_path)
    file.write_bytes(data)
    with pytest.raises(RoboximError, match=problem) as caught:
        read_all(path)
    assert file.name in str(caught.value)


def test_the_size_that_a_video_s_container_claims_alone_does_not_matter(filmed: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(filmed, tmp_path / "a"))
    file = next(path.glob("**/*.mp4"))
    data = bytearray(file.read_bytes())
    at = data.index(b"avc1", data.index(b"stsd")) + 28
    assert data[at : at + 4] == struct.pack(">HH", SIDE, SIDE)
    data[at : at + 4] = struct.pack(">HH", 65535, 65535)
    file.write_bytes(data)
    assert read_all(path) == ROWS


FLIPS = """
import sys
from pathlib import Path
from roboxim_core.errors import RoboximError
from roboxim_datasets.files import reading
from roboxim_datasets.lerobot.parquet_file import open_parquet

file = Path(sys.argv[1])
whole = file.read_bytes()
start = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
for at in range(start, len(whole), 3):
    file.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
    try:
        with reading("it"):
            open_parquet(file.parent, file.name)
    except RoboximError:
        pass
"""
"""Opens a Parquet file with one bit changed, each third byte of its footer in turn."""


@pytest.mark.thorough
def test_no_bit_of_a_parquet_footer_ends_the_process(tmp_path: Path) -> None:
    """pyarrow 26.0.1 aborts at some of them when it is asked for the sizes of columns."""
    file = lerobot30(tmp_path / "a") / DATA
    done = subprocess.run([sys.executable, "-c", FLIPS, str(file)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_sizes_that_a_parquet_footer_states_are_those_that_pyarrow_reads(tmp_path: Path) -> None:
    for file in lerobot30(tmp_path / "a").rglob("*.parquet"):
        groups = [pq.read_metadata(file).row_group(k) for k in range(pq.read_metadata(file).num_row_groups)]
        chunks = [group.column(k) for group in groups for k in range(group.num_columns)]
        expected = sum(max(chunk.total_uncompressed_size, 8 * chunk.num_values) for chunk in chunks)
        assert parquet_file._unpacked_bytes(file) == expected
