"""What follows from runs of a failed episode with one thing changed."""

import pytest

from roboxim_eval.answers.causes import Tally, explanation, may_become_cause


def tally(name, successes, runs=5):
    return Tally(name=name, words=f"without {name}", successes=successes, runs=runs)


AS_IT_WAS = Tally(name="", words="as it was", successes=0, runs=5)
FAILS = [tally(name, 0, 1) for name in ("camera", "light", "start", "place")]


def test_one_change_that_helps_is_the_single_cause():
    found = explanation(AS_IT_WAS, [tally("distractors", 5), *FAILS])
    assert found.kind == "single"
    assert found.sentence == "Without distractors it succeeds 5 of 5; as it was it succeeds 0 of 5."


def test_several_changes_can_each_be_enough():
    found = explanation(AS_IT_WAS, [*FAILS, tally("words", 5), tally("color", 5)])
    assert (found.kind, {cause.name for cause in found.causes}) == ("several", {"words", "color"})
    assert found.sentence.startswith("Each of these changes alone: ")


def test_two_changes_together_are_no_single_cause():
    found = explanation(AS_IT_WAS, FAILS, [tally("camera+light", 5), tally("camera+start", 0, 1)])
    assert found.kind == "together"
    assert found.sentence.startswith("No single cause, but two: ")
    assert explanation(AS_IT_WAS, FAILS).kind == "none"


def test_an_episode_that_succeeds_as_it_was_needs_no_cause():
    lucky = Tally(name="", words="as it was", successes=4, runs=5)
    assert explanation(lucky, [tally("light", 5)]).kind == "chance"


def test_an_episode_that_fails_now_and_then_is_not_said_to_have_been_tried_with_changes():
    sometimes = Tally(name="", words="as it was", successes=2, runs=5)
    assert explanation(sometimes, []).sentence.startswith("No cause was looked for: as it was it succeeds 2 of 5")


@pytest.mark.parametrize("successes", [1, 2, 3])
def test_a_change_that_helps_now_and_then_is_no_cause(successes):
    assert explanation(AS_IT_WAS, [tally("light", successes), *FAILS]).kind == "none"


def test_a_change_is_given_up_when_it_can_no_longer_be_shown():
    assert may_become_cause(tally("light", 0, 0), 5, AS_IT_WAS, 8)
    assert not may_become_cause(tally("light", 0, 1), 5, AS_IT_WAS, 8)
    assert not may_become_cause(tally("light", 0, 0), 3, AS_IT_WAS, 8), "three runs cannot show one of eight"
