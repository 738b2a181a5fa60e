"""Opening a dataset of any format: found by its files, read lazily, refused with a reason."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError
from roboxim_core.vision.images import encode_image
from roboxim_datasets.card import card, count
from roboxim_datasets.dataset import Description, Features
from roboxim_datasets.episode import Episode, ImageSize, Step, Wanted
from roboxim_datasets.formats import FORMATS, open_dataset
from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_datasets.lerobot.content import content_of, layout_of
from roboxim_datasets.lerobot.modality import modality
from roboxim_datasets.rewrite import options_like
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures, RldsWriter
from roboxim_datasets.rlds.dataset import RldsFormat, RldsOptions
from roboxim_datasets.rlds.loader_files import loading_text

ACTION = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
VECTORS = {"state": ("tcp.x", "tcp.y"), "joints": ("j0.position",)}
SIGNALS = {"sim.action_executed": ACTION, "sim.force": ("force.z",)}
DESCRIPTION = Description(
    features=Features(
        cameras={"workspace": ImageSize(height=8, width=12)},
        keys={"workspace": "image"},
        action=ACTION,
        vectors=VECTORS,
        signals=SIGNALS,
    ),
    fps=10.0,
    robot="panda",
)


def episode_of(index: int, length: int = 3) -> Episode:
    def read(wanted: Wanted):
        rng = np.random.default_rng(index)
        for at in range(length):
            image = rng.integers(0, 255, (8, 12, 3), np.uint8)
            yield Step(
                index=at,
                images={camera: image for camera in wanted.cameras},
                proprio={name: rng.normal(size=len(names)).astype(np.float32) for name, names in VECTORS.items()},
                action=rng.normal(size=7).astype(np.float32),
                action_executed=rng.normal(size=7).astype(np.float32),
                signals={"sim.force": np.float32([at])},
                reward=float(at == length - 1),
            )

    ids = {"run_seed": 3, "index": index, "attempt": 0}
    texts = {name: name for name in ("file_path", "skill", "actor", "task", "final_state_hash")}
    return Episode(
        episode_id=f"demo-{index}", length=length, instruction=f"Pick up cube {index}", semantics=None,
        cameras=DESCRIPTION.features.cameras, success=True, robot="panda", vectors=VECTORS,
        signals={"sim.force": ("force.z",)}, metadata={**ids, **texts}, read=read,
    )  # fmt: skip


@pytest.fixture
def written(tmp_path: Path) -> Path:
    options = RldsOptions(encoding="png")
    with RldsFormat().create(tmp_path, DESCRIPTION, options, identity="", overwrite=False) as writer:
        for index in range(3):
            writer.add("train", episode_of(index, length=3 + index))
        writer.add("val", episode_of(9))
        writer.complete({"export.json": json.dumps({"format": "rlds"})})
    return tmp_path


def test_a_dataset_is_found_and_read_by_index(written: Path) -> None:
    dataset = open_dataset(written)
    assert (dataset.format, dict(dataset.splits), len(dataset)) == ("rlds", {"train": 3, "val": 1}, 4)
    assert dataset.facts == {"format": "rlds"}
    assert dataset.features.cameras == DESCRIPTION.features.cameras
    assert (dataset.features.vectors, dataset.features.signals["sim.force"]) == (VECTORS, ("force.z",))
    for index, expected in ((2, episode_of(2, length=5)), (0, episode_of(0)), (3, episode_of(9))):
        found = dataset.episode(index)
        for name in ("episode_id", "length", "instruction", "metadata"):
            assert getattr(found, name) == getattr(expected, name), name
        for a, b in zip(found.steps(), expected.steps(), strict=True):
            np.testing.assert_array_equal(a.images["workspace"], b.images["workspace"])
            np.testing.assert_array_equal(a.action, b.action)
            np.testing.assert_array_equal(a.action_executed, b.action_executed)
            np.testing.assert_array_equal(a.signals["sim.force"], b.signals["sim.force"])
            for name in VECTORS:
                np.testing.assert_array_equal(a.proprio[name], b.proprio[name])
    with pytest.raises(InvalidRequestError, match="no episode 4; there are 4, from 0: 3 in 'train', then 1 in 'val'"):
        dataset.episode(4)
    with pytest.raises(InvalidRequestError, match="no split 'vall'.*did you mean 'val'"):
        next(dataset.episodes("vall"))


def test_components_are_picked_by_name(written: Path) -> None:
    episode = open_dataset(written).episode(0)
    step = next(episode.steps(()))
    picked = episode.picker(("j0.position", "tcp.y"))(step)
    assert picked.tolist() == [step.proprio["joints"][0], step.proprio["state"][1]]
    with pytest.raises(ConfigError, match=r"no proprioception 'tcp.z'.*did you mean"):
        episode.picker(("tcp.z",))


def test_what_is_not_one_dataset_is_refused(written: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        open_dataset(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"holds no dataset.*rlds"):
        open_dataset(tmp_path / "empty")
    with RldsFormat().create(written, DESCRIPTION, RldsOptions(name="b"), identity="", overwrite=False) as writer:
        writer.add("train", episode_of(0))
        writer.complete({})
    with pytest.raises(ConfigError, match=r"holds 2 datasets; name one of .*b/1.0.0 \(rlds\)"):
        open_dataset(written)


def test_datasets_of_two_formats_in_one_folder_are_both_found(tmp_path: Path, write) -> None:
    write(tmp_path / "demos" / "rlds", [0])
    write(tmp_path / "demos" / "hdf5", [0], format="hdf5")
    for folder in (tmp_path, tmp_path / "demos"):
        with pytest.raises(ConfigError, match=r"holds 2 datasets; name one of .*hdf5 \(hdf5\), .*1.0.0 \(rlds\)"):
            open_dataset(folder)


def test_the_splits_of_rlds_and_the_card_say_what_the_statistics_are_of(tmp_path: Path) -> None:
    options = RldsOptions(encoding="png")
    with RldsFormat().create(tmp_path, DESCRIPTION, options, identity="", overwrite=False) as writer:
        for split, index in (("test", 0), ("train", 1), ("train", 2)):
            writer.add(split, episode_of(index))
        writer.complete({})
    dataset = open_dataset(tmp_path)
    assert list(dataset.splits) == ["train", "test"]
    assert json.loads((dataset.path / "dataset_statistics.json").read_text())["num_trajectories"] == 2
    assert "Of the split `train`" in card(dataset, count(dataset))


POSE = ACTION[:6]
X_VLA = (*POSE, "gripper", "unused", "unused")
BOTH_ARMS = ("left_arm.x", "left_gripper.pos", "right_arm.x", "right_gripper.pos")


@pytest.mark.parametrize(
    ("action", "kept", "parts"),
    [
        (ACTION, [6], {"end_effector": (0, 6), "gripper": (6, 7)}),
        (X_VLA, [6], {"end_effector": (0, 6), "gripper": (6, 7)}),
        (("gripper", *POSE), [0], {"gripper": (0, 1), "end_effector": (1, 7)}),
        (BOTH_ARMS, [1, 3], {"action": (0, 4)}),
        (tuple(f"action.{at}" for at in range(7)), [], {"action": (0, 7)}),
    ],
    ids=["last", "unused after it", "first", "two", "unnamed"],
)
def test_the_gripper_is_found_by_its_name(
    action: tuple[str, ...], kept: list[int], parts: dict[str, tuple[int, int]]
) -> None:
    """Trainers must not normalise it, and GR00T reads it as a part of its own."""
    about = replace(DESCRIPTION, features=replace(DESCRIPTION.features, action=action, signals={}))
    content = content_of(about, LeRobotOptions())
    found = modality(layout_of(about, content, LeRobotOptions()), content)["action"]
    assert {name: (part["start"], part["end"]) for name, part in found.items()} == parts
    features = RldsFeatures(images={"image": (8, 12)}, action={"steps/action": len(action)})
    mask = [at not in kept for at in range(len(action))]
    text = loading_text("a", "1.0.0", features, action)
    assert eval(text.partition("action_normalization_mask=")[2].partition(",\n")[0]) == mask
    assert ("must not be\nnormalised" in text) == bool(kept)


def test_every_registered_format_conforms() -> None:
    for name in FORMATS:
        FORMATS.check(name)


def test_a_dataset_of_another_tool_is_read(tmp_path: Path) -> None:
    """It has a feature of an unknown kind, no metadata, and says nothing of itself."""
    features = RldsFeatures(images={"image_0": (4, 4)}, encoding="png", vectors={"state": 3})
    episode = RldsEpisode(
        images={"image_0": [encode_image(np.full((4, 4, 3), i, np.uint8), "png") for i in range(2)]},
        vectors={"state": np.float32([[1, 2, 3], [4, 5, 6]])}, action=np.ones((2, 7), np.float32),
        instruction="push", reward=np.float32([0, 1]),
    )  # fmt: skip
    with RldsWriter(tmp_path, features, name="theirs", version="0.1.0", description="") as writer:
        writer.add("test", episode)
    file = next(tmp_path.rglob("features.json"))
    described = json.loads(file.read_text())
    described["featuresDict"]["features"].pop("episode_metadata")
    steps = described["featuresDict"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    steps["observation"]["featuresDict"]["features"]["camera_matrix"] = {
        "tensor": {"shape": {"dimensions": ["3", "3"]}, "dtype": "float32", "encoding": "none"}
    }
    file.write_text(json.dumps(described))
    dataset = open_dataset(tmp_path)
    found = dataset.episode(0)
    assert (dict(dataset.splits), found.instruction, found.semantics, found.success) == (
        {"test": 1},
        "push",
        None,
        True,
    )
    assert dataset.features.vectors == {"state": ("state.0", "state.1", "state.2")}
    assert list(dataset.features.cameras) == ["image_0"]
    assert next(found.steps()).proprio["state"].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "facts",
    [
        {"runs": 5}, {"runs": [1]}, {"robots": "ab", "config": {}}, {"config": [1]}, {"options": None},
        {"sources": [3]}, {"how": "merge", "sources": [{"sources": 1}]}, {"cells": {"train": 3}},
        {"not_read": ["x"]}, {"format": 1},
    ],
)  # fmt: skip
def test_an_export_json_of_another_tool_is_none_of_ours(written: Path, facts: dict) -> None:
    (written / "roboxim" / "1.0.0" / "export.json").write_text(json.dumps(facts))
    dataset = open_dataset(written)
    assert dataset.facts == {}
    assert dataset.description.robot == "panda"
    assert "not stated" in card(dataset, count(dataset))
    assert options_like(dataset).encoding == "png"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("cameras", "front, wrist"), ("cameras", "[1]"), ("joint_names", "j1 j2"), ("joint_names", 7),
        ("state_layout", "xyz"), ("vectors", "0.5"), ("action_semantics", "delta poses"), ("success", "maybe"),
        ("fps", "ten"),
    ],
)  # fmt: skip
def test_metadata_of_others_under_our_names_are_left_out_by_name(tmp_path: Path, key: str, value: str | int) -> None:
    kind = "int64" if isinstance(value, int) else "text"
    features = RldsFeatures(images={"image": (4, 4), "workspace": (4, 4)}, encoding="png", metadata={key: kind})
    picture = encode_image(np.zeros((4, 4, 3), np.uint8), "png")
    episode = RldsEpisode(
        images={"image": [picture], "workspace": [picture]}, vectors={}, action=np.ones((1, 7), np.float32),
        instruction="push", reward=np.zeros(1, np.float32), metadata={key: value},
    )  # fmt: skip
    with RldsWriter(tmp_path, features, name="theirs", version="1.0.0", description="") as writer:
        writer.add("train", episode)
    dataset = open_dataset(tmp_path)
    found = dataset.episode(0)
    assert (found.semantics, found.success, found.fps, found.joint_names) == (None, None, 0.0, ())
    assert list(found.cameras) == ["image", "workspace"]  # both, though 'image' is usually called 'workspace'
    assert [part.name for part in dataset.account.left_out if part.kind == "metadata"] == [f"episode_metadata/{key}"]


def test_a_damaged_record_is_named(written: Path) -> None:
    shard = next(written.rglob("*train.tfrecord-*"))
    data = bytearray(shard.read_bytes())
    data[-20] ^= 1
    shard.write_bytes(data)
    dataset = open_dataset(written)
    assert dataset.episode(0).episode_id == "demo-0"
    with pytest.raises(RecorderError, match="record 2 is damaged"):
        dataset.episode(2)
