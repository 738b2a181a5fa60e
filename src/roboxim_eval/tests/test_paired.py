"""Comparison of two checkpoints. Reference values: statsmodels 0.15, and Newcombe's publications."""

import itertools
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.paired import Pairs, independent_difference, paired_difference
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import condition_difference
from roboxim_eval.statistics.sequential import SequentialPlan, sequential_test
from roboxim_eval.statistics.tables import Arm, Count


def test_the_exact_mcnemar_test_agrees_with_statsmodels():
    assert paired_difference(Pairs(both=30, first=12, second=3, neither=15)).p_value == pytest.approx(0.03515625)
    assert paired_difference(Pairs(both=30, first=0, second=6, neither=15)).p_value == pytest.approx(0.03125)
    assert paired_difference(Pairs(both=5, first=0, second=0, neither=5)).p_value == 1.0


def test_newcombes_interval_for_different_scenes_agrees_with_statsmodels():
    # confint_proportions_2indep(..., method="newcomb")
    for first, second, low, high in (
        ((56, 70), (48, 80), 0.0524315, 0.3338727),
        ((9, 10), (3, 10), 0.1705227, 0.8090180),
    ):
        found = independent_difference(success_rate(*first), success_rate(*second))
        assert (found.low, found.high) == pytest.approx((low, high), abs=1e-6)


@pytest.mark.parametrize("score", [True, False])
def test_a_paired_interval_is_between_that_of_no_and_of_full_correlation(score):
    apart = independent_difference(success_rate(42, 60), success_rate(33, 60))
    paired = paired_difference(Pairs(both=30, first=12, second=3, neither=15), score=score)
    assert apart.low < paired.low < paired.value < paired.high < apart.high


def test_tangos_interval_agrees_with_a_published_one_and_mirrors():
    # Fagerland, Lydersen and Laake, Statistics in Medicine 33 (2014): airway hyper-responsiveness of 21 children
    found = paired_difference(Pairs(both=1, first=1, second=7, neither=12))
    assert (found.low, found.high) == pytest.approx((-0.517, -0.026), abs=5e-4)
    mirrored = paired_difference(Pairs(both=1, first=7, second=1, neither=12))
    assert (mirrored.low, mirrored.high) == pytest.approx((-found.high, -found.low))


@pytest.mark.parametrize("counts", [(0, 0, 7, 0), (0, 7, 0, 0), (7, 0, 0, 0), (0, 0, 0, 1), (3, 1, 0, 0)])
def test_extreme_outcomes_have_an_interval_of_possible_differences(counts):
    both, first, second, neither = counts
    found = paired_difference(Pairs(both=both, first=first, second=second, neither=neither))
    assert -1 <= found.low <= found.value <= found.high <= 1
    assert found.high - found.low > 0.3
    assert 0 <= found.p_as_good(0.1) <= 1


@pytest.mark.parametrize("counts", [(30, 12, 3, 15), (50, 0, 6, 4), (5, 9, 9, 2)])
def test_the_score_s_variance_is_that_of_the_most_likely_rates(counts):
    """At a bound, the statistic with numerically most likely rates of discordant scenes is 1.96."""
    both, first, second, neither = counts
    found = paired_difference(Pairs(both=both, first=first, second=second, neither=neither))
    scenes = sum(counts)
    for bound in (found.low, found.high):
        rates = np.linspace(max(0.0, -bound), (1 - bound) / 2, 200_001)[1:-1]  # of scenes that the second alone solves
        with np.errstate(divide="ignore"):
            chance = (
                first * np.log(rates + bound) + second * np.log(rates)
                + (both + neither) * np.log(1 - 2 * rates - bound)
            )  # fmt: skip
        rate = rates[np.argmax(chance)]
        error = np.sqrt((2 * rate + bound - bound**2) / scenes)
        assert abs(found.value - bound) / error == pytest.approx(1.96, abs=0.01)


@pytest.mark.parametrize("score", [True, False])
@pytest.mark.parametrize(("rate", "spread"), [(0.5, 0.0), (0.8, 1.5), (0.95, 1.5)])
def test_the_paired_interval_covers_the_truth(rate, spread, score):
    rng = np.random.default_rng(4)
    middle = np.log(rate / (1 - rate))
    covered = 0
    for _ in range(200):
        easy = middle + spread * rng.normal(size=60)
        chances = 1 / (1 + np.exp(-easy)), 1 / (1 + np.exp(-(easy - 0.8)))
        outcomes = zip(*(rng.random(60) < chance for chance in chances), strict=True)
        found = paired_difference(Pairs.of(outcomes), score=score)
        covered += found.low <= (chances[0] - chances[1]).mean() <= found.high
    assert covered / 200 > 0.915


def test_pairs_are_counted_and_added():
    pairs = Pairs.of([(True, True), (True, False), (False, True), (False, False), (True, False)])
    assert (pairs.both, pairs.first, pairs.second, pairs.neither, pairs.scenes) == (1, 2, 1, 1, 5)
    assert (pairs + pairs).first == 4
    with pytest.raises(InvalidRequestError, match=">= 0"):
        Pairs(both=-1, first=0, second=0, neither=0)
    with pytest.raises(InvalidRequestError, match="at least one scene"):
        paired_difference(Pairs(both=0, first=0, second=0, neither=0))


def looks_at(first, second, plan):
    return [Pairs.of(zip(first[:n], second[:n], strict=True)) for n in plan.looks]


@lru_cache(maxsize=1000)
def sign_test(wins, tosses):
    return binomtest(wins, tosses).pvalue if tosses else 1.0


@pytest.mark.parametrize("tosses", [(5, 5, 5), (2, 9, 12), (0, 0, 5)])
def test_stopping_early_raises_no_false_alarms(tosses):
    """All outcomes of two equally good checkpoints, weighted by their probabilities: no simulation is needed."""
    plan = SequentialPlan(looks=(25, 50, 75))
    alarms = naive = 0.0
    for wins in itertools.product(*(range(n + 1) for n in tosses)):
        firsts, all_tosses = np.cumsum(wins), np.cumsum(tosses)
        looks = [
            Pairs(both=int(scenes - n), first=int(first), second=int(n - first), neither=0)
            for scenes, n, first in zip(plan.looks, all_tosses, firsts, strict=True)
        ]
        chance = np.prod([binom.pmf(w, n, 0.5) for w, n in zip(wins, tosses, strict=True)])
        alarms += chance * sequential_test(plan, looks).decided
        naive += chance * any(sign_test(int(f), int(n)) <= 0.05 for f, n in zip(firsts, all_tosses, strict=True))
    assert alarms <= 0.05
    if min(tosses) > 4:
        assert alarms > 0.02
        assert naive > alarms, "testing at every look without a plan has more false alarms"


def test_a_large_difference_is_found_early():
    plan = SequentialPlan.even(scenes=100, looks=5)
    state = sequential_test(plan, looks_at([True] * 100, [i % 5 == 0 for i in range(100)], plan))
    assert (state.decided, state.finished) == (True, True)
    assert state.look < 5
    equal = sequential_test(plan, looks_at([True] * 100, [True] * 100, plan)[:2])
    assert (equal.decided, equal.finished, equal.look) == (False, False, 2)


def test_looks_must_be_as_planned():
    plan = SequentialPlan.even(scenes=10, looks=2)
    with pytest.raises(InvalidRequestError, match="look 1 was planned at 5 scenes, got 6"):
        sequential_test(plan, [Pairs(both=6, first=0, second=0, neither=0)])
    with pytest.raises(InvalidRequestError, match="increasing"):
        SequentialPlan(looks=(5, 5))


def test_one_training_with_unequal_cells_is_compared_by_the_mean_of_its_cells():
    """Two cells of 40 episodes and eight of 5, in which the other policy is better: pooled scenes say the opposite."""
    cells = [f"cell{i}" for i in range(10)]

    def arm(many, few):
        counts = {
            cell: Count(successes=many, episodes=40) if i < 2 else Count(successes=few, episodes=5)
            for i, cell in enumerate(cells)
        }
        return Arm(replicates=(counts,))

    pairs = [Pairs(both=28, first=48, second=24, neither=20)]
    found = condition_difference(arm(38, 0), arm(14, 3), pairs)
    assert found.pairs is None
    assert found.interval().value == pytest.approx(0.19 - 0.55)
    even = Arm(replicates=({cell: Count(successes=5, episodes=12 if cell == "cell0" else 11) for cell in cells},))
    assert condition_difference(even, even, pairs).pairs is not None  # an excluded episode does not matter
