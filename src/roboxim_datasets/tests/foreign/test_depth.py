"""Depth of others: with a stated unit it becomes metres in every format that holds depth, without one it is named."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, lerobot30, png
from PIL import Image

from roboxim_core.errors import InvalidRequestError, RecorderError
from roboxim_datasets.compare import compare
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.depth import camera_of
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset

DATA = "data/chunk-000/file-000.parquet"
TOP = "observation.images.top_depth"
UNIT_M = 0.001
FAST = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def millimetres(step: int, side: int = SIDE) -> np.ndarray:
    """Return a depth image of a step."""
    return (np.arange(side * side).reshape(side, side) + 500 + step).astype(np.uint16)


def with_depth(folder: Path, key: str = TOP, side: int = SIDE, *, channels: int = 1) -> Path:
    """Write a LeRobot dataset with 16-bit depth beside its camera."""
    lerobot30(folder)
    table = pq.read_table(folder / DATA)
    cells = [{"bytes": png(millimetres(row % STEPS, side)), "path": None} for row in range(table.num_rows)]
    column = pa.array(cells, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    pq.write_table(table.append_column(key, column), folder / DATA)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][key] = {"dtype": "image", "shape": [side, side, channels], "names": None}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def converted(source: Dataset, target: Path, format: str, options: object = None) -> Dataset:
    return open_dataset(write_dataset(plan_of(source), target, format, options, how="convert").path)


def depths(dataset: Dataset, camera: str = "top") -> np.ndarray:
    return np.stack([step.depth[camera] for step in dataset.episode(EPISODES - 1).steps((), depth=(camera,))])


@pytest.mark.parametrize("channels", [1, 3])
def test_depth_of_lerobot_survives_the_formats_that_hold_it(tmp_path: Path, channels: int) -> None:
    folder = with_depth(tmp_path / "a", channels=channels)
    [part] = open_dataset(folder).account.left_out
    assert (part.name, part.count) == (TOP, EPISODES * STEPS)
    at = open_dataset(folder, depth_unit_m=UNIT_M)
    assert at.features.depth == ("top",)
    assert not at.account.left_out
    assert [p.why for p in at.account.changed if p.name == TOP] == ["depth in units of 0.001 m, read as metres"]
    expected = np.stack([millimetres(step) for step in range(STEPS)]) * UNIT_M
    for format, options in (("hdf5", None), ("lerobot", LeRobotOptions(images=True)), ("hdf5", None)):
        at = converted(at, tmp_path / f"{format}{len(list(tmp_path.iterdir()))}", format, options)
        np.testing.assert_allclose(depths(at), expected, atol=1.3e-4)
    written = write_dataset(plan_of(at), tmp_path / "rlds", "rlds", how="convert")
    assert [(p.name, p.count, p.why) for p in written.left_out] == [
        ("depth of camera top", EPISODES * STEPS, "rlds holds colour images only")
    ]


def stated(folder: Path, unit: str, values: Callable[[int], np.ndarray]) -> Path:
    """Write a dataset as lerobot 0.6 does: depth in TIFF, whose unit ``info.json`` states.

    Source: huggingface/lerobot@7427f318, datasets/image_writer.py, dataset_writer.py (depth_unit).
    """
    with_depth(folder)
    table = pq.read_table(folder / DATA)
    cells = []
    for row in range(table.num_rows):
        out = io.BytesIO()
        Image.fromarray(values(row % STEPS)).save(out, "TIFF")
        cells.append({"bytes": out.getvalue(), "path": None})
    at = table.column_names.index(TOP)
    pq.write_table(table.set_column(at, TOP, pa.array(cells, table.schema.field(TOP).type)), folder / DATA)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][TOP]["info"] = {"is_depth_map": True, "depth_unit": unit}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize(
    ("unit", "values"), [("mm", millimetres), ("m", lambda step: (millimetres(step) * UNIT_M).astype(np.float32))]
)
def test_depth_whose_unit_lerobot_states_needs_no_option(
    tmp_path: Path, unit: str, values: Callable[[int], np.ndarray]
) -> None:
    folder = stated(tmp_path / "a", unit, values)
    at = open_dataset(folder)
    assert at.features.depth == ("top",)
    assert not at.account.left_out
    expected = np.stack([millimetres(step) for step in range(STEPS)]) * UNIT_M
    np.testing.assert_allclose(depths(at), expected, atol=1e-6)
    made = converted(at, tmp_path / "b", "lerobot", LeRobotOptions(images=True))
    np.testing.assert_allclose(depths(made), expected, atol=1.3e-4)
    with pytest.raises(InvalidRequestError, match=f"says that '{TOP}' is in {unit}; leave --depth-unit out"):
        open_dataset(folder, depth_unit_m=0.5)


def test_a_unit_that_lerobot_does_not_know_is_none(tmp_path: Path) -> None:
    [part] = open_dataset(stated(tmp_path / "a", "furlong", millimetres)).account.left_out
    assert part.name == TOP


LEVELS = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}
FILM_SIDE = 64


def filmed(folder: Path, numbers: Callable[[int], np.ndarray], pixels: str) -> Path:
    """Write a dataset as lerobot 0.6 does: depth in a video without loss beside a camera's pictures."""
    import av

    folder, key = with_depth(folder, "observation.images.none"), TOP
    path, rows = folder / f"videos/{key}/chunk-000/file-000.mp4", EPISODES * STEPS
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx265", rate=10, options={"x265-params": "lossless=1:log-level=none"})
        stream.width = stream.height = FILM_SIDE
        stream.pix_fmt = pixels
        for row in range(rows):
            frame = av.VideoFrame.from_ndarray(numbers(row % STEPS), format=pixels)
            frame.pts = row
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    table = pq.read_table(folder / DATA).drop_columns(["observation.images.none"])
    cells = [{"bytes": png(np.zeros((FILM_SIDE, FILM_SIDE, 3), np.uint8)), "path": None}] * rows
    at = table.column_names.index(CAMERA)
    pq.write_table(table.set_column(at, CAMERA, pa.array(cells, table.schema.field(CAMERA).type)), folder / DATA)
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    columns = {"chunk_index": [0] * EPISODES, "file_index": [0] * EPISODES}
    columns |= {"from_timestamp": [STEPS * episode / 10 for episode in range(EPISODES)]}
    for name, values in columns.items():
        episodes = episodes.append_column(f"videos/{key}/{name}", pa.array(values))
    pq.write_table(episodes, folder / "meta/episodes/chunk-000/file-000.parquet")
    info = json.loads((folder / "meta/info.json").read_text())
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    info["features"][CAMERA]["shape"] = [FILM_SIDE, FILM_SIDE, 3]
    about = {"is_depth_map": True, "depth_unit": "mm", "video.pix_fmt": "gray12le", **LEVELS}
    del info["features"]["observation.images.none"]
    info["features"][key] = {"dtype": "video", "shape": [FILM_SIDE, FILM_SIDE, 1], "names": None, "info": about}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def codes(step: int) -> np.ndarray:
    """Return a frame of 12-bit numbers."""
    return (np.arange(FILM_SIDE**2, dtype=np.uint16) + step).reshape(FILM_SIDE, FILM_SIDE) % 4096


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return filmed(tmp_path_factory.mktemp("film") / "a", codes, "gray12le")


def described(film: Path, folder: Path, changes: dict[str, Any]) -> Path:
    """Return a copy of a dataset whose video of depth is described otherwise; None: not at all."""
    shutil.copytree(film, folder)
    info = json.loads((folder / "meta/info.json").read_text())
    about = info["features"][TOP]["info"] | changes
    info["features"][TOP]["info"] = {name: value for name, value in about.items() if value is not None}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize("log", [True, False])
def test_a_video_of_depth_is_read_by_the_levels_that_lerobot_states(film: Path, tmp_path: Path, log: bool) -> None:
    at = open_dataset(described(film, tmp_path / "a", {"video.use_log": log}))
    assert not at.account.left_out
    level = np.stack([codes(step) for step in range(STEPS)]) / 4095
    expected = 0.01 + level * 9.99
    if log:
        expected = np.exp(np.log(3.51) + level * np.log(13.5 / 3.51)) - 3.5
    np.testing.assert_allclose(depths(at), expected, atol=1e-6)
    np.testing.assert_array_equal(depths(converted(at, tmp_path / "b", "hdf5")), depths(at))
    written = write_dataset(plan_of(at), tmp_path / "c", "lerobot", LeRobotOptions(images=True), how="convert")
    found = depths(open_dataset(written.path))
    np.testing.assert_allclose(found, np.where(expected > 8.19175, 0, expected), atol=1.3e-4)
    assert [part.why for part in written.changed if part.name == "depth of camera top"] == [
        "in units of 0.00025 m; 0 where it is beyond 8.19 m or unknown"
    ]


def test_depth_of_another_tool_differs_by_the_rounding_of_lerobots_unit(film: Path, tmp_path: Path) -> None:
    at = open_dataset(described(film, tmp_path / "a", {"video.depth_max": 5.0}))
    made = converted(at, tmp_path / "b", "lerobot", LeRobotOptions(images=True))
    assert not compare(at, made, images="exact").differences


def test_a_video_of_distances_needs_their_unit(film: Path, tmp_path: Path) -> None:
    folder = described(film, tmp_path / "a", dict.fromkeys([*LEVELS, "depth_unit"]))
    [part] = open_dataset(folder).account.left_out
    assert part.why == "a video of depth (gray12le), whose unit the format does not state (--depth-unit does)"
    expected = np.stack([codes(step) for step in range(STEPS)]) * UNIT_M
    np.testing.assert_allclose(depths(open_dataset(folder, depth_unit_m=UNIT_M)), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("video.depth_max", 0.01),
        ("video.depth_max", "far"),
        ("video.depth_min", -1.0),
        ("video.shift", -0.01),
        ("video.use_log", None),
        ("video.pix_fmt", "yuv420p"),
    ],
)
def test_a_video_of_depth_on_a_scale_that_cannot_be_is_named(film: Path, tmp_path: Path, name: str, value: Any) -> None:
    [part] = open_dataset(described(film, tmp_path / "a", {name: value or "yes"})).account.left_out
    assert (part.name, part.count) == (TOP, EPISODES * STEPS)


def test_a_video_that_is_none_of_depth_is_damage(tmp_path: Path) -> None:
    folder = filmed(tmp_path / "a", lambda step: codes(step).astype(np.uint8), "gray")
    with pytest.raises(RecorderError, match="frames of gray.*, expected depth: grey frames of 9 to 16 bits"):
        depths(open_dataset(folder))


@pytest.mark.parametrize(("key", "side"), [("observation.images.wrist_depth", SIDE), (TOP, 2 * SIDE)])
def test_depth_without_a_camera_of_its_name_and_size_is_named(tmp_path: Path, key: str, side: int) -> None:
    folder = with_depth(tmp_path / "a", key, side)
    with pytest.raises(InvalidRequestError, match=f"{key}: .*without a colour camera of that name and size"):
        open_dataset(folder, depth_unit_m=UNIT_M)


def test_a_depth_image_of_another_size_is_damage(tmp_path: Path) -> None:
    folder = with_depth(tmp_path / "a")
    table = pq.read_table(folder / DATA)
    cells = table.column(TOP).to_pylist()
    cells[-1] = {"bytes": png(millimetres(0, 2 * SIDE)), "path": None}
    at = table.column_names.index(TOP)
    pq.write_table(table.set_column(at, TOP, pa.array(cells, table.schema.field(TOP).type)), folder / DATA)
    with pytest.raises(
        RecorderError, match=rf"episode 2, step 3, '{TOP}': a picture has the size 16 x 16, expected 8 x 8"
    ):
        depths(open_dataset(folder, depth_unit_m=UNIT_M))


@pytest.mark.parametrize("unit", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_unit_that_is_no_length_is_refused(tmp_path: Path, unit: float) -> None:
    with pytest.raises(InvalidRequestError, match="above 0 and at most 1000"):
        open_dataset(with_depth(tmp_path / "a"), depth_unit_m=unit)


def test_a_unit_that_nothing_needs_is_refused(tmp_path: Path) -> None:
    lerobot30(tmp_path / "a")
    with pytest.raises(InvalidRequestError, match="has no depth images that could be read"):
        open_dataset(tmp_path / "a", depth_unit_m=UNIT_M)
    own = converted(open_dataset(with_depth(tmp_path / "b"), depth_unit_m=UNIT_M), tmp_path / "c", "hdf5")
    converted(own, tmp_path / "d", "lerobot", LeRobotOptions(images=True))
    for place in ("c", "d"):
        with pytest.raises(InvalidRequestError, match="states the unit of its depth"):
            open_dataset(tmp_path / place, depth_unit_m=UNIT_M)


def test_another_unit_is_another_conversion(tmp_path: Path) -> None:
    folder, found = with_depth(tmp_path / "a"), []
    for unit in (0.001, 0.002):
        plan = plan_of(open_dataset(folder, depth_unit_m=unit))
        made = write_dataset(plan, tmp_path / "b", "hdf5", how="convert", overwrite=True)
        found.append(depths(open_dataset(made.path)).mean())
    assert found[1] == pytest.approx(2 * found[0])


@pytest.mark.parametrize(
    ("name", "cameras", "found"),
    [
        ("agentview_depth", ("agentview", "wrist"), "agentview"),
        ("depth/wrist", ("agentview", "wrist"), "wrist"),
        ("cam_high.depth_image", ("cam_high",), "cam_high"),
        ("robot0_eye_in_hand_depth", ("robot0_eye_in_hand", "agentview"), "robot0_eye_in_hand"),
        ("side_depth", ("side_1", "side_2"), ""),
        ("depth", ("image", "rgb"), ""),
    ],
)
def test_depth_belongs_to_the_camera_of_its_name(name: str, cameras: tuple[str, ...], found: str) -> None:
    assert camera_of(name, cameras) == found


# -- HDF5, over generated layouts

IMAGES = st.dictionaries(st.sampled_from(["left", "right", "top"]), st.sampled_from([6, 8]), max_size=3)
DEPTHS = st.dictionaries(
    st.sampled_from(["left_depth", "right_depth", "depth/top", "lone_depth", "left_segmentation"]),
    st.tuples(st.sampled_from([(6, 6), (8, 8), (8, 8, 1), (6, 6, 1)]), st.sampled_from(["f4", "f2", "u2", "i4", "u1"])),
    max_size=4,
)


@FAST
@given(IMAGES, DEPTHS, st.booleans())
def test_depth_segmentation_and_cameras_of_hdf5_add_up(images: Any, depth: Any, stated: bool) -> None:
    with tempfile.TemporaryDirectory() as place:
        held = {"actions": 2 * STEPS}
        with h5py.File(Path(place) / "data.hdf5", "w") as file:
            for number in range(2):
                demo = file.create_group(f"data/demo_{number}")
                demo["actions"] = np.ones((STEPS, 7), "f4")
                for name, side in images.items():
                    demo[f"obs/{name}_image"] = np.ones((STEPS, side, side, 3), "u1")
                    held[f"obs/{name}_image"] = 2 * STEPS
                for name, (shape, kind) in depth.items():
                    demo[f"obs/{name}"] = np.full((STEPS, *shape), 250, kind)
                    held[f"obs/{name}"] = 2 * STEPS
        kinds = {name: (shape[:2], kind) for name, (shape, kind) in depth.items()}
        usable = [
            name
            for name, (shape, kind) in kinds.items()
            if "depth" in name and kind != "u1" and shape == (images.get(camera_of(name, images)),) * 2
        ]
        if stated and not usable:
            with pytest.raises(InvalidRequestError, match="no depth images that could be read"):
                open_dataset(place, depth_unit_m=UNIT_M)
            return
        dataset = open_dataset(place, depth_unit_m=UNIT_M if stated else 0.0)
        assert len(dataset.features.depth) == len(usable) * stated
        counted: dict[str, int] = {}
        for part in dataset.account.parts:
            if part.kind == "key":
                counted[part.name] = counted.get(part.name, 0) + part.count
        assert counted == held
        left_out = {part.name for part in dataset.account.left_out}
        features = dataset.features
        read = len(features.cameras) + len(features.depth) + len(features.vectors) + 1
        assert read + len(left_out) == len(held), (features, left_out)
        for camera in features.depth:
            first = next(iter(dataset.episode(0).steps((camera,), depth=(camera,))))
            np.testing.assert_allclose(first.depth[camera], 0.25, rtol=1e-3)
            assert first.depth[camera].shape == first.images[camera].shape[:2]
