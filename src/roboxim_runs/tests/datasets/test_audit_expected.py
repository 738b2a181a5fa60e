"""What an audit expects of a dataset whose episodes come from several runs and exports."""

from __future__ import annotations

import pytest
from made_up_episodes import FakeEpisode

from roboxim_datasets.formats import open_dataset
from roboxim_recorder.export import export_bags
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit_expected import expected_of_bags
from roboxim_runs.datasets.export import Hdf5Config
from roboxim_runs.datasets.rewriting import merge_datasets


@pytest.fixture
def runs(tmp_path):
    """Return two runs of two made-up episodes each; both have an episode of the same id."""
    for run, episodes in {"a": (0, 1), "b": (2, 0)}.items():
        for index in episodes:
            FakeEpisode(index=index, steps=5 + index + 4 * (run == "b")).record(tmp_path / run)
    return tmp_path / "a", tmp_path / "b"


def exported(runs, out, **options):
    return export_bags("hdf5", runs, out, Hdf5Config(val_fraction=0, **options)).path


def require_as_expected(path, runs):
    dataset, bags = open_dataset(path), {}
    for bag in (bag for run in runs for bag in list_bags(run)):
        bags.setdefault(bag.name, []).append(bag)
    expected = expected_of_bags(dataset, bags)
    for number in range(len(dataset)):
        episode = dataset.episode(number)
        made = expected.find(episode, "")
        assert (len(made), made.instruction) == (len(episode), episode.instruction)
        for wanted, step in zip(made.steps(()), episode.steps(()), strict=True):
            assert wanted.action.tolist() == step.action.tolist()


def test_each_export_of_a_merge_is_expected_by_its_own_settings(runs, tmp_path):
    first = exported(runs[0], tmp_path / "x", where=("episode=demo-0-00001-0",))
    other = exported(runs[1], tmp_path / "y", where=("relabel demo-0-00002-0 Wave", "trim demo-0-00000-0 1..3"))
    require_as_expected(merge_datasets([first, other], tmp_path / "z").path, runs)


def test_episodes_of_one_id_are_compared_with_their_own_bags(runs, tmp_path):
    require_as_expected(exported(runs, tmp_path / "x"), runs)


@pytest.mark.parametrize("options", [{"per_cell": 3}, {"split": {"train": 1, "val": 1}}])
def test_the_episodes_that_counts_choose_do_not_depend_on_the_order_of_the_bags_given(runs, tmp_path, options):
    dataset = open_dataset(exported(runs, tmp_path / "x", **options))
    ids = {dataset.episode(number).episode_id for number in range(len(dataset))}
    for order in (runs, runs[::-1]):
        bags = {}
        for bag in (bag for run in order for bag in list_bags(run)):
            bags.setdefault(bag.name, []).append(bag)
        assert expected_of_bags(dataset, bags).unclaimed == ids
