"""Proofs of training data: held-out episodes are found whatever cell they claim."""

from dataclasses import replace

import pytest
from clean_episode import CLEAN, DEMAND, moved, words

from roboxim_eval.experiments.proving.cells_apart import belongs_to
from roboxim_eval.experiments.proving.delivery import faults_of
from roboxim_eval.experiments.proving.demand import Allowed, Demand
from roboxim_eval.experiments.proving.proofs import Trained, training_tally

ROTATE = replace(DEMAND, skill="rotate", distractors=(0, 0))
CELLS = {"pick_up target=cube": DEMAND, "rotate target=cube": ROTATE}
TURN = Trained(shown=replace(CLEAN, bag="episodes/demo-1", cell="rotate target=cube", skill="rotate"))


def trained_on(*episodes, counts=None):
    return training_tally(CELLS, ["pick_up target=cube"], counts or {"rotate target=cube": len(episodes)}, episodes)


def test_a_held_out_episode_is_found_whatever_cell_it_claims():
    assert not trained_on(TURN, TURN).refusal(0.0)
    lying = Trained(shown=replace(CLEAN, bag="episodes/demo-2", cell="rotate target=cube"))
    refusal = trained_on(TURN, lying).refusal(0.0)
    assert "episodes/demo-2: unseen: it is of the held-out cell 'pick_up target=cube', although it claims" in refusal
    both = {"pick_up target=cube": 1, "rotate target=cube": 1}
    assert not trained_on(TURN, Trained(shown=CLEAN), counts=both).refusal(0.0), "the baseline may have it"


BRIGHT = replace(DEMAND, look={**DEMAND.look, "light.intensity": Allowed(lower=(2.5,), upper=(4.0,))})
FACTORS = {
    "light": (BRIGHT, {"look": {**CLEAN.look, "light.intensity": 3.0}}),
    "texture": (
        replace(DEMAND, look={**DEMAND.look, "table.texture": words("speckle")}),
        {"look": {**CLEAN.look, "table.texture": "speckle"}},
    ),
    "start": (
        replace(DEMAND, start=Allowed(lower=(0.4, 0.2, 0.3), upper=(0.5, 0.3, 0.4))), {"start": (0.45, 0.25, 0.35)},
    ),
    "distractors": (
        replace(DEMAND, distractors=(0, 0), others={}), {"others": {}, "other_modifiers": {}, "pixels": {}},
    ),
    "physics": (
        replace(DEMAND, physics={"target": {"mass_kg": Allowed(lower=(0.3,), upper=(0.5,))}}),
        {"physics": {"target": {"mass_kg": 0.4, "friction_coefficient": 0.8}}, "weights": {"target": 0.4}},
    ),
    "instruction": (
        replace(DEMAND, templates=("Grasp the {target}",)),
        {"instruction": "Grasp the red cube", "received": ("Grasp the red cube",)},
    ),
}  # fmt: skip
"""Property to what another level of it demands of a cell that is DEMAND otherwise, and what its episodes show."""
NOMINAL = replace(DEMAND, look={**DEMAND.look, "light.intensity": words(2.0)})
USUAL = Trained(shown=replace(CLEAN, cell="usual"))


def held_out_by(factor, *episodes):
    cells = {"usual": NOMINAL, "other": FACTORS[factor][0]}
    return training_tally(cells, ["other"], {"usual": len(episodes)}, episodes)


@pytest.mark.parametrize("factor", FACTORS)
def test_a_held_out_light_start_or_word_is_told_from_the_seen_one(factor):
    assert held_out_by(factor, USUAL).faults == ()
    shown = replace(CLEAN, cell="other", bag="episodes/other", **FACTORS[factor][1])
    assert faults_of(FACTORS[factor][0], shown) == {}
    lying = Trained(shown=replace(shown, cell="usual"))
    (fault,) = held_out_by(factor, USUAL, lying).faults
    assert (fault.check, fault.bag) == ("unseen", "episodes/other")
    assert fault.text == "it is of the held-out cell 'other', although it claims 'usual'"
    said = held_out_by(factor, USUAL, Trained(shown=shown)).refusal(0.0)
    assert "episodes/other: unseen: it is of the held-out cell 'other'" in said


def test_a_held_out_episode_with_a_fault_or_other_words_is_still_one():
    dark = replace(CLEAN, cell="usual", **FACTORS["light"][1])
    for defect in ({"instruction": "Rotate the red cube"}, {"brightness": {"workspace": 90.0}}, {"others": {}}):
        planted = Trained(shown=replace(dark, **defect), planted="a fault that excuses it from the other checks")
        assert held_out_by("light", planted).refusal(0.0), defect
    reworded = Trained(shown=replace(CLEAN, cell="rotate target=cube", instruction="Rotate the red cube"))
    assert trained_on(reworded).refusal(0.0), "skills tell these cells apart, not words"


def test_a_light_of_neither_cell_is_a_fault_of_the_light_alone():
    between = Trained(shown=replace(CLEAN, cell="usual", look={**CLEAN.look, "light.intensity": 2.3}))
    assert held_out_by("light", between).faults == ()
    assert list(faults_of(NOMINAL, between.shown)) == ["light"]


def test_the_counts_of_a_dataset_must_be_those_of_the_design():
    refusal = trained_on(TURN, TURN, counts={"rotate target=cube": 3}).refusal(0.0)
    assert "rotate target=cube: counts: 2 episodes, 3 expected" in refusal


def test_held_out_objects_beside_the_target_and_in_words_are_stated():
    beside = Trained(
        shown=replace(CLEAN, models={"target": "apple"}, others={"distractor_1": "cube"}, cell="rotate target=cube")
    )
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    found = trained_on(beside, replace(TURN, instructed=(asked,)))
    assert not found.refusal(0.0)
    assert found.statements == (
        "1 of 1 training episodes of pick_up have the object of the held-out cell 'pick_up target=cube' as a "
        "distractor",
        "the instructions of 1 training episodes ask for the held-out cell 'pick_up target=cube'",
    )


def test_words_of_the_own_cell_are_no_exposure_of_a_cell_with_other_surroundings():
    elsewhere = replace(DEMAND, areas={"target": (Allowed(lower=(0.3, 0.2), upper=(0.5, 0.3)),)})
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    episode = Trained(shown=replace(CLEAN, cell="picks right"), instructed=(asked,))
    assert (
        training_tally({"picks left": elsewhere, "picks right": DEMAND}, ["picks left"], {}, [episode]).statements == ()
    )


def test_cells_are_told_apart_by_content():
    assert belongs_to(DEMAND, CLEAN)
    assert not belongs_to(ROTATE, CLEAN)
    assert not belongs_to(DEMAND, replace(CLEAN, cameras={"workspace": moved(0.3)}))
