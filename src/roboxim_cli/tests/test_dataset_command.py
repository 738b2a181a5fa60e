"""`roboxim dataset`: the commands on a small dataset."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from roboxim_cli.commands.data.dataset import command
from roboxim_core.errors import ConfigError
from roboxim_core.vision.images import encode_image
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures, RldsWriter


@pytest.fixture
def dataset(tmp_path):
    """A dataset of four episodes in one split, as another tool would write it."""
    features = RldsFeatures(images={"image": (16, 16)}, encoding="png", vectors={"state": 3}, metadata={"n": "int64"})
    rng = np.random.default_rng(0)
    with RldsWriter(tmp_path / "a", features, name="theirs", version="1.0.0", description="Theirs.") as writer:
        for number in range(4):
            episode = RldsEpisode(
                images={"image": [encode_image(rng.integers(0, 255, (16, 16, 3), np.uint8), "png")] * 2},
                vectors={"state": np.ones((2, 3), np.float32)}, action=np.ones((2, 7), np.float32),
                instruction=f"task {number}", reward=np.float32([0, 1]), metadata={"n": number},
            )  # fmt: skip
            writer.add("train", episode)
    return tmp_path / "a"


def run(*arguments, code=0):
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    assert result.exit_code == code, (result.output, result.exception)
    return result.output


def test_a_dataset_is_described_and_viewed(dataset, tmp_path):
    text = run("info", dataset)
    assert "4 train; 4 of 4 solved" in text
    assert "meaning not stated" in text
    assert run("info", dataset, "--card").startswith("---\nlicense")
    assert "task 2 (2 steps)" in run("view", dataset, "--episode", 2, "--out", tmp_path / "v.html")
    page = (tmp_path / "v.html").read_text()
    assert "<h1>task 2</h1>" in page
    assert page.count("<polyline") == 7 + 3
    assert page.count("data:image/jpeg") == 2
    assert "http" not in page  # it needs no network
    run("view", dataset, "--out", tmp_path / "v.png")
    assert (tmp_path / "v.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="--out must end in .html"):
        CliRunner().invoke(command, ["view", str(dataset), "--out", "v.gif"], catch_exceptions=False)


def test_no_dataset_is_written_into_the_folder_of_a_run(dataset, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    for words in (["convert", "rlds", dataset], ["merge", dataset], ["split", dataset, "--into", "train=3,val=0"]):
        said = f"run is the folder of 'roboxim generate', not of 'roboxim dataset {words[0]}'"
        with pytest.raises(ConfigError, match=said):
            CliRunner().invoke(command, [*map(str, words), "--out", str(tmp_path / "run")], catch_exceptions=False)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["run.json"]


def test_a_converted_copy_is_equal_and_a_divided_one_is_not(dataset, tmp_path):
    run("convert", "rlds", dataset, "--out", tmp_path / "c", "--encoding", "png", "--name", "mine")
    assert "EQUAL" in run("diff", dataset, tmp_path / "c", "--images", "exact")
    run("split", dataset, "--out", tmp_path / "s", "--into", "train=3,val=0")
    assert "splits: {'train': 4} against {'train': 3, 'val': 1}" in run("diff", dataset, tmp_path / "s", code=1)
    run("split", dataset, "--out", tmp_path / "apart", "--into", "train=3,val=0", "--apart")
    assert dict(open_dataset(tmp_path / "apart" / "val").splits) == {"train": 1}
    run("merge", tmp_path / "apart" / "train", tmp_path / "apart" / "val", "--out", tmp_path / "m")
    found = open_dataset(tmp_path / "m")
    assert {episode.instruction for episode in found.episodes()} == {f"task {n}" for n in range(4)}
    assert {episode.metadata["n"] for episode in found.episodes()} == {0, 1, 2, 3}
