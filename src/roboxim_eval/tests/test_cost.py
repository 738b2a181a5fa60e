"""The cost of an experiment, and what it can find for it."""

from dataclasses import replace

import pytest
from planted_cards import RATES
from trained_experiment import SEEN_AND_UNSEEN, TEXT, config

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Rates, SideBySide, cost_of, design_of
from roboxim_eval.experiments.cost import ASSUMED_SUCCEEDED, detectable_drop, fitted
from roboxim_eval.statistics.power import Design as Size
from roboxim_eval.statistics.power import detectable


def test_the_cost_follows_from_measured_rates():
    design = design_of(config())
    cost = cost_of(design, RATES)
    assert cost.train_s == pytest.approx(10 * (4000 / 5.7 + 10))
    assert cost.evaluate_s == pytest.approx(1400 * (4.0 + 0.1) + 15 * 10 + 5 * 5 + 7 + 3 * 8 * 0.5)
    assert cost.generate_s == pytest.approx(144 * (1.2 + 0.1) + 216 * 0.1 + 10 + 5)
    assert cost.disk_bytes == pytest.approx((144 + 10 + 1400) * 1e7 + 216 * 1e6)
    assert 0.1 < cost.detectable < 0.3
    away = cost_of(design_of(config(trainers={"external": {}})), RATES)
    assert away.train_s is None
    assert away.total_s == pytest.approx(cost.generate_s + cost.evaluate_s)
    assert cost.failing_s == pytest.approx(cost.evaluate_s + 1400 * 0.8 * (8.0 - 3.0))
    with pytest.raises(ConfigError, match="share of successes"):
        replace(RATES, succeeded=1.5)
    with pytest.raises(ConfigError, match="steps_per_s"):
        Rates(**{**vars(RATES), "steps_per_s": 0.0})


def test_faults_are_planted_in_one_process():
    design = design_of(config())
    faulty = replace(design.config.datasets["baseline"], fault="wrong_instruction", share=0.25)
    datasets = {**design.config.datasets, "baseline": faulty}
    planted = replace(design, config=replace(design.config, datasets=datasets))
    more_s = cost_of(planted, RATES).generate_s - cost_of(design, RATES).generate_s
    assert more_s == pytest.approx(0.25 * sum(design.datasets["baseline"].values()) * 2 * 1.2)


def test_failures_last_longer_and_their_share_is_that_of_the_last_run():
    design = design_of(config())
    assumed, ran = cost_of(design, RATES), cost_of(design, replace(RATES, succeeded=0.25))
    assert (assumed.succeeded, ran.succeeded) == (ASSUMED_SUCCEEDED, 0.25)
    assert ran.evaluate_s - assumed.evaluate_s == pytest.approx(1400 * 0.55 * (8.0 - 3.0))
    short = replace(design, trainings=tuple(replace(one, steps=50) for one in design.trainings))
    assert cost_of(short, RATES).evaluate_s == pytest.approx(assumed.failing_s), "50 steps teach nothing"


def side_by_side(trainings, steps_per_s, start_s):
    return SideBySide(
        trainings=trainings, steps_per_s=steps_per_s, start_s=start_s, measured="2026-01-02", source="test"
    )


def test_trainings_side_by_side_share_what_there_is():
    rates, design = RATES.learned(side_by_side(2, 4.0, 20.0)), design_of(config())
    one = design.trainings[0]

    def train_s(trainings, *, of, known=rates):
        return cost_of(
            replace(design, trainings=tuple(replace(one, steps=steps) for steps in of)), known, trainings
        ).train_s

    assert cost_of(design, rates).train_s == pytest.approx(10 * (4000 / 5.7 + 10)), "one at a time"
    assert cost_of(design, rates, 2).train_s == pytest.approx(5 * (4000 / 4.0 + 20))
    assert train_s(2, of=[4000] * 3) == pytest.approx(4000 / 4.0 + 20 + 4000 / 5.7 + 10), "the last one is alone"
    left = 1 - (1000 / 4.0 + 20) / (2000 / 4.0 + 20)
    assert train_s(2, of=[2000, 1000]) == pytest.approx(1000 / 4.0 + 20 + left * (2000 / 5.7 + 10)), "the rest is alone"
    assert train_s(8, of=[4000], known=RATES) == pytest.approx(4000 / 5.7 + 10)
    with pytest.raises(ConfigError, match="rate of 4 trainings at a time was not measured.*--trainings 4"):
        cost_of(design, rates, 4)
    one_after_the_other, two = (fitted(config(), rates, 6 * 3600, trainings=number) for number in (1, 2))
    assert two.replicates.count > one_after_the_other.replicates.count


def test_rates_of_trainings_are_kept_by_their_number():
    rates = RATES.learned(side_by_side(4, 3.0, 40.0)).learned(side_by_side(2, 4.0, 20.0), side_by_side(4, 2.0, 30.0))
    assert [(rate.trainings, rate.steps_per_s) for rate in rates.side_by_side] == [(2, 4.0), (4, 2.0)]
    assert (rates.at_once(1).steps_per_s, rates.at_once(4).steps_per_s) == (RATES.steps_per_s, 2.0)
    between = rates.at_once(3)
    assert (between.steps_per_s, between.start_s) == (pytest.approx(3.0), pytest.approx(25.0))
    assert between.source == "between 2 and 4 at a time, which were measured"
    assert rates.at_once(5) is None
    with pytest.raises(ConfigError, match="start_s"):
        side_by_side(2, 4.0, 0.0)


def test_a_budget_buys_the_smallest_difference_that_can_be_found():
    cheap, dear = (fitted(config(), RATES, hours * 3600) for hours in (2, 6))
    assert cost_of(design_of(cheap), RATES).total_s <= 2 * 3600
    assert cheap.replicates.count >= 3
    assert dear.replicates.count > cheap.replicates.count
    assert cost_of(design_of(dear), RATES).detectable < cost_of(design_of(cheap), RATES).detectable
    assert fitted(config(), RATES, 60.0) is None
    one = config(evaluate={"per_cell": 20, "per_unseen_cell": 1})
    for hours in (2, 3, 4, 6):
        assert 1 <= fitted(one, RATES, hours * 3600).evaluate.per_unseen_cell <= 3, "0 would be as many as per_cell"


def test_a_plan_knows_where_both_sides_are_the_same_checkpoints():
    def drop(text=TEXT, **changes):
        changes = {"replicates": {"count": 3}, "evaluate": {"per_cell": 12, "per_unseen_cell": 25}} | changes
        return detectable_drop(design_of(config(text, **changes)))

    apart = drop()
    against_seen = drop(SEEN_AND_UNSEEN)
    in_other_words = drop(compare=[{"first": "leave_out", "second": "blind", "where": "unseen"}])
    assert apart == pytest.approx(detectable(Size(replicates=3, scenes=50)))
    assert against_seen == pytest.approx(
        detectable(Size(replicates=3, scenes=48, other_scenes=50, same_checkpoints=True))
    )
    assert in_other_words < against_seen < apart
    one = SEEN_AND_UNSEEN.replace("replicates: {count: 5}", "replicates: {count: 1}")
    assert detectable_drop(design_of(config(one))) is None, "on different scenes one training always 'cannot tell'"
