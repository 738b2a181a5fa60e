"""Proofs of delivery: each planted defect is found, by name of its bag and with its figure; a clean episode passes."""

from dataclasses import replace

import pytest
from clean_episode import CLEAN, DEMAND, DEMANDS, VIEW, moved, words

from roboxim_eval.experiments.proving.delivery import faults_of
from roboxim_eval.experiments.proving.demand import Allowed
from roboxim_eval.experiments.proving.proofs import tally

NAN = float("nan")
GREY = (0.5, 0.5, 0.5)


def test_a_clean_episode_passes_every_check():
    assert faults_of(DEMAND, CLEAN) == {}
    found = tally(DEMANDS, [CLEAN])
    assert set(found.checks.values()) == {(1, 1)}
    assert not found.refusal()


@pytest.mark.parametrize(
    ("check", "figure", "defect"),
    [
        ("skill", "rotate", {"skill": "rotate"}),
        ("object", "the target is apple", {"models": {"target": "apple"}}),
        ("object", "color of the target is blue", {"modifiers": {"target": {"color": "blue"}}}),
        ("object", "12 visible pixels", {"pixels": {"target": 12.0}}),
        ("object", "15.0 .CIEDE2000", {"colors": {"target": 15.0}}),
        ("distractors", "0 distractors .* 1 to 2 expected", {"others": {}, "pixels": {}, "colors": {}}),
        ("distractors", "distractor_1 is a lemon, .* apple or cube", {"others": {"distractor_1": "lemon"}}),
        ("distractors", "color of distractor_1 is none, .* blue or green", {"others": {"distractor_1": "cube"}}),
        ("distractors", "distractor_1's median colour is 15.0", {"colors": {"distractor_1": 15.0}}),
        (
            "physics",
            "mass_kg of the target is 0.4, .* from 0.05 to 0.2",
            {"physics": {"target": {"mass_kg": 0.4}}, "weights": {"target": 0.4}},
        ),
        ("physics", "0.04 kg of the target press on the table, its model has 0.08 kg", {"weights": {"target": 0.04}}),
        ("physics", "the table's friction is 0.5, .* 0.7", {"table_friction": 0.5}),
        (
            "instruction",
            "the cell demands 'Pick up the {target}' or 'Lift the {target}', where target is the red cube",
            {"instruction": "Pick up the blue cube", "received": ("Pick up the blue cube",)},
        ),
        ("area", "0.4 0.2 m, 10.0 cm outside", {"positions": {"target": (0.4, 0.2, 0.0)}}),
        ("area", "the target is missing", {"positions": {}}),
        ("start", "5.0 cm outside", {"start": (0.45, 0.0, 0.25)}),
        ("camera", "5.0 cm from the demanded pose", {"cameras": {"workspace": moved(0.05)}}),
        ("camera", "mounted on gripper", {"cameras": {"workspace": replace(VIEW, parent="gripper")}}),
        ("camera", "missing", {"cameras": {}}),
        ("camera", "4.0 px from its projection", {"tool_px": {"workspace": 4.0}}),
        ("camera", "is not found", {"tool_px": {"workspace": float("inf")}}),
        ("light", "light.intensity is 0.5, .* from 1 to 4", {"look": {**CLEAN.look, "light.intensity": 0.5}}),
        ("light", r"-9.0 of 255", {"brightness": {"workspace": -9.0}}),
        ("texture", "table.texture is none, .* marble or wood", {"look": {**CLEAN.look, "table.texture": ""}}),
        ("texture", "12.0", {"colors": {"table": 12.0}}),
        ("words", "received '', expected 'Pick up the red cube'", {"received": ("",)}),
        ("words", "received 'Pick up the red cube' and '', expected", {"received": ("Pick up the red cube", "")}),
    ],
)
def test_each_defect_is_found_with_its_figure(check, figure, defect):
    found = tally(DEMANDS, [CLEAN, replace(CLEAN, bag="episodes/eval-1", **defect)])
    (fault,) = found.faults
    assert (fault.check, fault.bag) == (check, "episodes/eval-1")
    with pytest.raises(RuntimeError, match=rf"1 of 2 episodes .*\n  episodes/eval-1: {check}: .*{figure}"):
        raise RuntimeError(found.refusal())


def test_hidden_distractors_are_stated_but_no_fault():
    """A scene guarantees the sight of the objects of its task alone."""
    found = tally(
        DEMANDS, [CLEAN, replace(CLEAN, bag="episodes/eval-1", pixels={**CLEAN.pixels, "distractor_1": 12.0})]
    )
    assert not found.faults
    (said,) = found.statements
    assert said.startswith("1 of 2 distractors are hidden or out of the picture: fewer than 40 visible pixels")


def test_pictures_that_nothing_compared_are_counted_and_stated_but_no_fault():
    photo = replace(CLEAN, bag="episodes/eval-1", not_compared="renderer photo", tool_px={}, pixels={}, colors={})
    found = tally(DEMANDS, [CLEAN, photo, photo])
    assert not found.faults
    assert found.checks["pictures"] == (1, 3)
    (said,) = found.statements
    assert said.startswith("pictures were not compared (renderer photo): where 'pictures' did not pass, camera")
    compared = tally(DEMANDS, [CLEAN])
    assert (compared.checks["pictures"], compared.statements) == ((1, 1), ())
    assert "pictures" not in tally(DEMANDS, [replace(CLEAN, pictures={})]).checks, "there are none to compare"


@pytest.mark.parametrize(
    ("check", "defect"),
    [
        ("skill", {"arguments": {"angle": NAN}}),
        ("object", {"modifiers": {"target": {"color": "red", "mass": NAN}}}),
        ("object", {"pixels": {"target": NAN}}),
        ("object", {"colors": {"target": NAN}}),
        ("distractors", {"pixels": {"distractor_1": NAN}}),
        ("physics", {"weights": {"target": NAN}}),
        ("physics", {"physics": {"target": {"mass_kg": NAN}}, "weights": {}}),
        ("physics", {"table_friction": NAN}),
        ("area", {"positions": {"target": (NAN, 0.0, 0.02)}}),
        ("area", {"positions": {"target": (0.4, NAN, 0.02)}}),
        ("start", {"start": (0.45, 0.0, NAN)}),
        ("camera", {"tool_px": {"workspace": NAN}}),
        ("light", {"look": {**CLEAN.look, "table.color": GREY, "light.intensity": NAN}}),
        ("light", {"brightness": {"workspace": NAN}}),
        ("texture", {"look": {**CLEAN.look, "table.color": (0.5, NAN, 0.5)}}),
        ("texture", {"colors": {"table": NAN}}),
        ("latency", {"latency_ticks": NAN}),
    ],
)
def test_a_nan_is_a_fault(check, defect):
    demand = replace(
        DEMAND, arguments={"angle": words(0.5, 1.0)},
        modifiers={"target": {"color": words("red"), "mass": Allowed(lower=(0.1,), upper=(0.2,))}},
        look={**DEMAND.look, "table.color": words(GREY)},
    )  # fmt: skip
    whole = replace(
        CLEAN, arguments={"angle": 0.5}, modifiers={"target": {"color": "red", "mass": 0.15}},
        look={**CLEAN.look, "table.color": GREY},
    )  # fmt: skip
    assert faults_of(demand, whole) == {}
    assert list(faults_of(demand, replace(whole, **defect))) == [check]


def test_a_policy_must_receive_the_words_of_its_condition():
    blind = replace(DEMAND, words="")
    assert "words" in faults_of(blind, CLEAN)
    assert not faults_of(blind, replace(CLEAN, received=("",)))
    assert "words" in faults_of(blind, replace(CLEAN, received=("", "Pick up the red cube"))), "one request had words"


def test_words_that_a_bag_does_not_tell_are_unproven_and_said_to_be():
    silent = replace(CLEAN, bag="episodes/old", received=())
    found = tally(DEMANDS, [CLEAN, silent])
    assert found.checks["words"] == (1, 1)
    assert found.checks["instruction"] == (2, 2)
    assert "the bags of 1 of 2 rollouts do not say which instruction the policy received" in found.statements[0]
    demonstrations = tally(DEMANDS, [silent], without=("words",))
    assert "words" not in demonstrations.checks
    assert demonstrations.statements == ()
    assert tally(DEMANDS, [silent]).checks.keys().isdisjoint({"words"})


@pytest.mark.parametrize("said", ["Lift the red cube", "Lift the top drawer of the red cube"])
def test_an_instruction_follows_a_template_of_its_cell(said):
    assert not faults_of(DEMAND, replace(CLEAN, instruction=said, received=(said,)))
    angle = replace(DEMAND, templates=("Turn the {target} {direction} by {angle} degrees",))
    turning = "Turn the red cube clockwise by 90 degrees"
    assert not faults_of(angle, replace(CLEAN, instruction=turning, received=(turning,)))
    assert "instruction" in faults_of(angle, replace(CLEAN, instruction=said, received=(said,)))


def test_distractors_that_every_scene_has_must_be_there():
    demand = replace(DEMAND, always=("cube",), distractors=(2, 2))
    two = replace(
        CLEAN, others={"distractor_1": "cube", "distractor_2": "cube"},
        other_modifiers={"distractor_1": {}, "distractor_2": {"color": "blue"}},
    )  # fmt: skip
    assert not faults_of(demand, two)
    apple = replace(two, others={"distractor_1": "apple", "distractor_2": "cube"})
    assert faults_of(demand, apple) == {"distractors": "no distractor is a cube, which every scene has"}


def test_a_drawn_camera_must_lie_within_its_range():
    shifted = replace(DEMAND, shifts={"workspace": Allowed(lower=(-0.06, -0.1, 0.0), upper=(0.06, 0.1, 0.0))})
    assert not faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.05)}))
    assert "9.0 cm from" not in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))
    assert "3.0 cm from" in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))


def test_one_percent_of_faulty_episodes_is_tolerated_and_no_more():
    bad = replace(CLEAN, others={})
    few = tally(DEMANDS, [CLEAN] * 199 + [replace(bad, bag=f"b{n}") for n in range(2)])
    assert few.faulty == {"b0", "b1"}
    assert not few.refusal()
    many = few + tally(DEMANDS, [replace(bad, bag="b2")])
    assert "3 of 202 episodes" in many.refusal()
    assert "2 of 201" in few.refusal(0.0)


def test_answers_must_be_as_late_as_the_condition_says():
    late = replace(DEMAND, latency_ticks=2)
    assert faults_of(late, replace(CLEAN, latency_ticks=2.0)) == {}
    assert faults_of(late, CLEAN) == {"latency": "the policy's answers were 0 ticks late, 2 expected"}
    assert faults_of(DEMAND, replace(CLEAN, latency_ticks=1.5)) != {}
