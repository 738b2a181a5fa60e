"""A LeRobot dataset holds what was written, whatever the files it is spread over."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.compare import compare
from roboxim_datasets.dataset import Description, Features
from roboxim_datasets.episode import EXECUTED, Episode, ImageSize, Step
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import LeRobotFormat, LeRobotOptions, LeRobotWriter
from roboxim_datasets.lerobot.content import content_of, layout_of
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.video.client import VideoDecoder, VideoWriters

ACTION = ("dx", "dy", "gripper")
FEATURES = Features(
    cameras={"top": ImageSize(height=24, width=32), "wrist": ImageSize(height=16, width=16)},
    keys={"top": "top", "wrist": "wrist_image"},
    depth=("wrist",),
    segmentation=("wrist",),
    action=ACTION,
    vectors={"state": ("tcp.x", "tcp.y"), "joint_positions": ("j1.position",)},
    signals={EXECUTED: ACTION, "sim.contact": ("force",)},
)
ABOUT = Description(features=FEATURES, fps=10, robot="panda", joint_names=("j1",), semantics=ActionSemantics())
LENGTHS = (5, 9, 4, 7, 6)


def picture(camera: str, episode: int, step: int) -> np.ndarray:
    size = FEATURES.cameras[camera]
    ramp = np.linspace(0, 120, size.height * size.width * 3).reshape(size.height, size.width, 3)
    return (ramp + 20 * episode + 3 * step).astype(np.uint8)


def make_episode(number: int) -> Episode:
    rng = np.random.default_rng(number)
    numbers = rng.normal(size=(LENGTHS[number], 16)).astype(np.float32)

    def read(wanted):
        for step, row in enumerate(numbers):
            yield Step(
                index=step,
                images={camera: picture(camera, number, step) for camera in wanted.cameras},
                depth={camera: np.full((16, 16), 0.4 + 0.05 * step, np.float32) for camera in wanted.depth},
                segmentation={camera: np.full((16, 16), 300 + step, np.uint16) for camera in wanted.segmentation},
                proprio={"state": row[:2], "joint_positions": row[2:3]},
                action=row[3:6],
                action_executed=row[6:9],
                signals={"sim.contact": row[9:10]},
                reward=float(step == LENGTHS[number] - 1),
            )

    return Episode(
        episode_id=f"e{number}", length=LENGTHS[number], instruction=f"Pick up cube {number % 2}",
        semantics=ABOUT.semantics, cameras=FEATURES.cameras, success=number != 2, robot="panda", joint_names=("j1",),
        fps=10.0, vectors=FEATURES.vectors, signals={"sim.contact": ("force",)}, depth=("wrist",),
        segmentation=("wrist",), metadata={"index": number, "skill": "pick_up"}, read=read,
    )  # fmt: skip


def write(path: Path, *, split: str = "", identity: str = "", sizes: int = 0, **options) -> Path:
    chosen = LeRobotOptions(**options)
    content = content_of(ABOUT, chosen)
    layout = layout_of(ABOUT, content, chosen)
    if sizes:
        layout = replace(layout, data_file_bytes=sizes, video_file_bytes=sizes)
    with LeRobotWriter(path, layout, content, identity=identity, workers=1) as writer:
        for number in range(len(LENGTHS)):
            writer.add("val" if number == 4 else "train", make_episode(number))
        writer.complete({"README.md": "made by a test"})
    return path


@pytest.fixture(scope="module")
def version_30(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("lerobot") / "set")


@pytest.fixture(scope="module")
def version_21(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("lerobot") / "set", version="2.1")


def require_same(path: Path, *, psnr: float | None = 30.0) -> None:
    """Compare a dataset with the episodes that were written; images by PSNR [dB], or exactly."""
    dataset = open_dataset(path)
    assert dict(dataset.splits) == {"train": 4, "val": 1}
    assert dataset.description.features.vectors == FEATURES.vectors
    assert (dataset.description.fps, dataset.description.semantics) == (10.0, ABOUT.semantics)
    for number, found in enumerate(dataset.episodes()):
        expected = make_episode(number)
        for name in ("episode_id", "length", "instruction", "semantics", "cameras", "success", "robot", "joint_names",
                     "fps", "vectors", "signals", "depth", "segmentation", "metadata"):  # fmt: skip
            assert getattr(found, name) == getattr(expected, name), name
        both = zip(
            found.steps(depth=["wrist"], segmentation=["wrist"]),
            expected.steps(depth=["wrist"], segmentation=["wrist"]),
            strict=True,
        )
        for mine, other in both:
            np.testing.assert_array_equal(mine.action, other.action)
            np.testing.assert_array_equal(mine.action_executed, other.action_executed)
            np.testing.assert_array_equal(mine.signals["sim.contact"], other.signals["sim.contact"])
            assert mine.reward == other.reward
            for vector, values in other.proprio.items():
                np.testing.assert_array_equal(mine.proprio[vector], values)
            np.testing.assert_allclose(mine.depth["wrist"], other.depth["wrist"], atol=1.26e-4)
            np.testing.assert_array_equal(mine.segmentation["wrist"], other.segmentation["wrist"])
            for camera, image in other.images.items():
                if psnr is None:
                    np.testing.assert_array_equal(mine.images[camera], image)
                else:
                    error = np.mean((mine.images[camera].astype(float) - image) ** 2)
                    assert 10 * np.log10(255**2 / max(error, 1e-9)) > psnr, (camera, number, mine.index)


@pytest.mark.parametrize("version", ["version_30", "version_21"])
def test_episodes_come_back_as_they_were_written(version, request):
    require_same(request.getfixturevalue(version))


@pytest.mark.parametrize("version", ["version_30", "version_21"])
def test_a_folder_is_read_by_its_relative_path_and_through_a_link(version, request, tmp_path, monkeypatch):
    folder = request.getfixturevalue(version)
    monkeypatch.chdir(folder.parent)
    require_same(Path(folder.name))
    (tmp_path / "link").symlink_to(folder)
    require_same(tmp_path / "link")


@pytest.mark.parametrize("sizes", [1, 4000])
def test_a_dataset_of_many_files_is_the_same(tmp_path, sizes):
    path = write(tmp_path / "set", sizes=sizes)
    videos, tables = (sorted(path.rglob(f"file-*.{suffix}")) for suffix in ("mp4", "parquet"))
    assert len(videos) > 3
    assert len([table for table in tables if "data" in table.parts]) > 1
    require_same(path)


def test_png_columns_are_lossless(tmp_path):
    path = write(tmp_path / "set", images=True)
    assert not list(path.rglob("*.mp4"))
    require_same(path, psnr=None)


def test_there_is_one_video_file_for_each_camera_and_times_come_from_frame_counts(version_30):
    assert sorted(str(p.relative_to(version_30)) for p in version_30.rglob("*.mp4")) == [
        "videos/observation.images.top/chunk-000/file-000.mp4",
        "videos/observation.images.wrist/chunk-000/file-000.mp4",
    ]
    rows = pq.read_table(version_30 / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    begins = np.cumsum([0, *LENGTHS])
    for row, begin, end in zip(rows, begins[:-1], begins[1:], strict=True):
        place = "videos/observation.images.top"
        assert (row[f"{place}/from_timestamp"], row[f"{place}/to_timestamp"]) == (begin / 10, end / 10)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (begin, end)


def test_the_encoder_uses_nothing_that_would_make_equal_frames_differ(version_30):
    """With the macroblock tree small frames differ once in about a hundred times, too seldom for a comparison."""
    for video in version_30.rglob("*.mp4"):
        settings = video.read_bytes().partition(b"options: ")[2].partition(b"\0")[0].decode()
        assert {"threads=1", "mbtree=0", "bframes=0"} <= set(settings.split()), settings


def test_the_description_is_what_lerobot_expects(version_30, version_21):
    info = json.loads((version_30 / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 10, "panda")
    assert info["splits"] == {"train": "0:4", "val": "4:5"}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 31, 2)
    assert info["features"]["action"] == {"dtype": "float32", "shape": [3], "names": list(ACTION)}
    assert info["features"]["observation.images.top"]["shape"] == [24, 32, 3]
    trained = [key for key in info["features"] if key.startswith(("observation", "action"))]
    assert sorted(trained) == [
        "action", "observation.images.top", "observation.images.wrist", "observation.state"
    ]  # fmt: skip
    tasks = pq.read_table(version_30 / "meta/tasks.parquet")
    assert tasks.column("task").to_pylist() == ["Pick up cube 0", "Pick up cube 1"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    lines = (version_21 / "meta/episodes.jsonl").read_text().splitlines()
    assert json.loads(lines[1]) == {"episode_index": 1, "tasks": ["Pick up cube 1"], "length": 9}
    for version in (version_30, version_21):
        modality = json.loads((version / "meta/modality.json").read_text())
        assert modality["state"]["tcp"] == {"start": 0, "end": 2, "original_key": "observation.state"}
        assert modality["annotation"]["human.task_description"] == {"original_key": "task_index"}


def test_statistics_are_of_the_whole_dataset(version_30):
    stats = json.loads((version_30 / "meta/stats.json").read_text())
    actions = np.concatenate([make_episode(number).actions() for number in range(5)]).astype(np.float64)
    np.testing.assert_allclose(stats["action"]["q99"], np.quantile(actions, 0.99, axis=0), rtol=1e-12)
    np.testing.assert_allclose(stats["action"]["std"], actions.std(axis=0), rtol=1e-12)
    assert stats["action"]["count"] == [31]
    assert np.shape(stats["observation.images.top"]["mean"]) == (3, 1, 1)
    rows = pq.read_table(version_30 / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    np.testing.assert_allclose(rows[1]["stats/action/max"], make_episode(1).actions().max(axis=0))


def test_openpi_finds_its_column_names(tmp_path):
    path = write(tmp_path / "set", version="2.1", columns="openpi")
    features = json.loads((path / "meta/info.json").read_text())["features"]
    assert {"state", "actions", "top", "wrist_image"} <= features.keys()
    require_same(path)


def test_a_dataset_of_another_tool_is_read_without_guesses(version_30, tmp_path):
    path = tmp_path / "foreign"
    shutil.copytree(version_30, path)
    for name in ("roboxim.json", "roboxim_episodes.jsonl"):
        (path / "meta" / name).unlink()
    info = json.loads((path / "meta/info.json").read_text())
    info["features"]["observation.state"]["names"] = {"motors": ["a", "b"]}
    info["features"]["action"]["names"] = None
    (path / "meta/info.json").write_text(json.dumps(info))
    dataset = open_dataset(path)
    assert dataset.description.semantics is None
    assert dataset.features.vectors == {"state": ("a", "b")}
    assert dataset.features.action == ("action.0", "action.1", "action.2")
    assert set(dataset.features.cameras) >= {"top", "wrist"}
    episode = dataset.episode(1)
    assert (episode.episode_id, episode.instruction, episode.success) == ("", "Pick up cube 1", True)
    step = next(episode.steps(["top"]))
    np.testing.assert_array_equal(step.proprio["state"], next(make_episode(1).steps([])).proprio["state"])
    assert step.images["top"].shape == (24, 32, 3)


def test_an_interrupted_build_goes_on_and_gives_the_same_bytes(tmp_path, version_30):
    chosen = LeRobotOptions()
    content = content_of(ABOUT, chosen)
    layout = layout_of(ABOUT, content, chosen)
    path = tmp_path / "set"
    with LeRobotWriter(path, layout, content, identity="x", workers=1) as writer:  # and never completed
        for number in range(3):
            writer.add("train", make_episode(number))
        writer._settle(0)
    assert not path.exists()
    journal = tmp_path / ".partial-set" / "journal.jsonl"
    journal.write_text(journal.read_text()[:-10])  # killed while the line of the third episode was written
    with LeRobotWriter(path, layout, content, identity="x", workers=2) as writer:
        assert (writer.resumed("train"), writer.resumed("val")) == (2, 0)
        writer.add("train", make_episode(2))
        writer.add("train", make_episode(3))
        writer.add("val", make_episode(4))
        writer.complete({"README.md": "made by a test"})
    assert not (tmp_path / ".partial-set").exists()
    files = [file.relative_to(version_30) for file in version_30.rglob("*") if file.is_file()]
    assert sorted(files) == sorted(file.relative_to(path) for file in path.rglob("*") if file.is_file())
    for file in files:
        assert (path / file).read_bytes() == (version_30 / file).read_bytes(), file


def test_a_folder_that_is_no_dataset_is_never_replaced(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    about = replace(ABOUT, features=replace(FEATURES, depth=(), segmentation=()))
    with (
        pytest.raises(RecorderError, match="is not a dataset of this format") as caught,
        LeRobotFormat().create(tmp_path, about, LeRobotOptions(), identity="", overwrite=True),
    ):
        pass
    assert caught.value.code == ErrorCode.EXPORT_REFUSED


def test_what_the_format_cannot_hold_is_refused():
    with pytest.raises(InvalidRequestError, match="whole number of steps per second, got 12.5"):
        layout_of(replace(ABOUT, fps=12.5), content_of(ABOUT, LeRobotOptions()), LeRobotOptions())
    with pytest.raises(InvalidRequestError, match="GR00T reads version 2.1"):
        LeRobotOptions(columns="groot")
    odd = replace(FEATURES, cameras={**FEATURES.cameras, "top": ImageSize(height=25, width=32)})
    about = replace(ABOUT, features=odd)
    with pytest.raises(InvalidRequestError, match="even width and height, got 32 x 25 px"):
        layout_of(about, content_of(about, LeRobotOptions()), LeRobotOptions())


def test_a_damaged_video_is_named(version_30, tmp_path):
    path = tmp_path / "set"
    shutil.copytree(version_30, path)
    video = next(path.rglob("observation.images.top/**/*.mp4"))
    video.write_bytes(video.read_bytes()[:200])
    with pytest.raises(RecorderError, match="observation.images.top") as caught:
        list(open_dataset(path).episode(0).steps(["top"]))
    assert caught.value.code == ErrorCode.BAG_DAMAGED


def test_a_step_has_the_nearest_frame_of_a_video_of_another_rate(tmp_path):
    path, writers, decoder = tmp_path / "v.mp4", VideoWriters(1), VideoDecoder()
    video = writers.open(path, codec="h264", rate=Fraction(30), height=32, width=32)
    for number in range(16):
        video.add(np.full((32, 32, 3), 15 * number, np.uint8))
    video.close().result()
    writers.close()
    for rate, begin_s in ((10, Fraction(0)), (10, Fraction(8, 30)), (20, Fraction(4, 30))):
        times = [begin_s + Fraction(step, rate) for step in range(int((Fraction(1, 2) - begin_s) * rate) + 1)]
        found = decoder.frames(path, rate=Fraction(rate), first=begin_s * rate, count=len(times))
        nearest = [min(range(16), key=lambda frame, time=time: abs(Fraction(frame, 30) - time)) for time in times]
        assert [round(float(image.mean()) / 15) for image in found] == nearest
    with pytest.raises(RecorderError, match="ends 2 frames early, expected 3 from 0.5 s on"):
        list(decoder.frames(path, rate=Fraction(10), first=Fraction(5), count=3))
    with pytest.raises(RecorderError, match=r"the frame at 0.01667 s is missing; the nearest one is at 0 s"):
        list(decoder.frames(path, rate=Fraction(60), first=Fraction(0), count=3))
    decoder.close()


def test_depth_and_segmentation_are_compared_between_formats(tmp_path: Path) -> None:
    write(tmp_path / "a", images=True)
    a = open_dataset(tmp_path / "a")
    b = open_dataset(write_dataset(plan_of(a), tmp_path / "b", "hdf5", None, how="convert").path)
    assert compare(a, b).equal
    real = b.read
    changes = {
        "depth of camera 'wrist' from step 0: 1 mm apart": lambda step: replace(
            step, depth={camera: rows + np.float32(0.001) for camera, rows in step.depth.items()}
        ),
        "segmentation of camera 'wrist' from step 0: other bodies": lambda step: replace(
            step, segmentation={camera: rows + 1 for camera, rows in step.segmentation.items()}
        ),
    }
    for text, change in changes.items():

        def edited(split: str, index: int, change=change) -> Episode:
            episode = real(split, index)
            return replace(episode, read=lambda wanted: map(change, episode.read(wanted)))

        b.read = edited
        assert text in str(compare(a, b).differences[0])


def test_writing_videos_takes_no_real_time_priority(tmp_path):
    """The AV1 encoder takes it as root, and then keeps every other process from the cores."""
    script = (
        "import os, sys\nfrom fractions import Fraction\nfrom roboxim_datasets.video.worker import Encoding\n"
        "video = Encoding(sys.argv[1], codec='av1', rate=Fraction(10), height=64, width=64)\n"
        "video.add(bytearray(64 * 64 * 3))\n"
        "print({os.sched_getscheduler(int(thread)) for thread in os.listdir('/proc/self/task')})\nvideo.close()"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "v.mp4")], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.strip() == str({os.SCHED_OTHER})
