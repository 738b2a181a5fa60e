"""The words of the step at hand: every format holds them beside the instruction, and they survive conversions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roboxim_datasets.compare import compare
from roboxim_datasets.episode import Episode, Step, Wanted
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.dataset import RldsOptions

WHOLE = "Open the top drawer, then put the apple into it"
WORDS = ("Open the top drawer", "Put the apple into the top drawer")
FORMATS = {
    "rlds": ("rlds", RldsOptions(encoding="png")),
    "lerobot 3.0": ("lerobot", LeRobotOptions(images=True)),
    "lerobot 2.1": ("lerobot", LeRobotOptions(images=True, version="2.1")),
    "hdf5": ("hdf5", None),
}


def longer(episode: Episode) -> Episode:
    """Return an episode of two steps of a task; the first one ends after a frame."""

    def read(wanted: Wanted) -> Iterator[Step]:
        for step in episode.read(wanted):
            yield replace(step, subtask=WORDS[step.index > 0])

    return replace(episode, instruction=WHOLE, subtasks=WORDS, read=read)


@pytest.fixture
def source(tmp_path, write, episode_of, description):
    """Two episodes of a longer task, and one of a task of a single step."""
    described = replace(description, features=replace(description.features, subtasks=True))
    episodes = [longer(episode_of(0)), longer(episode_of(1, length=4)), episode_of(2)]
    return write(tmp_path / "source", train=episodes, description=described)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_holds_the_words_of_the_step_at_hand(name, source, tmp_path):
    format, options = FORMATS[name]
    made = open_dataset(write_dataset(plan_of(source), tmp_path / "made", format, options, how="convert").path)
    assert made.features.subtasks
    assert [e.instruction for e in made.episodes()] == [WHOLE, WHOLE, "Pick up cube 2"], "the whole sentence is kept"
    found = [[step.subtask for step in episode.steps(())] for episode in made.episodes()]
    assert found == [[WORDS[0], *WORDS[1:] * 2], [WORDS[0], *WORDS[1:] * 3], ["Pick up cube 2"] * 3]
    assert set(WORDS) <= set(made.episode(0).subtasks)
    back = open_dataset(write_dataset(plan_of(made), tmp_path / "back", "rlds", FORMATS["rlds"][1], how="convert").path)
    for other in (made, back):
        assert compare(source, other, images="exact").differences == []
    assert not made.account.left_out


def test_a_difference_of_subtasks_is_found(source, tmp_path, write, episode_of, description):
    plain = write(tmp_path / "plain", train=[replace(longer(episode_of(i)), instruction=WHOLE) for i in (0, 1)])
    found = [d.what for d in compare(source, plain, images="skip").differences]
    assert f"subtask from step 0: {WORDS[0]!r} against {WHOLE!r}" in found


def test_lerobot_has_the_names_that_its_package_reads(source, tmp_path):
    path = write_dataset(plan_of(source), tmp_path / "made", *FORMATS["lerobot 3.0"], how="convert").path
    table = pq.read_table(path / "meta" / "subtasks.parquet")
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["subtask"]
    assert table.to_pydict() == {"subtask_index": [0, 1, 2], "subtask": [*WORDS, "Pick up cube 2"]}
    rows = pq.read_table(path / "data" / "chunk-000" / "file-000.parquet", columns=["subtask_index", "task_index"])
    assert rows.to_pydict() == {"subtask_index": [0, 1, 1, 0, 1, 1, 1, 2, 2, 2], "task_index": [0] * 7 + [1] * 3}
    feature = json.loads((path / "meta" / "info.json").read_text())["features"]["subtask_index"]
    assert feature == {"dtype": "int64", "shape": [1], "names": None}


def test_steps_of_another_tools_dataset_may_state_none(source, tmp_path):
    """Annotators write -1 where no subtask was marked."""
    path = write_dataset(plan_of(source), tmp_path / "made", *FORMATS["lerobot 3.0"], how="convert").path
    file = path / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    at = table.schema.get_field_index("subtask_index")
    pq.write_table(table.set_column(at, "subtask_index", pa.array(np.full(len(table), -1))), file)
    assert [step.subtask for step in open_dataset(path).episode(0).steps(())] == [None] * 3


def test_datasets_of_single_steps_have_no_such_column(tmp_path, write):
    for name, (format, options) in FORMATS.items():
        source = write(tmp_path / name / "from", train=[0, 1])
        made = open_dataset(write_dataset(plan_of(source), tmp_path / name / "to", format, options, how="convert").path)
        texts = [p for p in Path(made.path).rglob("*.*") if p.is_file() and b"subtask" in p.read_bytes()]
        assert (made.features.subtasks, texts) == (False, [])
