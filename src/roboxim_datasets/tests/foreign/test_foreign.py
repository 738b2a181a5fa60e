"""Datasets as other tools write and edit them are read rightly, or refused in a sentence."""

from __future__ import annotations

import json
import os
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_foreign import CAMERA, EPISODES, STEPS, TASKS, colour, hdf5, lerobot21, lerobot30, png, rlds

from roboxim_core.errors import RecorderError, RoboximError
from roboxim_datasets.card import count, summary
from roboxim_datasets.compare import compare
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.dataset import RldsOptions

FORMAT_PNG = RldsOptions(encoding="png")
DATA = "data/chunk-000/file-000.parquet"


def convert(source: Dataset, target: Path, format: str, options: object = None, fps: float = 0.0) -> Dataset:
    return open_dataset(write_dataset(plan_of(source), target, format, options, how="convert", fps=fps).path)


def edit(file: Path, column: str, values: list[object]) -> None:
    table = pq.read_table(file)
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, column, pa.array(values, table.schema.field(column).type)), file)


def test_several_tasks_of_an_episode_survive_every_format(tmp_path: Path) -> None:
    source = open_dataset(lerobot30(tmp_path / "a", subtasks=True))
    said = [step.instruction for step in source.episode(0).steps(())]
    assert said == [TASKS[0]] * (STEPS // 2) + [TASKS[1]] * (STEPS // 2)
    assert count(source).instructions == {TASKS[0]: EPISODES, TASKS[1]: EPISODES}
    at = source
    for format, options in (("rlds", None), ("hdf5", None), ("lerobot", LeRobotOptions(images=True))):
        at = convert(at, tmp_path / format, format, options)
        assert [step.instruction for step in at.episode(0).steps(())] == said
        assert at.description.fps == 10
    assert compare(source, at, images="psnr", lowest_psnr_db=5).equal


def test_an_outcome_that_nobody_states_stays_unknown(tmp_path: Path) -> None:
    at = open_dataset(lerobot30(tmp_path / "a"))
    for format, options in (("rlds", None), ("hdf5", None), ("lerobot", LeRobotOptions(images=True))):
        at = convert(at, tmp_path / format, format, options)
        assert [episode.success for episode in at.episodes()] == [None] * EPISODES
        assert "solved: unknown" in summary(at, count(at))
    for file in tmp_path.glob("**/*.json*"):
        assert '"success": false' not in file.read_text()


@pytest.mark.parametrize("splits", [{}, {"train": "0:2"}, {"train": "2:0"}, {"train": "0:1000000000"}])
def test_episodes_that_no_split_names_are_read(tmp_path: Path, splits: dict[str, str]) -> None:
    assert dict(open_dataset(lerobot30(tmp_path / "a", splits=splits)).splits) == {"train": EPISODES}


def test_rows_are_found_by_their_episode_and_frame(tmp_path: Path) -> None:
    before = open_dataset(lerobot30(tmp_path / "a"))
    folder = lerobot30(tmp_path / "b")
    table = pq.read_table(folder / DATA)
    order = np.random.default_rng(0).permutation(table.num_rows)
    pq.write_table(table.take(order), folder / DATA)
    assert compare(before, open_dataset(folder)).equal


def test_deep_images_are_named_not_narrowed(tmp_path: Path) -> None:
    dataset = open_dataset(lerobot30(tmp_path / "a", deep=True))
    assert not dataset.features.cameras
    [part] = dataset.account.left_out
    assert (part.name, part.count) == (CAMERA, EPISODES * STEPS)
    assert "16-bit depth" in part.why


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("observation.state", None, r"episode 2: 'observation.state' is empty \(null\) at step 1"),
        ("action", [float("nan")] * 6, r"the action is not a finite number at step 1"),
        ("action", [0.0] * 5, r"episode 2: 'action' has another number of values at step 1"),
        (CAMERA, None, r"episode 2: 'observation.images.top' has no image at step 1"),
        (
            CAMERA,
            {"bytes": b"x", "path": None},
            r"episode 2, step 1.*bytes that are no picture|1 bytes that are no picture",
        ),
        (
            CAMERA,
            {"bytes": png(colour(np.random.default_rng(0), 16)), "path": None},
            "has the size 16 x 16, expected 8 x 8",
        ),
        (CAMERA, {"bytes": None, "path": "/etc/hostname"}, "lies outside of the dataset's folder"),
        (CAMERA, {"bytes": None, "path": "../../../x.png"}, "lies outside of the dataset's folder"),
        ("frame_index", 0, "not numbered 0 to 3 by frame_index"),
        ("task_index", 7, None),
    ],
)
def test_damage_names_episode_key_and_step(tmp_path: Path, column: str, value: object, message: str | None) -> None:
    folder = lerobot30(tmp_path / "a")
    values = pq.read_table(folder / DATA).column(column).to_pylist()
    values[2 * STEPS + 1] = value
    edit(folder / DATA, column, values)
    if message is None:  # the table of episodes knows the only instruction
        assert open_dataset(folder).episode(2).instruction == TASKS[0]
        return
    with pytest.raises(RecorderError, match=message):
        convert(open_dataset(folder), tmp_path / "b", "hdf5")


@pytest.mark.parametrize("text", ["pick up the cube", "a\u2028b", "a\u0085b"])
def test_texts_of_version_21_are_whole(tmp_path: Path, text: str) -> None:
    folder = lerobot21(tmp_path / "a", tasks=text)
    line = json.dumps({"task_index": 0, "task": text}, ensure_ascii=False)
    (folder / "meta/tasks.jsonl").write_text(line + "\n", encoding="utf-8")
    assert [episode.instruction for episode in open_dataset(folder).episodes()] == [text] * EPISODES
    (folder / "meta/tasks.jsonl").unlink()
    assert open_dataset(folder).episode(0).instruction == text


def test_statistics_that_are_not_finite_name_the_episode(tmp_path: Path) -> None:
    folder = lerobot30(tmp_path / "a")
    values = pq.read_table(folder / DATA).column("action").to_pylist()
    values[STEPS] = [float("nan")] * 6
    edit(folder / DATA, "action", values)
    (folder / "meta/stats.json").write_text('{"action": {"mean": [NaN]}}')
    dataset = open_dataset(folder)
    assert "meta/stats.json" in summary(dataset, count(dataset))
    assert "not finite: episode 1 in 'action'" in dataset.account.left_out[-1].why


@pytest.mark.parametrize("template", ["", "{DATASET}-{SPLIT}.x-{SHARD_INDEX}", "{SPLIT}.tfrecord"])
def test_rlds_of_others_becomes_lerobot_with_a_stated_rate(tmp_path: Path, template: str) -> None:
    dataset = open_dataset(rlds(tmp_path / "bridge" / "1.0.0", side=-1, template=template))
    assert [(size.height, size.width) for size in dataset.features.cameras.values()] == [(8, 8)]
    with pytest.raises(RoboximError, match="--fps"):
        convert(dataset, tmp_path / "a", "lerobot")
    made = convert(dataset, tmp_path / "a", "lerobot", LeRobotOptions(images=True), fps=5)
    back = convert(made, tmp_path / "b", "rlds", FORMAT_PNG)
    assert back.description.fps == 5
    assert {str(difference) for difference in compare(dataset, back).differences} == {
        "steps per second: 0.0 against 5.0"
    }


def test_nothing_outside_of_the_folder_is_opened(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["obs"] = np.ones((STEPS, 3))
    for name, link in (("external", h5py.ExternalLink("../secret.h5", "/obs")), ("storage", None)):
        folder = hdf5(tmp_path / name)
        with h5py.File(folder / "data.hdf5", "r+") as file:
            if link:
                file["data/demo_0/obs/x"] = link
            else:
                place = [(str(tmp_path / "secret.h5"), 0, STEPS * 8)]
                file.create_dataset("data/demo_0/obs/x", (STEPS,), "f8", external=place)
        if link:
            with pytest.raises(RecorderError, match="link to another file"):
                open_dataset(folder)
        else:
            whys = {part.name: part.why for part in open_dataset(folder).account.left_out}
            assert "its values lie in another file" in whys["obs/x"]
    for template in ("../secret.h5", "{SPLIT}/../../../secret.h5", str(tmp_path / "secret.h5")):
        folder = rlds(tmp_path / f"r{len(template)}" / "1.0.0")
        text = (folder / "dataset_info.json").read_text()
        default = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
        (folder / "dataset_info.json").write_text(text.replace(default, template))
        with pytest.raises(RecorderError, match="outside of the dataset's folder|No such file"):
            open_dataset(folder)


@pytest.mark.parametrize("kind", ["fifo", "link", "lfs", "device"])
def test_what_is_no_regular_file_of_the_dataset_is_refused(tmp_path: Path, kind: str) -> None:
    folder = lerobot30(tmp_path / "a")
    file = folder / DATA
    content = file.read_bytes()
    file.unlink()
    if kind == "fifo":
        os.mkfifo(file)
    elif kind == "lfs":
        file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n")
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        (tmp_path / "x.parquet").write_bytes(content)
        file.symlink_to(tmp_path / "x.parquet")
    message = {"fifo": "no regular file", "lfs": "pointer of Git LFS"}.get(kind, "lies outside")
    with pytest.raises(RecorderError, match=message):
        count(open_dataset(folder))


def test_declared_sizes_are_not_believed(tmp_path: Path) -> None:
    folder = rlds(tmp_path / "a" / "1.0.0")
    info = folder / "dataset_info.json"
    for number in ("1000000000", "-3"):
        info.write_text(json.dumps({**json.loads(info.read_text()), "splits": [
            {**json.loads(info.read_text())["splits"][0], "shardLengths": [number]}]}))  # fmt: skip
        with pytest.raises(RecorderError, match=f"holds {number} episodes; its size allows"):
            open_dataset(folder)
    folder = hdf5(tmp_path / "b")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        file.create_dataset("data/demo_0/obs/x", (10**9, 7), "f8", chunks=(1000, 7))
    whys = {part.name: part.why for part in open_dataset(folder).account.left_out}
    assert whys["obs/x"].startswith("it claims 56000000000 bytes, but the file holds 0")
