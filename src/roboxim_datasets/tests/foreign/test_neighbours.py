"""Inputs near those that broke a reader once: other types, sizes, names, texts and links."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, hdf5, lerobot30, png, rlds
from PIL import Image

from roboxim_core.errors import RoboximError
from roboxim_datasets.audit import AuditEpisode, Auditor
from roboxim_datasets.episode import ImageSize
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.pictures import colour_picture, head_of
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.tfrecord import decode_example, encode_example, read_records, write_record

DATA = "data/chunk-000/file-000.parquet"


def changed(folder: Path, key: str, values: Any) -> Path:
    """Return a file of which every episode has an array."""
    hdf5(folder)
    with h5py.File(folder / "data.hdf5", "r+") as file:
        for demo in file["data"].values():
            if key in demo:
                del demo[key]
            demo[key] = values
    return folder


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("actions", np.ones((STEPS, 7), "f2")),
        ("actions", np.ones((STEPS, 7), "?")),
        ("obs/complex", np.ones((STEPS, 2), "c8")),
        ("obs/order", np.arange(2 * STEPS, dtype=">f4").reshape(STEPS, 2)),
        ("obs/名前 é", np.ones((STEPS, 2))),
        ("obs/table", np.zeros(STEPS, [("a", "f4"), ("b", "i4")])),
        ("obs/first_image", np.zeros((STEPS, 3, 8, 8), "u1")),
        ("obs/alpha_image", np.zeros((STEPS, 8, 8, 4), "u1")),
        ("obs/agentview_depth", np.ones((STEPS, 8, 8, 1), "f4")),
        ("rewards", np.ones((STEPS, 2))),
    ],
)
def test_other_types_are_read_or_named(tmp_path: Path, key: str, values: Any) -> None:
    dataset = open_dataset(changed(tmp_path / "a", key, values))
    held = sum(part.count for part in dataset.account.parts if part.name == key)
    assert held == EPISODES * STEPS
    written = write_dataset(plan_of(dataset), tmp_path / "b", "rlds", how="convert")
    assert open_dataset(written.path).splits == dataset.splits


def test_cameras_of_several_sizes_are_audited(tmp_path: Path) -> None:
    dataset = open_dataset(changed(tmp_path / "a", "obs/dot_image", np.zeros((STEPS, 1, 1, 3), "u1")))
    auditor = Auditor(("duplicate",))
    for number, episode in enumerate(dataset.episodes()):
        auditor.add(AuditEpisode(name=str(number), split="", episode=episode))
    assert not auditor.result().unreadable


def test_a_picture_of_rlds_has_the_described_size(tmp_path: Path) -> None:
    dataset = open_dataset(rlds(tmp_path / "a", side=16))
    with pytest.raises(RoboximError, match=r"train\[0\], step 0, image 'image': a picture has the size 8 x 8"):
        list(dataset.episode(0).steps())


def test_a_picture_is_as_large_as_its_bytes_can_hold() -> None:
    plain = io.BytesIO()
    Image.new("RGB", (4096, 4096)).save(plain, "WEBP", lossless=True)
    with pytest.raises(RoboximError, match=f"claims 4096 x 4096 pixels, which its {plain.tell()} bytes cannot hold"):
        head_of(plain.getvalue())
    plain = io.BytesIO()
    Image.new("RGB", (4096, 4096)).save(plain, "PNG")
    assert head_of(plain.getvalue()).size == ImageSize(height=4096, width=4096)


def test_a_picture_is_not_turned_by_what_its_camera_notes() -> None:
    turned, out = Image.Exif(), io.BytesIO()
    turned[0x112] = 6  # by 90 degrees
    Image.new("RGB", (12, 8)).save(out, "JPEG", exif=turned)
    assert colour_picture(out.getvalue(), ImageSize(height=8, width=12)).shape == (8, 12, 3)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["?", "f4", "u1"])
@pytest.mark.parametrize("target", ["hdf5", "rlds", "lerobot"])
def test_success_of_each_step_is_that_of_the_last_one(tmp_path: Path, kind: str, target: str) -> None:
    folder = hdf5(tmp_path / "a")  # whose rewards say that every episode succeeded
    with h5py.File(folder / "data.hdf5", "r+") as file:
        for number, demo in enumerate(file["data"].values()):
            demo["success"] = np.array([0, 1, 0, number % 2], kind)
    written = write_dataset(plan_of(open_dataset(folder)), tmp_path / "b", target, how="convert")
    assert [episode.success for episode in open_dataset(written.path).episodes()] == [False, True, False]


def recorded(folder: Path, key: str, values: Any, **described: Any) -> Path:
    """Return an RLDS dataset of whose episodes a feature is another one."""
    [shard] = folder.glob("*.tfrecord*")
    examples = [decode_example(record) for record in read_records(shard)]
    with shard.open("wb") as file:
        for number, example in enumerate(examples):
            write_record(file, encode_example(example | {key: values(number)}))
    features = json.loads((folder / "features.json").read_text())
    features["featuresDict"]["features"]["episode_metadata"]["featuresDict"]["features"].update(described)
    (folder / "features.json").write_text(json.dumps(features))
    return folder


def test_success_of_rlds_in_words_stays_unknown(tmp_path: Path) -> None:
    said = [[b"perhaps"], [b"false"], [b"true"]]
    folder = recorded(rlds(tmp_path / "a"), "episode_metadata/success", said.__getitem__, success={"text": {}})
    written = write_dataset(plan_of(open_dataset(folder)), tmp_path / "b", "rlds", how="convert")
    assert [episode.success for episode in open_dataset(written.path).episodes()] == [None, False, True]


def test_flags_of_rlds_that_are_not_in_order_are_named(tmp_path: Path) -> None:
    folder = recorded(rlds(tmp_path / "a"), "steps/is_first", lambda _: np.array([1, 0, 1, 0]))
    named = {part.name: part.why for part in open_dataset(folder).account.left_out}
    assert named["steps/is_first"] == "it is not true at the first step alone"


def test_an_instruction_that_is_no_utf8_is_noted(tmp_path: Path) -> None:
    folder = recorded(rlds(tmp_path / "a"), "steps/language_instruction", lambda _: [b"caf\xe9"] * STEPS)
    noted = {part.name: part.why for part in open_dataset(folder).account.changed}
    assert noted["steps/language_instruction"] == "bytes that are no UTF-8, read as \ufffd"


@pytest.mark.parametrize("target", ["hdf5", "rlds", "lerobot"])
def test_success_that_says_neither_yes_nor_no_stays_unknown(tmp_path: Path, target: str) -> None:
    folder = hdf5(tmp_path / "a")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        for demo, said in zip(file["data"].values(), ("True", "False", "perhaps"), strict=True):
            demo.attrs["success"] = said
    written = write_dataset(plan_of(open_dataset(folder)), tmp_path / "b", target, how="convert")
    assert [episode.success for episode in open_dataset(written.path).episodes()] == [True, False, None]


def test_a_number_of_samples_that_is_not_that_of_the_actions_is_named(tmp_path: Path) -> None:
    folder = hdf5(tmp_path / "a")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        file["data/demo_1"].attrs["num_samples"] = 99
    named = {(part.name, part.count): part.why for part in open_dataset(folder).account.left_out}
    assert named["demo.attrs[num_samples]", 1] == f"it says 99, there are {STEPS} actions"


def column(folder: Path, name: str, values: pa.Array, **feature: Any) -> Path:
    """Return a LeRobot dataset with another column."""
    table = pq.read_table(folder / DATA)
    kept = table.drop_columns([name] if name in table.column_names else [])
    pq.write_table(kept.append_column(name, values), folder / DATA)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][name].update(feature)
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def test_times_that_are_not_those_of_their_frames_are_named(tmp_path: Path) -> None:
    times = pa.array(np.tile([0.0, 0.1, 0.25, 0.3], EPISODES), pa.float32())
    [part] = open_dataset(column(lerobot30(tmp_path / "a"), "timestamp", times)).account.left_out
    assert (part.name, part.count) == ("timestamp", EPISODES)
    assert part.why == "not frame_index / 10 Hz, by up to 0.05 s; a new dataset has even times"


def test_what_a_vector_and_a_colour_picture_do_not_hold_is_noted(tmp_path: Path) -> None:
    folder, rows = lerobot30(tmp_path / "a"), EPISODES * STEPS
    column(folder, "action", pa.array(np.ones((rows, 2, 7), "f4").tolist()), shape=[2, 7])
    cells = [{"bytes": png(np.full((SIDE, SIDE, 4), 200, np.uint8)), "path": None}] * rows
    column(folder, CAMERA, pa.array(cells, pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
    noted = {part.name: part.why for part in open_dataset(folder).account.changed}
    assert noted == {
        "action": "float32 of shape (2, 7), read as a vector of float32",
        CAMERA: "pictures with an alpha channel, read without it",
    }


def test_a_task_of_two_texts_is_refused_and_one_of_none_is_empty(tmp_path: Path) -> None:
    folder = lerobot30(tmp_path / "a")
    tasks = folder / "meta/tasks.parquet"
    pq.write_table(pa.table({"task_index": [0, 0], "task": ["reach", "grasp"]}), tasks)
    with pytest.raises(RoboximError, match="tasks.parquet: task_index 0 is 'reach' and 'grasp', expected one text"):
        open_dataset(folder)
    pq.write_table(pa.table({"task_index": [0], "task": pa.array([None], pa.string())}), tasks)
    assert open_dataset(folder).episode(0).instruction == ""


def test_a_rate_that_is_no_number_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(RoboximError, match="info.json: fps is None, expected steps per second above 0"):
        open_dataset(lerobot30(tmp_path / "a", fps=None))


def test_a_text_that_hdf5_cannot_hold_is_refused_by_name(tmp_path: Path) -> None:
    folder = hdf5(tmp_path / "a")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        file["data/demo_1"].attrs["ep_meta"] = json.dumps({"lang": "pick \0 up"})
    with pytest.raises(RoboximError, match="demo_1.*NUL"):
        write_dataset(plan_of(open_dataset(folder)), tmp_path / "b", "hdf5", how="convert")


@pytest.mark.parametrize("split", ["träin", "validation", "few shot"])
def test_splits_of_any_name_survive_hdf5(tmp_path: Path, split: str) -> None:
    source = open_dataset(lerobot30(tmp_path / "a", splits={"train": "0:1", split: "1:3"}))
    written = write_dataset(plan_of(source), tmp_path / "b", "hdf5", how="convert")
    assert dict(open_dataset(written.path).splits) == {"train": 1, split: 2}


def test_a_link_in_a_dataset_to_itself_is_no_second_dataset(tmp_path: Path) -> None:
    folder = lerobot30(tmp_path / "a")
    (folder / "again").symlink_to(folder)
    assert len(open_dataset(folder)) == EPISODES
