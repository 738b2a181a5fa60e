"""Transfer as a curve: nested, even sets of combinations; planted policies of known ability give their curve."""

import math

import numpy as np
import pytest
from planted_cards import experiment_of, planted_card

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import design_of
from roboxim_eval.experiments.card_checks import card_curve, check_card
from roboxim_eval.experiments.cells import cells_of
from roboxim_eval.experiments.combinations import expanded, nested_sets
from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_eval.statistics.trend import trend

TEXT = """
about: How many combinations are enough?
factors: {task: [pick_up, place_on, push_object], target: [cube, apple, soda_can, onion]}
unseen: [{task: pick_up, target: cube}, {task: place_on, target: onion}]
combinations: {seen: [4, 6, 10], demonstrations: 60}
trainers: {bc: {command: "train {dataset} {out} {seed}", policy: bc, steps: 7}}
evaluate: {per_cell: 40}
replicates: {count: 5}
"""


def test_sets_are_nested_even_and_have_every_level():
    config = experiment_of(TEXT)
    cells = cells_of(config)
    sets = nested_sets(cells, (4, 6, 10))
    assert [len(one) for one in sets] == [4, 6, 10]
    for smaller, larger in zip(sets, sets[1:], strict=False):
        assert {cell.key for cell in smaller} < {cell.key for cell in larger}
    for mine in sets:
        assert not any(cell.unseen for cell in mine)
        for factor, levels in (("task", 3), ("target", 4)):
            counts = [sum(cell.levels[factor] == level for cell in mine) for level in dict.fromkeys(
                cell.levels[factor] for cell in cells)]  # fmt: skip
            assert len(counts) == levels
            assert min(counts) >= 1
            assert max(counts) - min(counts) <= 1
    assert nested_sets(cells, (4, 6, 10)) == sets


def test_trainings_have_equal_numbers_of_demonstrations_and_steps():
    config = experiment_of(TEXT)
    design = design_of(config)
    assert {name: sum(counts.values()) for name, counts in design.datasets.items()} == dict.fromkeys(
        ("seen_4", "seen_6", "seen_10"), 60
    )
    assert {training.steps for training in design.trainings} == {7}
    assert [(c.first, c.second, c.where, c.primary) for c in config.compare] == [
        ("seen_4", "seen_10", "unseen", True), ("seen_6", "seen_10", "unseen", False),
    ]  # fmt: skip
    assert all(set(e.counts) == {"pick_up target=cube", "place_on target=onion"} for e in design.evaluations)
    assert expanded(config) == config
    again = from_plain(to_plain(config), ExperimentConfig, source="again")
    assert expanded(again) == config, "a file that is written at a scale is read as it was"


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"combinations": {"seen": [4, 7], "demonstrations": 60}}, "60 cannot be spread evenly over 7 cells.*of 28"),
        ({"combinations": {"seen": [6, 4], "demonstrations": 60}}, "at least two ascending numbers"),
        ({"combinations": {"seen": [3, 6], "demonstrations": 60}}, "no 3 of the 10 seen cells have every level"),
        ({"combinations": {"seen": [4, 12], "demonstrations": 60}}, "12 cells, but only 10 of 12 are seen"),
        ({"unseen": []}, "needs held-out cells"),
        ({"conditions": {"seen_4": {"given": True}}}, "conditions.seen_4: combinations makes one"),
        ({"combinations": None}, "needs at least one condition, or combinations"),
        ({"trainers": {}}, "there are no trainers"),
    ],
)
def test_what_gives_no_curve_is_refused(change, error):
    with pytest.raises(ConfigError, match=error):
        experiment_of(TEXT, **change)


def test_planted_policies_give_their_curve():
    rates = {"seen_4": 0.3, "seen_6": 0.7, "seen_10": 0.7}
    card = planted_card(design_of(experiment_of(TEXT)), lambda condition, cell: rates[condition])
    assert check_card(card.plain) == card
    curve = card_curve(card)
    assert [point.number for point in curve.points] == [4, 6, 10]
    for point, rate in zip(curve.points, rates.values(), strict=True):
        assert point.rate.low <= rate <= point.rate.high
    assert curve.fewer == (4,)
    assert curve.enough == 6
    assert curve.change.low > 0
    page = experiment_page(ExperimentPage(card=card))
    assert "6 combinations are shown to be enough: as good as 10 within the margin, or better." in page
    assert "seen combinations</text>" in page
    assert card.scores is None, "the largest set is no baseline: it never saw the held-out cells either"


def test_one_training_shows_nothing_about_numbers_of_combinations():
    for rate in (0.1, 0.9):
        design = design_of(experiment_of(TEXT, replicates={"count": 1}, evaluate={"per_cell": 200}))
        card = planted_card(design, lambda condition, cell, rate=rate: rate if condition == "seen_4" else 0.9)
        assert {(one.question, one.kind) for one in card.verdicts} <= {
            ("checkpoint", "lower"), ("checkpoint", "as_good")}  # fmt: skip
        curve = card_curve(card)
        assert (curve.enough, curve.fewer) == (None, ())
        assert "no interval from one training" in " ".join(curve.sentences)


def test_a_better_number_is_enough_and_comparisons_with_other_cells_do_not_count():
    other = {"first": "seen_4", "second": "seen_10", "where": "unseen", "against": "seen", "primary": True}
    config = experiment_of(TEXT, compare=[other], evaluate={"per_cell": 60, "cells": {"seen_10": "all"}})
    assert [(one.first, one.against) for one in config.compare] == [("seen_4", ""), ("seen_6", ""), ("seen_4", "seen")]
    rates = {"seen_4": 0.8, "seen_6": 0.8, "seen_10": 0.3}
    card = planted_card(design_of(config), lambda condition, cell: rates[condition] if cell.unseen else 0.99)
    assert [one.kind for one in card.verdicts] == ["lower", "higher", "higher"]
    curve = card_curve(card)
    assert (curve.enough, curve.fewer) == (4, ())


def test_equal_policies_have_no_trend():
    card = planted_card(design_of(experiment_of(TEXT)), lambda *_: 0.5, spread=0.05, seed=3)
    curve = card_curve(card)
    assert curve.fewer == ()
    assert curve.change.low < 0 < curve.change.high


def test_a_trend_of_one_training_has_no_interval():
    arms = [Arm(replicates=({"a": Count(successes=n, episodes=10)},)) for n in (2, 4, 6)]
    found = trend([1, 2, 3], arms)
    assert found.value == pytest.approx(0.2)
    assert math.isinf(found.high)


@pytest.mark.thorough
@pytest.mark.parametrize(("spread", "trainings"), [(0.0, 3), (0.05, 3), (0.1, 5)])
def test_the_interval_of_the_trend_holds(spread, trainings):
    rng, held = np.random.default_rng(0), []
    true = np.array([0.3, 0.5, 0.6, 0.65])
    places = np.log2([6, 9, 12, 15])
    slope = float(((places - places.mean()) @ true) / ((places - places.mean()) ** 2).sum())
    for _ in range(400):
        rates = np.clip(true[:, None] + spread * rng.standard_normal((4, trainings)), 0, 1)
        arms = [
            Arm(replicates=tuple({"a": Count(successes=int(n), episodes=60)} for n in rng.binomial(60, row)))
            for row in rates
        ]
        found = trend(places, arms)
        held.append(found.low <= slope <= found.high)
    assert np.mean(held) >= 0.94
