"""Which bags an export takes, and how it counts them."""

from __future__ import annotations

import json

import pytest

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.where import Condition
from roboxim_recorder.export.selection import Selection, choose, splits
from roboxim_recorder.run_bags import run_bags


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake):
    """Eight episodes of two cells: five of A, of which one failed and one recovered, and three of B."""
    folder = tmp_path_factory.mktemp("run")
    for index in range(8):
        cell = "B" if index % 3 == 2 or index == 7 else "A"
        outcome = "failure" if index == 3 else "success"
        episode = fake(index=index, cell=cell, color="blue" if cell == "B" else "red", steps=3 + index, outcome=outcome)
        episode.record(folder, recovered=index == 1)
    return folder


def indices(chosen):
    return {split: [source.info.index for source in sources] for split, sources in chosen.splits.items()}


def chosen(run, **options):
    return choose([run_bags(run)], Selection(**{"val_fraction": 0.0, "uneven": True, **options}))


def test_cells_of_different_size_are_refused_unless_asked_for(run):
    with pytest.raises(RecorderError, match=r"different numbers of episodes \(A: 2?.*--per-cell.*--uneven") as caught:
        chosen(run, uneven=False, keep_recovered=True, where=("index<7",))
    assert caught.value.code == ErrorCode.EXPORT_REFUSED
    assert indices(chosen(run)) == {"train": [0, 2, 4, 5, 6, 7]}
    assert chosen(run).cells == {"train": {"A": 3, "B": 3}}


def test_per_cell_counts_after_all_filters(run):
    found = chosen(run, per_cell=2, where=("index!=0",))
    assert indices(found) == {"train": [2, 4, 5, 6]}
    assert found.left_out == {"not index!=0": 1, "recovered": 1, "not_lifted": 1, "more than per_cell": 1}
    with pytest.raises(RecorderError, match=r"fewer episodes after all filters: A: 3 of 4, B: 3 of 4$"):
        chosen(run, per_cell=4)


def test_cells_may_have_their_own_numbers(run):
    assert chosen(run, per_cell=1, cell_counts={"A": 2}).cells == {"train": {"A": 2, "B": 1}}
    with pytest.raises(RecorderError, match=r"after all filters: A: 3 of 5$"):
        chosen(run, per_cell=1, cell_counts={"A": 5})
    with pytest.raises(InvalidRequestError, match="need per_cell"):
        Selection(cell_counts={"a": 2})


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        (("target.color=blue",), [2, 5, 7]),
        (("target.color!=blue", "steps>=9"), [6]),
        (("steps<6",), [0, 2]),
        (("cell=A,B", "index=4,5"), [4, 5]),
        (("instruction=Pick*cube",), [0, 2, 4, 5, 6, 7]),
        (("outcome=failure",), [3]),
        (("recovered=true",), [1]),
        (("object=cube", "camera=wrist"), [0, 2, 4, 5, 6, 7]),
    ],
)
def test_conditions(run, where, expected):
    assert indices(chosen(run, where=where)) == {"train": expected}


def test_conditions_that_nothing_meets_are_refused_with_what_there_is(run):
    with pytest.raises(InvalidRequestError, match=r"no episode has 'target.colour'; did you mean 'target.color'"):
        chosen(run, where=("target.colour=red",))
    with pytest.raises(InvalidRequestError, match=r"no episode has target.color=blu; .*blue.*did you mean 'blue'"):
        chosen(run, where=("target.color=blu",))
    for text in ("target.color", "=red", "steps<few", "steps<nan", "steps<"):
        with pytest.raises(InvalidRequestError, match="condition"):
            Condition.parse(text)
    expected = r"none of the 8 bags can be exported \(not steps>100: 6, recovered: 1, not_lifted: 1\); change the cond"
    with pytest.raises(RecorderError, match=expected):
        chosen(run, where=("steps>100",))


@pytest.mark.parametrize("count", [2, 4])
def test_shards_one_after_the_other_are_the_whole(run, count):
    whole, joined = indices(chosen(run, val_fraction=0.34)), {}
    for number in range(1, count + 1):
        part = chosen(run, val_fraction=0.34, shard=f"{number}/{count}")
        for split, found in indices(part).items():
            joined.setdefault(split, []).extend(found)
        assert part.left_out["other shards"] == 6 - len(part.sources)
    assert joined == whole
    assert set(whole) == {"train", "val"}


def test_a_shard_without_an_episode_is_refused(run):
    with pytest.raises(RecorderError, match="shard 1/9 has no episode: only 6 can be exported"):
        chosen(run, shard="1/9")
    with pytest.raises(ConfigError, match="a shard is I/N with I from 1 to N"):
        Selection(shard="3/2")


def test_splits_have_the_counts_asked_for_and_are_spread_over_the_cells(run):
    found = chosen(run, split={"train": 4, "val": 2})
    assert {split: sum(cells.values()) for split, cells in found.cells.items()} == {"train": 4, "val": 2}
    assert found.cells["val"] == {"A": 1, "B": 1}
    found = chosen(run, split={"val": 1, "train": 2})
    assert found.left_out["more than split"] == 3
    assert sum(map(len, chosen(run, split={"test": 2, "train": 0}).splits.values())) == 6
    with pytest.raises(RecorderError, match="6 episodes pass the filters, not enough for the splits train=7"):
        chosen(run, split={"train": 7})
    with pytest.raises(InvalidRequestError, match="unknown split 'valid'; .*did you mean 'val'"):
        Selection(split={"valid": 1})
    assert splits(4, 0.05) == ["train", "train", "train", "val"]


def test_several_runs_are_one_export_and_an_episode_counts_once(run, tmp_path, fake):
    fake(index=20, cell="A").record(tmp_path / "other")
    found = choose([run_bags(run), run_bags(tmp_path / "other")], Selection(uneven=True, val_fraction=0.0))
    assert indices(found) == {"train": [0, 2, 4, 5, 6, 7, 20]}
    with pytest.raises(RecorderError, match="hold the same episode; give each run once"):
        choose([run_bags(run), run_bags(run)], Selection(uneven=True))


def test_a_convention_excludes_the_options_that_it_says():
    with pytest.raises(InvalidRequestError, match="actions and rate; leave out actions, rate_hz"):
        Selection(convention="libero", actions="rotation_6d", rate_hz=5)


def test_the_dataset_says_what_was_chosen(run, tmp_path):
    from roboxim_recorder.export import export_bags
    from roboxim_recorder.export.rlds import ExportConfig

    report = export_bags("rlds", [run], tmp_path, ExportConfig(per_cell=3, val_fraction=0.0))
    facts = json.loads((report.path / "export.json").read_text())
    assert facts["cells"] == {"train": {"A": 3, "B": 3}} == report.cells
    assert facts["runs"] == [run.name]
