"""Parts of others' datasets that are easily misread: pixels without a value, steps without words, other splits."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from roboxim_datasets.compare import compare
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot.content import LeRobotOptions
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.format import RldsEpisode, RldsFeatures
from roboxim_datasets.rlds.writer import RldsWriter

STEPS = 4


def rlds(folder, split="train", instructions=()):
    """Write an episode as another tool would."""
    episode = RldsEpisode(
        images={}, vectors={"state": np.zeros((STEPS, 3), np.float32)}, instruction="pick up the cup",
        action=np.arange(STEPS * 7, dtype=np.float32).reshape(STEPS, 7), reward=np.zeros(STEPS, np.float32),
    )  # fmt: skip
    features = RldsFeatures(images={}, vectors={"state": 3})
    with RldsWriter(folder, features, name="play", version="1.0.0", description="x") as writer:
        writer.add(split, replace(episode, instructions=instructions))
    return open_dataset(folder)


def test_depth_below_zero_has_no_value_in_lerobot(tmp_path):
    with h5py.File(tmp_path / "others.hdf5", "w") as file:
        group = file.create_group("data/demo_0")
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 10}})
        group["actions"] = np.zeros((STEPS, 7), np.float32)
        group["obs/front_image"] = np.random.default_rng(0).integers(0, 255, (STEPS, 64, 64, 3), np.uint8)
        depth = np.full((STEPS, 64, 64), 1200, np.int16)
        depth[:, 0, :3] = [-1, 0, 9000]
        group["obs/front_depth"] = depth
    source = open_dataset(tmp_path / "others.hdf5", depth_unit_m=0.001)
    written = write_dataset(plan_of(source), tmp_path / "out", "lerobot", LeRobotOptions(images=True), how="convert")
    (episode,) = open_dataset(written.path).episodes()
    first = next(iter(episode.steps((), depth=("front",)))).depth["front"]
    np.testing.assert_allclose(first[0, :4], [0, 0, 0, 1.2], atol=1e-4)


@pytest.mark.parametrize("format", ["lerobot", "hdf5", "rlds"])
def test_a_step_without_words_stays_without(tmp_path, format):
    words = ("pick up the cup", "pick up the cup", "", "")
    source = rlds(tmp_path / "a", instructions=words)
    written = open_dataset(write_dataset(plan_of(source), tmp_path / "b", format, how="convert", fps=10).path)
    (episode,) = written.episodes()
    assert tuple(map(episode.words, episode.steps(()))) == words
    other = rlds(tmp_path / "c", instructions=("pick up the cup",) * STEPS)
    assert any("instruction from step 2: '' against" in one.what for one in compare(source, other).differences)


@pytest.mark.parametrize("format", ["lerobot", "hdf5", "rlds"])
def test_a_split_of_another_name_is_converted(tmp_path, format):
    source = rlds(tmp_path / "a", split="validation")
    written = open_dataset(write_dataset(plan_of(source), tmp_path / "b", format, how="convert", fps=10).path)
    assert written.splits == {"validation": 1}
