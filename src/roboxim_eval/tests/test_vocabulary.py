"""What an experiment varies, in the words of other suites."""

from dataclasses import replace

import pytest
from planted_cards import shipped

from roboxim_eval.experiments.cells import cells_of
from roboxim_eval.experiments.config import ConditionConfig
from roboxim_eval.report.vocabulary import NEW_COMBINATION, NEW_OBJECT, NEW_PAIR, Names, vocabulary


def test_other_suites_have_no_name_for_missing_words_and_late_answers():
    design = shipped("robustness")
    found = {one.what: one.names for one in vocabulary(design.config, design.cells)}
    assert set(found) == set(design.config.conditions) - {"nominal"}, "every changed condition is named"
    assert found["no_words"] == found["late_2"] == Names()
    assert found["light_color"].colosseum == "light colour"
    assert found["light"] == Names(star_gen="visual: scene", libero_plus="light conditions"), "its colour is the same"
    assert found["sensor_noise"].libero_plus == "sensor noise", "not a viewpoint"
    words = shipped().config
    config = replace(words, conditions={**words.conditions, "odd": ConditionConfig(train="baseline", set={"odd": 1})})
    names = {one.what: one.names for one in vocabulary(config, ())}
    assert names["blind"] == Names()
    assert names["odd"] is None, "not known here, which is not the same"


def named(name):
    design = shipped(name)
    return {one.what: one.names for one in vocabulary(design.config, design.cells)}


@pytest.mark.parametrize(
    ("name", "combined"),
    [
        ("skill_object", {"task and target": NEW_PAIR}),
        ("camera_object", {"camera and target": NEW_COMBINATION}),
        ("camera_skill", {"task and camera": NEW_COMBINATION}),
        ("embodiment", {"task and arm": NEW_COMBINATION}),
        ("gripper", {"task and gripper": NEW_COMBINATION}),
        ("length", {"first and length": NEW_COMBINATION}),
        ("camera_skill_objects", {"task and camera": NEW_COMBINATION}),
        (
            "triple",
            {"task and target": NEW_PAIR, "task and camera": NEW_COMBINATION, "target and camera": NEW_COMBINATION},
        ),
        ("objects", {}),
        ("cross_domain", {}),
        ("camera", {}),
    ],
)
def test_what_is_new_in_held_out_cells_is_a_combination_of_the_factors_that_make_it_so(name, combined):
    assert {what: names for what, names in named(name).items() if " and " in what} == combined


def test_an_object_that_no_training_has_is_a_new_one():
    assert named("cross_domain")["target"] == NEW_OBJECT
    assert named("skill_object")["target"] == Names(), "each is seen with some skill"
    assert named("objects")["target"] == Names()


def test_a_new_object_does_not_hide_a_new_combination():
    config = shipped().config
    config = replace(config, unseen=({"task": "pick_up", "target": "cube"}, {"target": "knife"}))
    found = {one.what: one.names for one in vocabulary(config, cells_of(config))}
    assert (found["target"], found["task and target"]) == (NEW_OBJECT, NEW_PAIR)


def test_the_number_of_steps_is_no_rewording():
    assert named("length")["length"] == Names()


def test_an_experiment_that_varies_nothing_has_no_table():
    assert named("pick_cube") == {}
