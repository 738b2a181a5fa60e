import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_tasks.choices import Choice, VectorChoice


def test_an_ordered_list_is_a_function_of_the_index():
    choice = Choice(values=("red", "green", "blue"), order="in_order")
    rng = np.random.default_rng(0)
    assert [choice.draw(rng, index) for index in (0, 1, 2, 3, 7)] == ["red", "green", "blue", "red", "green"]
    assert VectorChoice(values=((1.0,), (2.0,)), order="in_order").draw(rng, 5).tolist() == [2.0]


def test_a_range_and_a_random_list_cover_all_of_it():
    rng = np.random.default_rng(0)
    numbers = [Choice(lower=-1.0, upper=3.0).draw_number(rng, 0) for _ in range(500)]
    assert min(numbers) < -0.9
    assert max(numbers) > 2.9
    assert abs(np.mean(numbers) - 1.0) < 0.2
    assert {Choice(values=(1, 2, 3)).draw(rng, 0) for _ in range(50)} == {1, 2, 3}


@pytest.mark.parametrize(
    "wrong",
    [
        {}, {"lower": 1.0}, {"values": (1.0,), "lower": 0.0, "upper": 1.0}, {"lower": 2.0, "upper": 1.0},
        {"values": (1.0,), "order": "sorted"}, {"lower": 0.0, "upper": 1.0, "order": "in_order"},
        {"values": (1.0, 2.0), "weights": (1.0,)}, {"values": (1.0,), "weights": (0.0,)},
        {"values": (1.0,), "weights": (1.0,), "order": "in_order"},
    ],
)  # fmt: skip
def test_a_choice_that_means_nothing_is_refused(wrong):
    with pytest.raises(ConfigError):
        Choice(**wrong)


def test_weights_say_how_often_and_only_keeps_what_is_allowed():
    rng = np.random.default_rng(0)
    choice = Choice(values=("red", "green", "blue"), weights=(0.0, 1.0, 3.0))
    drawn = [choice.draw(rng, 0) for _ in range(400)]
    assert "red" not in drawn
    assert 250 < drawn.count("blue") < 350
    assert choice.only(("green", "pink")) == Choice(values=("green",), weights=(1.0,))
    assert choice.only(("red",)) is None
    assert choice.only(("red", "green", "blue")) is choice


def test_what_must_be_numbers_words_or_colours_is_refused_with_its_key_and_range():
    Choice(values=(0, 0.5)).require_numbers("share", 0.0, 1.0)
    Choice(values=("wood", "")).require_words("texture", "names")
    VectorChoice(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0)).require_color("color")
    for check, said in (
        (
            lambda: Choice(values=(0.5, 2)).require_numbers("share", 0.0, 1.0),
            "share must be a number from 0 to 1, got 2",
        ),
        (lambda: Choice(lower=-1.0, upper=0.0).require_numbers("mass", 0.0), "mass must be a number >= 0, got -1.0"),
        (lambda: Choice(values=(True,)).require_numbers("yaw"), "yaw must be a number, got True"),
        (
            lambda: Choice(lower=0.0, upper=1.0).require_words("texture", "names"),
            "texture must be values, names, not a",
        ),
        (lambda: Choice(values=(3,)).require_words("texture", "names"), "texture must be values, names, not 3"),
        (
            lambda: VectorChoice(values=((1.0, 0.0),)).require_color("color"),
            "color must be vectors of 3 numbers, got 2",
        ),
        (lambda: VectorChoice(values=((1.5, 0.0, 0.0),)).require_color("color"), "color must be red, green and blue"),
    ):
        with pytest.raises(ConfigError, match=said):
            check()
