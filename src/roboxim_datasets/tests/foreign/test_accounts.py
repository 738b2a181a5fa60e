"""The account of a dataset: what was read, implied and left out is everything that is there."""

from __future__ import annotations

import tempfile
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_foreign import EPISODES, STEPS, hdf5, lerobot30, rlds

from roboxim_core.errors import RoboximError
from roboxim_datasets.account import Account
from roboxim_datasets.formats import open_dataset

NAMES = st.sampled_from(["obs/a", "obs/b/c", "obs/d_image", "obs/e_depth", "states", "next_obs/a", "deep/er/still"])
SHAPES = st.sampled_from([(), (1,), (3,), (4, 4), (8, 8, 1), (8, 8, 3), (2000,)])
TYPES = st.sampled_from(["f4", "f8", "i8", "u1", "S3", "?"])
ARRAYS = st.dictionaries(NAMES, st.tuples(SHAPES, TYPES, st.integers(0, 5)), max_size=5)
FAST = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))


def numbers(account: Account, kind: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for part in account.parts:
        if part.kind == kind:
            found[part.name] = found.get(part.name, 0) + part.count
    return found


@FAST
@given(st.lists(ARRAYS, min_size=1, max_size=3))
def test_every_array_of_an_hdf5_file_is_accounted_for(demos: list[dict[str, tuple[tuple[int, ...], str, int]]]) -> None:
    with tempfile.TemporaryDirectory() as place:
        expected: dict[str, int] = {}
        with h5py.File(Path(place) / "data.hdf5", "w") as file:
            for number, arrays in enumerate(demos):
                group = file.create_group(f"data/demo_{number}")
                for name, (shape, kind, length) in {"actions": ((7,), "f4", 3), **arrays}.items():
                    group[name] = np.ones((length, *shape), kind)
                    expected[name] = expected.get(name, 0) + length
        dataset = open_dataset(place)
        held = numbers(dataset.account, "key")
        assert held == {name: count for name, count in expected.items() if count}
        assert set(numbers(dataset.account, "episode")) == {f"demo_{number}" for number in range(len(demos))}
        lost = {part.name for part in dataset.account.left_out if part.kind == "episode"}
        assert len(dataset) + len(lost) == len(demos)
        read = sum(episode.length for episode in dataset.episodes())
        assert read == sum(p.count for p in dataset.account.parts if (p.name, p.treatment) == ("actions", "read"))


@pytest.mark.thorough
@FAST
@given(st.lists(st.integers(0, EPISODES), min_size=EPISODES * STEPS, max_size=EPISODES * STEPS), st.text(max_size=8))
def test_every_row_and_column_of_a_lerobot_dataset_is_accounted_for(episodes: list[int], split: str) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = lerobot30(Path(place) / "d", splits={"train": "0:1", split: "1:2", "far": "5:1000000000"})
        file = folder / "data/chunk-000/file-000.parquet"
        table = pq.read_table(file).append_column("extra", pa.array(["x"] * len(episodes)))
        at = table.column_names.index("episode_index")
        pq.write_table(table.set_column(at, "episode_index", pa.array(episodes)), file)
        dataset = open_dataset(folder)
        rows = numbers(dataset.account, "row")
        assert sum(rows.values()) == len(episodes)
        assert numbers(dataset.account, "key") == dict.fromkeys(table.column_names, len(episodes))
        for number in range(EPISODES):  # an episode whose rows are others than the table says is never read
            if episodes.count(number) != STEPS:
                place = next(p for places in dataset.meta.splits.values() for p in places if p.number == number)
                with pytest.raises(RoboximError, match=f"episode {number}: .* rows, but the table"):
                    dataset._rows(place, ["action"])


def test_what_a_reader_says_nothing_of_is_left_out() -> None:
    account = Account()
    account.holds("key", "a", 5)
    account.reads("key", "a", 3)
    assert [(part.treatment, part.count) for part in account.parts] == [("read", 3), ("left out", 2)]


def test_every_feature_of_an_rlds_record_is_accounted_for(tmp_path: Path) -> None:
    dataset = open_dataset(rlds(tmp_path / "bridge" / "1.0.0"))
    steps = 3 * STEPS
    keys = (
        "action",
        "reward",
        "language_instruction",
        "is_first",
        "observation/image",
        "observation/state",
        "observation/pose",
    )
    assert numbers(dataset.account, "key") == {f"steps/{key}": steps for key in keys}
    assert [part.name for part in dataset.account.left_out] == ["steps/observation/pose"]
    assert numbers(dataset.account, "metadata") == {"episode_metadata/episode_id": 3}


def test_masks_and_observations_of_hdf5_are_read_or_named(tmp_path: Path) -> None:
    folder = hdf5(tmp_path / "a")
    with h5py.File(folder / "data.hdf5", "r+") as file:
        file["mask/20_percent"] = np.array([b"demo_0"])
        del file["data/demo_1/actions"]
    dataset = open_dataset(folder)
    assert dict(dataset.splits) == {"train": 1, "val": 1}
    assert dataset.features.vectors.keys() == {"eef_pos", "gripper"}
    left_out = {part.name: part.why for part in dataset.account.left_out}
    assert left_out["demo_1"] == "it has no 'actions'"
    assert "not one of train" in left_out["mask/20_percent"]
    states = [part.why for part in dataset.account.left_out if part.name == "states"]
    assert any("not an observation" in why for why in states)
