from dataclasses import replace

import pytest

from roboxim_core.errors import ConfigError
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.what_if import EXPERT, RECORDED, Question, first_difference, simulate
from roboxim_studio.episode.film import read_film


@pytest.fixture(scope="module")
def lab():
    lab = Lab()
    yield lab
    lab.close()


@pytest.fixture(scope="module")
def film(bag):
    return read_film(bag, in_background=False)


def test_recorded_actions_lead_to_the_recorded_states(lab, film):
    answer = simulate(lab.graph, film, Question(tick=3, actor=RECORDED))
    assert first_difference(film, answer) is None
    assert [state.state_hash for state in answer.states] == [state.state_hash for state in film.states]
    assert answer.verdicts == film.verdicts


def test_the_expert_goes_on_from_a_tick_with_what_the_gripper_holds(lab, film):
    held = next(s.seq for s in film.states if len(s.contacts_between("robot", "target")) > 1) + 2
    answer = simulate(lab.graph, film, Question(tick=held, actor=EXPERT), lab.actor(EXPERT))
    differs = first_difference(film, answer)
    assert differs is None or differs > held
    assert answer.result.outcome == "success"
    assert answer.pictures.at(held + 1).keys() == film.pictures.at(0).keys()


def test_an_episode_that_ends_sooner_differs_where_it_ends(studio, bag, film):
    studio.open_bag(bag)
    cut = replace(film, states=film.states[:5], steps=film.steps[:5])
    assert (first_difference(film, cut), first_difference(cut, film), first_difference(film, film)) == (5, 5, None)
    studio.what_if.compare(cut)
    assert "no tick differs until one of them ends, after tick 4" in studio.what_if._message.content


@pytest.mark.slow
def test_a_moved_object_differs_from_there_on_and_marks_the_episode(lab, film):
    answer = simulate(lab.graph, film, Question(tick=5, actor=RECORDED, moved="target", by_m=(0.0, 0.2)))
    assert first_difference(film, answer) == 6
    assert answer.states[-1].disturbed
    shift = answer.states[6].entity("target").pose.position[1] - film.states[5].entity("target").pose.position[1]
    assert shift == pytest.approx(0.2, abs=1e-3)
    assert answer.result.outcome == "failure"


@pytest.mark.parametrize(
    ("question", "said"),
    [
        (Question(tick=9999), "tick must be 0"),
        (Question(tick=1, moved="targt"), "no entity 'targt'.*target"),
        (Question(tick=1, without="target"), "only a distractor"),
    ],
)
def test_a_question_that_makes_no_sense_is_refused(lab, film, question, said):
    with pytest.raises(ConfigError, match=said):
        simulate(lab.graph, film, question)


@pytest.mark.slow
def test_the_panel_shows_the_other_episode_beside_the_first(studio, bag):
    film = studio.open_bag(bag)
    studio.episode.show(4)
    studio.what_if._actor.value = RECORDED
    answer = studio.what_if.start().result(timeout=120)
    assert studio.what_if.other is answer
    assert "no tick differs" in studio.what_if._message.content
    studio.what_if._swap()
    assert studio.episode.film is answer
    assert studio.what_if.other is film
    assert studio.episode.tick == 4
