"""The RLDS format: written and read back, resumed, refused, damaged."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_core.vision.images import encode_image
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures, RldsReader
from roboxim_datasets.rlds.tfrecord import decode_example, encode_example
from roboxim_datasets.rlds.writer import RldsWriter

FEATURES = RldsFeatures(
    images={"image": (16, 24)},
    encoding="png",
    metadata={"episode_id": "text", "index": "int64", "success": "bool"},
    vectors={"state": 10, "joint_positions": 6},
    signals={"action_executed": 7},
)


def make_episode(index: int, steps: int = 5) -> RldsEpisode:
    rng = np.random.default_rng(index)
    return RldsEpisode(
        images={"image": [encode_image(rng.integers(0, 255, (16, 24, 3), np.uint8), "png") for _ in range(steps)]},
        vectors={
            "state": rng.normal(size=(steps, 10)).astype(np.float32),
            "joint_positions": rng.normal(size=(steps, 6)).astype(np.float32),
        },
        action=rng.normal(size=(steps, 7)).astype(np.float32),
        signals={"action_executed": rng.normal(size=(steps, 7)).astype(np.float32)},
        instruction=f"Pick up cube {index}",
        reward=np.eye(steps, dtype=np.float32)[-1],
        metadata={"episode_id": f"e{index}", "index": -index, "success": index % 2 == 0},
    )


def make_writer(folder: Path, **options: object) -> RldsWriter:
    return RldsWriter(folder, FEATURES, name="cubes", version="1.0.0", description="", **options)  # type: ignore[arg-type]


def test_episodes_come_back_as_they_were_written(tmp_path: Path) -> None:
    with make_writer(tmp_path, shard_bytes=6000) as writer:
        for index in range(5):
            writer.add("train", make_episode(index))
        writer.add("val", make_episode(9, steps=1))
    reader = RldsReader(tmp_path)
    assert reader.features == FEATURES
    assert len(reader.splits["train"]) > 1, "the small shard size must give several shards"
    assert (reader.count("train"), reader.count("val"), reader.count("test")) == (5, 1, 0)
    for index, episode in enumerate(reader.episodes("train")):
        expected = make_episode(index)
        for name in ("action", "reward"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(expected, name))
        for kind in ("vectors", "signals"):
            assert getattr(episode, kind).keys() == getattr(expected, kind).keys()
            for name, values in getattr(expected, kind).items():
                np.testing.assert_array_equal(getattr(episode, kind)[name], values)
        np.testing.assert_array_equal(episode.frames("image"), expected.frames("image"))
        assert episode.instruction == expected.instruction
        assert episode.metadata == expected.metadata


def test_same_episodes_give_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        with make_writer(tmp_path / folder) as writer:
            writer.add("train", make_episode(0))
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 3
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def interrupt_after_one(folder: Path) -> None:
    with contextlib.suppress(KeyboardInterrupt), make_writer(folder, identity="x", shard_bytes=1) as writer:
        writer.add("train", make_episode(0))
        raise KeyboardInterrupt


def test_interrupted_build_leaves_nothing_and_goes_on(tmp_path: Path) -> None:
    interrupt_after_one(tmp_path)
    with pytest.raises(RecorderError, match="0 datasets"):
        RldsReader(tmp_path)
    with make_writer(tmp_path, identity="x", shard_bytes=1) as writer:
        assert writer.resumed("train") == 1
        writer.add("train", make_episode(1))
    assert [e.metadata["episode_id"] for e in RldsReader(tmp_path).episodes("train")] == ["e0", "e1"]


def test_another_identity_starts_afresh(tmp_path: Path) -> None:
    interrupt_after_one(tmp_path)
    assert make_writer(tmp_path, identity="y").resumed("train") == 0


def test_existing_data_set_is_refused_unless_overwritten(tmp_path: Path) -> None:
    with make_writer(tmp_path) as writer:
        writer.add("train", make_episode(0))
    with pytest.raises(RecorderError, match="exists") as caught:
        make_writer(tmp_path)
    assert caught.value.code == ErrorCode.EXPORT_REFUSED
    with make_writer(tmp_path, overwrite=True) as writer:
        writer.add("train", make_episode(3))
    assert [e.metadata["episode_id"] for e in RldsReader(tmp_path).episodes("train")] == ["e3"]


def test_damage_is_named(tmp_path: Path) -> None:
    with make_writer(tmp_path) as writer:
        writer.add("train", make_episode(0))
    shard = next(tmp_path.rglob("*.tfrecord-*"))
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(RecorderError, match="record 0 is damaged") as caught:
        list(RldsReader(tmp_path).episodes("train"))
    assert caught.value.code == ErrorCode.BAG_DAMAGED


@pytest.mark.parametrize("name", ["Cubes", "a-b", ""])
def test_names_that_tfds_refuses_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidRequestError, match="lower case"):
        RldsWriter(tmp_path, FEATURES, name=name, version="1.0.0", description="")


def test_nan_action_is_refused(tmp_path: Path) -> None:
    episode = make_episode(0)
    episode.action[2, 3] = np.nan
    with pytest.raises(InvalidRequestError, match="action must be finite"):
        make_writer(tmp_path).add("train", episode)


def test_example_holds_every_kind_of_list() -> None:
    example = {
        "b": [b"", b"x" * 300],
        "f": np.array([1.5, -2], np.float32),
        "i": np.array([-1, 2**40], np.int64),
    }
    found = decode_example(encode_example(example))
    assert found["b"] == example["b"]
    np.testing.assert_array_equal(found["f"], example["f"])
    np.testing.assert_array_equal(found["i"], example["i"])
