"""Objects that an experiment draws from a set: by seed, nested, held out as a whole, refused where they cannot be."""

from collections import Counter

import pytest
import yaml

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import experiment_config
from roboxim_eval.experiments.cells import cells_of, chosen
from roboxim_eval.experiments.rotation import held_out_sets, rotated

SHAPES = [f"shape_{number:02d}" for number in range(40)]


@pytest.fixture(autouse=True)
def objects(tmp_path, monkeypatch):
    folder = tmp_path / "objects" / "forms"
    folder.mkdir(parents=True)
    for name in SHAPES:
        (folder / f"{name}.yaml").write_text("name: it\n")  # only names are read
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))


def experiment(draw, scale="full", **keys):
    text = f"""
about: Unseen objects?
factors: {{task: [pick_up], target: {{draw: {draw}}}}}
datasets: {{leave_out: {{cells: seen, per_cell: 4}}, baseline: {{per_cell: 3}}}}
conditions: {{leave_out: {{train: leave_out}}, baseline: {{train: baseline}}}}
trainers: {{external: {{}}}}
compare: [{{first: leave_out, second: baseline, where: unseen, primary: true}}]
scales: {{smoke: {{factors: {{target: {{draw: {{count: 4}}}}}}}}}}
"""
    return experiment_config({**yaml.safe_load(text), **keys}, scale=scale)


def levels(config, where="all"):
    return [cell.levels["target"] for cell in chosen(cells_of(config), where)]


def test_a_draw_is_a_function_of_its_seed_and_a_larger_one_contains_a_smaller():
    drawn = experiment("{set: forms, count: 12, hold_out: 3, seed: 1}")
    again = experiment("{set: forms, count: 12, hold_out: 3, seed: 1}")
    other = experiment("{set: forms, count: 12, hold_out: 3, seed: 2}")
    larger = experiment("{set: forms, count: 30, hold_out: 3, seed: 1}")
    assert levels(drawn) == levels(again) != levels(other)
    assert len(set(levels(drawn))) == 12
    assert set(levels(drawn)) < set(levels(larger)) <= set(SHAPES)
    assert levels(drawn, "unseen") == levels(larger, "unseen")
    assert len(levels(drawn, "unseen")) == 3


def test_a_scale_changes_the_number_alone():
    drawn = experiment("{set: forms, count: 12, hold_out: 3, seed: 1}")
    small = experiment("{set: forms, count: 12, hold_out: 3, seed: 1}", scale="smoke")
    assert (len(levels(small)), levels(small, "unseen")) == (4, levels(drawn, "unseen"))


def test_held_out_cells_of_the_file_stay_held_out():
    first = levels(experiment("{set: forms, count: 5, hold_out: 1}"))
    more = experiment("{set: forms, count: 5, hold_out: 1}", unseen=[{"target": first[-1]}])
    assert set(levels(more, "unseen")) == {first[0], first[-1]}


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        ("{set: form, count: 3}", "did you mean 'forms'"),
        ("{set: forms, count: 41}", "40 objects"),
        ("{set: forms, count: 3, hold_out: 3}", "hold_out < count"),
        ("{set: forms, number: 3}", "number"),
        ("{set: forms, count: 3}, cube: {}", "draw stands alone"),
    ],
)
def test_a_draw_that_cannot_be_is_refused_with_its_place(draw, said):
    with pytest.raises(ConfigError, match=said) as caught:
        experiment(draw)
    assert "factors.target" in str(caught.value)


def test_objects_alone_rotate_in_disjoint_groups_of_which_each_is_wholly_held_out():
    config = experiment("{set: forms, count: 12, hold_out: 3, seed: 1}")
    found = held_out_sets(cells_of(config), sets=4, held_out=3)
    assert Counter(cell.levels["target"] for one in found for cell in one) == Counter(levels(config))
    parts = rotated(config, sets=4, held_out=3)
    assert [len(levels(part, "unseen")) for part in parts] == [3, 3, 3, 3]
    assert {name for part in parts for name in levels(part, "unseen")} == set(levels(config))
