"""The table "Datasets of others" of the documentation, line by line: every phrase has a test that shows it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import EPISODES, STEPS, hdf5, lerobot30, rlds

from roboxim_core.errors import RoboximError
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.tfrecord import decode_example, encode_example, read_records, write_record

PAGE = Path(__file__).parents[4] / "docs/how-to/data.md"
DATA = "data/chunk-000/file-000.parquet"
SHOWN: dict[str, dict[str, str]] = {
    "all": {
        "colour images, vectors of numbers, actions, rewards": "test_what_is_made_is_read",
        "instructions of each step": "test_several_tasks_of_an_episode_survive_every_format",
        "episodes, splits": "test_every_array_of_an_hdf5_file_is_accounted_for",
        "success": "test_an_outcome_that_nobody_states_stays_unknown",
        "other types and shapes, numbers that are not float32": "test_other_types_are_read_or_named",
        "NaN or an infinity in an episode, with episode, name and step": "test_damage_names_episode_key_and_step",
        "a picture of another size than described": "test_lerobot_of_others",
    },
    "success": {
        "`success` of an episode or, in HDF5, of its last step": "test_success_of_each_step_is_that_of_the_last_one",
        "`next.success`, rewards that are 0 and at the end 1": "test_what_says_that_it_solved",
        "everything else is *unknown*; no conversion turns unknown into a failure":
            "test_an_outcome_that_nobody_states_stays_unknown",
    },
    "rate": {
        "LeRobot's `fps`": "test_the_rate_of_lerobot_survives_rlds",
        "`control_freq` of robosuite": "test_a_rate_is_read_stated_or_refused",
        "`fps` of an episode's metadata": "test_the_rate_of_lerobot_survives_rlds",
        "*not stated*": "test_rlds_of_others_becomes_lerobot_with_a_stated_rate",
        "`--fps` against a rate that the dataset states": "test_a_rate_is_read_stated_or_refused",
        "LeRobot without a rate: state it with `--fps`": "test_rlds_of_others_needs_its_rate_and_no_more",
    },
    "RLDS": {
        "file-name templates of TensorFlow Datasets, images without a fixed size":
            "test_rlds_of_others_becomes_lerobot_with_a_stated_rate",
        "several instructions in an episode": "test_several_tasks_of_an_episode_survive_every_format",
        "embeddings, depth, tensors of more than one dimension, `discount`": "test_what_rlds_leaves_out",
        "ids that repeat": "test_rlds_of_others_needs_its_rate_and_no_more",
        "`is_first` and `is_last` that are not in order": "test_flags_of_rlds_that_are_not_in_order_are_named",
        "numbers of episodes that the shards cannot hold": "test_declared_sizes_are_not_believed",
        "damaged records, files that are no TFRecord": "test_damaged_records_are_refused",
    },
    "LeRobot 3.0, 2.1, 2.0": {
        "rows by `episode_index` and `frame_index`": "test_rows_are_found_by_their_episode_and_frame",
        "instructions by `task_index`": "test_several_tasks_of_an_episode_survive_every_format",
        "episodes that no split names (as `train`)": "test_episodes_that_no_split_names_are_read",
        "depth images and videos without a stated unit": "test_deep_images_are_named_not_narrowed",
        "texts, tasks of no step": "test_what_lerobot_leaves_out",
        "times that are not `frame_index` / `fps`": "test_times_that_are_not_those_of_their_frames_are_named",
        "rows of no episode": "test_every_row_and_column_of_a_lerobot_dataset_is_accounted_for",
        "episodes without steps": "test_lerobot_of_others",
        "statistics with NaN": "test_statistics_that_are_not_finite_name_the_episode",
        "gaps and repeats in `frame_index`, an empty value": "test_damage_names_episode_key_and_step",
        "another number of rows than the table of episodes says":
            "test_every_row_and_column_of_a_lerobot_dataset_is_accounted_for",
    },
    "HDF5 (robomimic, robosuite, Isaac Lab, LIBERO)": {
        "nested groups (`a/b` becomes `a.b`)": "test_hdf5_of_others",
        "1-D observations, matrices as vectors": "test_what_hdf5_reads_and_leaves_out",
        "demonstrations in no mask (as `train`, unless there is a mask `train`)": "test_hdf5_of_others",
        "demonstrations without actions or without arrays that most have": "test_hdf5_of_others",
        "other masks": "test_masks_and_observations_of_hdf5_are_read_or_named",
        "float images, `states` and everything outside `obs/`": "test_what_hdf5_reads_and_leaves_out",
        "depth without a stated unit": "test_depth_segmentation_and_cameras_of_hdf5_add_up",
        "a file whose episodes all lack `actions`": "test_what_hdf5_reads_and_leaves_out",
    },
}  # fmt: skip
"""Row of the table to its phrases, each with the test of this folder that shows it; lists may be split up."""


def rows() -> dict[str, str]:
    """Return the table: first cell to the others."""
    text = PAGE.read_text().split("## Datasets of others")[1].split("Genuine datasets")[0]
    cells = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines() if line[:1] == "|"]
    return {first: " ; ".join(rest).strip(" |") for first, *rest in cells[2:]}


@pytest.mark.parametrize("row", SHOWN)
def test_every_phrase_of_the_table_has_a_test(row: str) -> None:
    left = rows()[row]
    names = set(re.findall(r"def (test_\w+)", "".join(f.read_text() for f in Path(__file__).parent.glob("test_*.py"))))
    for phrase, test in SHOWN[row].items():
        assert test in names, test
        for part in (phrase,) if phrase in left else phrase.split(", "):
            part = part.removeprefix("and ")
            assert part in left, f"the page does not say '{part}'"
            left = left.replace(part, "", 1)
    assert not re.sub(r"[\s,;.|]|\band\b", "", left), f"without a test: {left}"
    assert set(rows()) == set(SHOWN)


# -- what no other test shows


def _left_out(dataset: Dataset) -> dict[str, str]:
    return {part.name: part.why for part in dataset.account.left_out}


def test_what_says_that_it_solved(tmp_path: Path) -> None:
    solved = open_dataset(hdf5(tmp_path / "a"))  # rewards are 0 and at the end 1
    assert [episode.success for episode in solved.episodes()] == [True] * EPISODES
    with h5py.File(tmp_path / "a" / "data.hdf5", "r+") as file:
        for demo in file["data"].values():
            demo.attrs["success"] = False
    assert [episode.success for episode in open_dataset(tmp_path / "a").episodes()] == [False] * EPISODES
    folder = lerobot30(tmp_path / "b")
    table = pq.read_table(folder / DATA)
    at_the_end = pa.array([row % STEPS == STEPS - 1 for row in range(table.num_rows)])
    pq.write_table(table.append_column("next.success", at_the_end), folder / DATA)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["next.success"] = {"dtype": "bool", "shape": [1], "names": None}
    (folder / "meta/info.json").write_text(json.dumps(info))
    assert [episode.success for episode in open_dataset(folder).episodes()] == [True] * EPISODES


def test_a_rate_is_read_stated_or_refused(tmp_path: Path) -> None:
    dataset = open_dataset(hdf5(tmp_path / "a"))
    assert dataset.description.fps == 20
    with pytest.raises(RoboximError, match="20 steps per second, not 7; leave --fps out"):
        write_dataset(plan_of(dataset), tmp_path / "b", "rlds", how="convert", fps=7)
    with h5py.File(tmp_path / "a" / "data.hdf5", "r+") as file:
        del file["data"].attrs["env_args"]
    unstated = open_dataset(tmp_path / "a")
    assert unstated.description.fps == 0
    for format in ("rlds", "hdf5"):
        made = write_dataset(plan_of(unstated), tmp_path / format, format, how="convert", fps=7)
        assert open_dataset(made.path).description.fps == 7, f"{format} keeps the rate that the caller states"


def _rewritten(folder: Path, change: Callable[[dict[str, object]], dict[str, object]]) -> None:
    file = next(folder.glob("*tfrecord*"))
    records = [decode_example(record) for record in read_records(file)]
    with file.open("wb") as handle:
        for record in records:
            write_record(handle, encode_example(change(dict(record))))  # type: ignore[arg-type]


def test_what_rlds_leaves_out(tmp_path: Path) -> None:
    folder = rlds(tmp_path / "a" / "1.0.0", ids=(0,))
    data = json.loads((folder / "features.json").read_text())
    steps = data["featuresDict"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]

    def tensor(*shape: int) -> dict[str, object]:
        return {"tensor": {"shape": {"dimensions": [str(n) for n in shape]}, "dtype": "float32", "encoding": "none"}}

    steps |= {"discount": tensor(), "language_embedding": tensor(512)}
    steps["observation"]["featuresDict"]["features"]["depth"] = tensor(8, 8, 1)
    (folder / "features.json").write_text(json.dumps(data))
    sizes = {"discount": 1, "language_embedding": 512, "observation/depth": 64}
    more = {f"steps/{name}": np.zeros(STEPS * size, np.float32) for name, size in sizes.items()}
    _rewritten(folder, lambda record: {**record, **more})
    assert set(_left_out(open_dataset(folder))) == {*more, "steps/observation/pose"}


@pytest.mark.parametrize("content", [b"no TFRecord at all", b""])
def test_damaged_records_are_refused(tmp_path: Path, content: bytes) -> None:
    folder = rlds(tmp_path / "a" / "1.0.0")
    file = next(folder.glob("*tfrecord*"))
    whole = file.read_bytes()
    for damaged in (content, whole[:-3], whole[:40] + bytes([whole[40] ^ 255]) + whole[41:]):
        file.write_bytes(damaged)
        with pytest.raises(RoboximError, match="record|shard|episodes"):
            sum(1 for episode in open_dataset(folder).episodes() for _ in episode.steps())


def test_what_lerobot_leaves_out(tmp_path: Path) -> None:
    folder = lerobot30(tmp_path / "a")
    table = pq.read_table(folder / DATA)
    pq.write_table(table.append_column("said", pa.array(["x"] * table.num_rows)), folder / DATA)
    tasks = pa.table({"task_index": [0, 1], "task": ["reach the cube", "nothing"]})
    pq.write_table(tasks, folder / "meta/tasks.parquet")
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["said"] = {"dtype": "string", "shape": [1], "names": None}
    deep = {"video.is_depth_map": True, "video.pix_fmt": "gray12le"}
    info["features"]["observation.images.deep"] = {"dtype": "video", "shape": [8, 8, 1], "names": None, "info": deep}
    scale = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}
    said = {"is_depth_map": True, "video.pix_fmt": "gray12le", **scale}  # as lerobot 0.6 does
    info["features"]["observation.images.scaled"] = {"dtype": "video", "shape": [8, 8, 1], "names": None, "info": said}
    (folder / "meta/info.json").write_text(json.dumps(info))
    left_out = _left_out(open_dataset(folder))
    assert set(left_out) == {"said", "1 'nothing'", "observation.images.deep", "observation.images.scaled"}
    assert left_out["observation.images.deep"].startswith("a video of depth (gray12le)")
    assert left_out["observation.images.scaled"] == (
        "a video of depth of 8 x 8 without a colour camera of that name and size"
    )


def test_what_hdf5_reads_and_leaves_out(tmp_path: Path) -> None:
    folder = hdf5(tmp_path / "a")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        for demo in file["data"].values():
            demo["obs/matrix"] = np.ones((STEPS, 4, 4))
            demo["obs/float_image"] = np.ones((STEPS, 8, 8, 3), "f4")
    dataset = open_dataset(folder)
    assert {"gripper", "matrix"} <= set(dataset.features.vectors)
    assert len(dataset.features.vectors["matrix"]) == 16
    assert set(_left_out(dataset)) == {"obs/float_image", "states"}
    with h5py.File(folder / "data.hdf5", "r+") as file:
        for demo in file["data"].values():
            del demo["actions"]
    with pytest.raises(RoboximError, match="no episode that can be read; demo_0: it has no 'actions'"):
        open_dataset(folder)
