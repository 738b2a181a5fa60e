"""Inputs near those that broke a reader once: other types, sizes, names, texts and links."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from made_foreign import EPISODES, STEPS, hdf5, lerobot30, rlds
from PIL import Image

from roboxim_core.errors import RoboximError
from roboxim_datasets.audit import AuditEpisode, Auditor
from roboxim_datasets.episode import ImageSize
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.pictures import colour_picture, head_of
from roboxim_datasets.rewrite import plan_of, write_dataset


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
    with pytest.raises(RoboximError, match="step 0, image 'image': a picture has the size 8 x 8, expected 16 x 16"):
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
