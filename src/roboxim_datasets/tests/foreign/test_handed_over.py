"""Data as users of other tools handed it in, through the commands: read whole, or named in a sentence.

The first reports of others' data were nine groups of cases. Each is a test of this tree:

* HDF5 of Isaac Lab, robosuite and robomimic (nested groups, demonstrations without actions or steps, null attributes, a
  mask of some, observations of one number, a camera that one demonstration lacks): here.
* LeRobot 3.0 (several tasks in an episode, the rate through RLDS and back, 16-bit depth, splits that lag, an episode
  without steps, an image of null or of another size, a state of null, an action of one number): here.
* LeRobot 2.1 (a task as a plain text, characters that only look like line ends): here; all texts in `test_foreign`.
* RLDS (ids that repeat, no rate, images without a size): here.
* Bags that other tools wrote again: ``test_rewritten`` of the recorder.
* Objects (xacro, ROS's folder layout, mass beside a URDF, DAE, Latin-1): ``test_own_objects`` of the core.
* YAML in other encodings, and an empty task file: here; ``test_documents`` of the core, ``test_task_choice`` of runs.
* Terminals of another ROS, a home that cannot be written: ``test_environment`` of ``roboxim_ros``.
* The exit code of ``policy check``: ``test_remote_policies``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from made_foreign import CAMERA, EPISODES, SIDE, STEPS, TASKS, colour, hdf5, lerobot21, lerobot30, png, rlds

from roboxim_cli.main import group
from roboxim_core.errors import RoboximError

DATA = "data/chunk-000/file-000.parquet"
TABLE = "meta/episodes/chunk-000/file-000.parquet"


def said(*words: object) -> str:
    """Return what a command prints, or its error: any other exception fails the test."""
    done = CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False)
    if done.exception is None:
        return done.output
    assert isinstance(done.exception, RoboximError), done.exc_info
    return f"{done.output}refused: {done.exception}"


def through(source: Path, target: Path, format: str, *more: str) -> str:
    """Describe a dataset, convert it, and describe the result; return all that was said."""
    told = said("dataset", "info", source) + said("dataset", "convert", format, source, "--out", target, *more)
    return told if "refused: " in told else told + said("dataset", "info", target)


# -- HDF5

ROBOSUITE = {"env_name": "Lift", "type": 1}


def _attributes(data: Any, arguments: object) -> None:
    data.attrs["env_args"] = json.dumps({**ROBOSUITE, "env_kwargs": arguments})


def _nested(data: Any) -> None:
    for demo in data.values():
        demo["obs/datagen_info/eef_pose/franka"] = np.zeros((STEPS, 4, 4), "f4")
        demo.attrs["success"] = True


def _without_steps(data: Any) -> None:
    for key in ("actions", "rewards", "obs/eef_pos", "obs/agentview_image"):
        kind, shape = data["demo_1"][key].dtype, data["demo_1"][key].shape
        del data["demo_1"][key]
        data["demo_1"].create_dataset(key, (0, *shape[1:]), kind)


def _mask_of_some(data: Any) -> None:
    del data.parent["mask/train"]


def _next_observations(data: Any, *, apart: float = 0.0) -> None:
    for demo in data.values():
        for name in list(demo["obs"]):
            values = demo["obs"][name][()]
            demo[f"next_obs/{name}"] = np.concatenate([values[1:], values[:1]]) + np.array(apart, values.dtype)


def _damaged_next_observations(data: Any) -> None:
    """Add next observations of which a stored byte is wrong, as its checksum tells."""
    for demo in data.values():
        values = demo["obs/eef_pos"][()]
        made = demo.create_dataset(
            "next_obs/eef_pos", data=np.concatenate([values[1:], values[:1]]), chunks=values.shape, fletcher32=True
        )
        made.file.flush()
        at = made.id.get_chunk_info(0).byte_offset
        with Path(made.file.filename).open("r+b") as file:
            file.seek(at)
            first = file.read(1)
            file.seek(at)
            file.write(bytes([first[0] ^ 255]))


HDF5_CASES: dict[str, tuple[Callable[[Any], None], tuple[str, ...]]] = {
    "nested": (_nested, ("datagen_info",)),
    "no actions": (lambda data: data["demo_2"].__delitem__("actions"), ("demo_2", "it has no 'actions'")),
    "no steps": (_without_steps, ("demo_1", "it has no steps")),
    "null rate": (lambda data: _attributes(data, {"control_freq": None}), (f"{EPISODES} episodes",)),
    "null arguments": (lambda data: _attributes(data, None), (f"{EPISODES} episodes",)),
    "mask of some": (_mask_of_some, (f"{EPISODES} episodes",)),
    "one number": (lambda data: None, ("gripper",)),
    "next observations": (
        _next_observations,
        (f"{EPISODES} episodes", "next_obs/eef_pos", "the observation after the last action"),
    ),
    "other next observations": (
        lambda data: _next_observations(data, apart=3.0),
        (f"{EPISODES} episodes", f"next_obs/eef_pos, {EPISODES * STEPS} frames"),
    ),
    "damaged next observations": (
        _damaged_next_observations,
        (f"{EPISODES} episodes", f"next_obs/eef_pos, {EPISODES * STEPS} frames"),
    ),
    "arm": (lambda data: _attributes(data, {"robots": ["Panda"]}), (f"{EPISODES} episodes", "robot     Panda")),
    "camera missing": (lambda data: data["demo_1"]["obs"].__delitem__("agentview_image"), ("demo_1", "lacks")),
}
"""Name to the edit of a file and to words that must be said."""


@pytest.mark.parametrize("case", HDF5_CASES)
def test_hdf5_of_others(tmp_path: Path, case: str) -> None:
    folder = hdf5(tmp_path / "a")
    edit, words = HDF5_CASES[case]
    with h5py.File(folder / "data.hdf5", "r+") as file:
        edit(file["data"])
    told = through(folder / "data.hdf5", tmp_path / "b", "rlds")
    assert "refused" not in told
    assert all(word in told or word == f"{EPISODES} episodes" for word in words), told
    assert _episodes(told) == (EPISODES if f"{EPISODES} episodes" in words or case in ("nested", "one number") else 2)


def _episodes(told: str) -> int:
    """Return the number of episodes that the last description states."""
    line = [line for line in told.splitlines() if line.startswith("episodes")][-1]
    return sum(int(word) for word in line.split(";")[0].replace(",", " ").split() if word.isdigit())


# -- LeRobot


def _column(name: str, row: int, value: object) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        table = pq.read_table(folder / DATA)
        values = table.column(name).to_pylist()
        values[row] = value
        at = table.column_names.index(name)
        pq.write_table(table.set_column(at, name, pa.array(values, table.schema.field(name).type)), folder / DATA)

    return edit


def _scalar_action(folder: Path) -> None:
    table = pq.read_table(folder / DATA)
    at = table.column_names.index("action")
    pq.write_table(table.set_column(at, "action", pa.array(np.zeros(table.num_rows, "f4"))), folder / DATA)


def _no_steps(folder: Path) -> None:
    table = pq.read_table(folder / TABLE)
    rows = table.to_pydict()
    rows["length"][1], rows["dataset_to_index"][1] = 0, rows["dataset_from_index"][1]
    pq.write_table(pa.table(rows), folder / TABLE)
    data = pq.read_table(folder / DATA)
    pq.write_table(data.filter(pa.array([n != 1 for n in data.column("episode_index").to_pylist()])), folder / DATA)


def _picture(side: int) -> dict[str, object]:
    return {"bytes": png(colour(np.random.default_rng(0), side)), "path": None}


LEROBOT_CASES: dict[str, tuple[dict[str, Any], Callable[[Path], None], str, tuple[str, ...]]] = {
    "several tasks": ({"subtasks": True}, lambda _: None, "rlds", TASKS),
    "depth": ({"deep": True}, lambda _: None, "hdf5", (CAMERA, "16-bit depth")),
    "splits lag": ({"splits": {"train": f"0:{EPISODES - 1}"}}, lambda _: None, "hdf5", (f"{EPISODES} train",)),
    "no splits": ({"splits": {}}, lambda _: None, "hdf5", (f"{EPISODES} train",)),
    "no steps": ({}, _no_steps, "hdf5", ("1", f"{EPISODES - 1} train")),
    "no image": ({}, _column(CAMERA, STEPS, None), "hdf5", ("refused", "no image at step 0")),
    "image size": ({}, _column(CAMERA, STEPS, _picture(2 * SIDE)), "hdf5", ("refused", "size 16 x 16")),
    "null state": ({}, _column("observation.state", STEPS, None), "hdf5", ("refused", "is empty (null) at step 0")),
    "one action": ({}, _scalar_action, "hdf5", ("refused", "action")),
}
"""Name to the dataset's arguments, its edit, the format that it becomes, and words that must be said."""


@pytest.mark.parametrize("case", LEROBOT_CASES)
def test_lerobot_of_others(tmp_path: Path, case: str) -> None:
    made, edit, format, words = LEROBOT_CASES[case]
    edit(lerobot30(tmp_path / "a", **made))
    told = through(tmp_path / "a", tmp_path / "b", format)
    assert all(word in told for word in words), told
    assert ("refused" in told) == ("refused" in words), told


def test_the_rate_of_lerobot_survives_rlds(tmp_path: Path) -> None:
    lerobot30(tmp_path / "a")
    through(tmp_path / "a", tmp_path / "b", "rlds")
    assert "10 Hz" in through(tmp_path / "b", tmp_path / "c", "lerobot", "--images")


@pytest.mark.parametrize("tasks", [TASKS[0], [f"{TASKS[0]}\u2028{TASKS[1]}"]])
def test_tasks_of_lerobot_21_are_whole(tmp_path: Path, tasks: Any) -> None:
    folder = lerobot21(tmp_path / "a", tasks=tasks)
    text = tasks if isinstance(tasks, str) else tasks[0]
    (folder / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": text}, ensure_ascii=False) + "\n")
    told = through(folder, tmp_path / "b", "hdf5")
    assert "refused" not in told
    assert text in told or text.replace("\u2028", "\\u2028") in told, told


# -- RLDS


@pytest.mark.parametrize(("ids", "side"), [((0, 1, 0, 1), SIDE), ((0, 1, 2), -1)])
def test_rlds_of_others_needs_its_rate_and_no_more(tmp_path: Path, ids: tuple[int, ...], side: int) -> None:
    folder = rlds(tmp_path / "a" / "1.0.0", ids=ids, side=side)
    assert "--fps" in through(folder, tmp_path / "b", "lerobot", "--images")
    told = through(folder, tmp_path / "b", "lerobot", "--images", "--fps", "5")
    assert "refused" not in told
    assert _episodes(told) == len(ids)


# -- YAML


@pytest.mark.parametrize("words", [("tasks", "show"), ("assets", "check"), ("experiment", "plan")])
def test_yaml_of_another_encoding_is_refused_in_a_sentence(tmp_path: Path, words: tuple[str, ...]) -> None:
    (tmp_path / "latin1.yaml").write_bytes("# Würfel\nskill: pick_up\n".encode("latin-1"))
    told = said(*words, tmp_path / "latin1.yaml")
    assert "latin1.yaml" in told
    assert "not UTF-8" in told
