"""Agreement of two benchmarks: the published measures, and intervals that hold on tables of known truth."""

import math

import numpy as np
import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.correlation import (
    WHOLE,
    correlation,
    counted,
    mean_maximum_rank_violation,
    needed_policies,
    pearson,
    policy_counts,
    sentences,
)
from roboxim_eval.statistics.tables import Arm, Count

REAL = np.array([0.907, 0.853, 0.920, 0.760, 0.133, 0.293])
SIMULATED = np.array([0.787, 0.857, 0.710, 0.567, 0.027, 0.170])
"""Published rates of six policies that pick up a coke can: SIMPLER, ``simpler_env/utils/metrics.py``."""
PICK_CAN = counted(np.stack([75 * REAL, 300 * SIMULATED], axis=-1).round(), (75, 300))
"""The smallest numbers of rollouts that fit these rates."""


def violation_by_its_definition(real, predicted):
    worst = []
    for i in range(len(real)):
        found = [0.0]
        for j in range(len(real)):
            if (predicted[i] > predicted[j]) != (real[i] > real[j]):
                found.append(abs(real[i] - real[j]))
        worst.append(max(found))
    return sum(worst) / len(worst)


def test_measures_are_those_of_the_published_definition():
    assert mean_maximum_rank_violation(REAL, SIMULATED) == pytest.approx(0.031, abs=5e-4)
    assert pearson(REAL, SIMULATED) == pytest.approx(np.corrcoef(REAL, SIMULATED)[0, 1])
    rng = np.random.default_rng(0)
    for _ in range(50):
        real, predicted = rng.integers(0, 5, (2, 6)) / 4  # with ties
        expected = violation_by_its_definition(real, predicted)
        assert mean_maximum_rank_violation(real, predicted) == pytest.approx(expected)
    assert mean_maximum_rank_violation(REAL, REAL) == 0
    assert math.isnan(pearson(REAL, np.full(6, 0.5)))


def test_an_agreement_is_told_with_both_questions_apart():
    found = correlation(PICK_CAN)
    assert 0.9 < found.pearson.low < found.pearson.high < 1
    assert found.mmrv.low < 0.02 < found.mmrv.high < 0.1
    assert found.at_least < found.pearson.low, "six policies say less about others than about themselves"
    said = sentences(found, ("reality", "simulation"))
    assert said[0].startswith(
        "simulation and reality, 6 policies: Pearson 0.98; of the true rates of these policies 0.9"
    )
    assert "rank violation 3.1 points" in said[1]
    assert correlation(PICK_CAN) == found, "the same seed gives the same interval"


def test_cells_weigh_alike_and_only_common_ones_count():
    def arm(**cells):
        return Arm(replicates=({name: Count(successes=s, episodes=n) for name, (s, n) in cells.items()},))

    def counts(first, second):
        return policy_counts({"a": (first, second)})[0]

    both = counts(arm(can=(9, 10), drawer=(1, 10)), arm(can=(3, 30), sponge=(5, 5)))
    assert both.rates == pytest.approx((0.9, 0.1))
    uneven = counts(arm(can=(90, 100), drawer=(1, 10)), arm(can=(1, 2), drawer=(1, 2)))
    assert uneven.rates == pytest.approx((0.5, 0.5))
    assert 20 <= uneven.first[1] < 40, "the mean of two cells is as uncertain as the smaller one makes it"
    whole = counts(Arm(replicates=({"": Count(successes=1, episodes=4)},)), arm(can=(1, 2), drawer=(0, 2)))
    assert whole.rates == pytest.approx((0.25, 0.25))
    with pytest.raises(InvalidRequestError, match=r"no cell is common to all .*\(a: can; a: drawer"):
        counts(arm(can=(1, 2)), arm(drawer=(1, 2)))


def test_rates_of_all_policies_are_over_the_same_cells():
    def arm(**cells):
        return Arm(replicates=({name: Count(successes=s, episodes=10) for name, s in cells.items()},))

    easy, both = arm(can=9), arm(can=9, drawer=1)
    found = policy_counts({"a": (both, both), "b": (both, easy), "c": (easy, both)})
    assert [policy.rates for policy in found] == [pytest.approx((0.9, 0.9))] * 3
    whole = Arm(replicates=({WHOLE: Count(successes=5, episodes=10)},))
    assert [p.rates for p in policy_counts({"a": (both, whole), "b": (easy, whole)})] == [(0.9, 0.5)] * 2
    assert [p.rates for p in policy_counts({"a": (whole, both), "b": (both, both)})] == [(0.5, 0.5)] * 2
    with pytest.raises(InvalidRequestError, match="the cells drawer, .* the first table has outcomes of b that name"):
        policy_counts({"a": (both, easy), "b": (whole, easy)})


def test_two_policies_are_refused():
    with pytest.raises(InvalidRequestError, match="at least 3 policies.*got 2"):
        correlation(PICK_CAN[:2])


def test_more_policies_are_planned_by_simulated_tables():
    found = correlation(PICK_CAN)
    needed = needed_policies(found, limit=0.0, tables=20)
    assert needed.policies is not None
    assert 3 < needed.policies <= 14
    never = needed_policies(found, limit=0.99, numbers=(3, 5), tables=10)
    assert never.policies is None
    assert "no number of policies up to that decides it" in never.sentence


# ------------------------------------------------------------------ tables of known truth


def truth(rng, number, rho):
    """Return true rates in both benchmarks: uniform from 0.1 to 0.9, so that the model is not that of the intervals."""
    from scipy.stats import norm

    one = rng.standard_normal(number)
    two = rho * one + math.sqrt(1 - rho**2) * rng.standard_normal(number)
    return 0.1 + 0.8 * norm.cdf(one), 0.1 + 0.8 * norm.cdf(two)


def bootstrap(rng, won, rollouts):
    """Return the percentile interval of Pearson's correlation over repeated rollouts, for comparison."""
    rates = (won + 0.5) / (rollouts + 1)
    drawn = rng.binomial(rollouts, rates, (500, *rates.shape)) / rollouts
    found = pearson(drawn[..., 0], drawn[..., 1])
    return np.quantile(found[np.isfinite(found)], [0.025, 0.975])


def coverage(number, rollouts, rho, tables, seed=0):
    """Return the shares of tables whose intervals hold: Pearson, its bootstrap, MMRV, and the bound of all policies."""
    rng, held = np.random.default_rng(seed), []
    for _ in range(tables):
        real, predicted = truth(rng, number, rho)
        won = rng.binomial(rollouts, np.stack([real, predicted], axis=-1))
        found = correlation(counted(won, (rollouts, rollouts)))
        true, violation = float(pearson(real, predicted)), float(mean_maximum_rank_violation(real, predicted))
        low, high = bootstrap(rng, won, rollouts)
        most = found.pearson.high if true < 0.999 else 1.0  # the grid of correlations ends at 0.998
        held.append((
            found.pearson.low <= true <= most, low <= true <= high,
            found.mmrv.low <= violation + 1e-9 and violation <= found.mmrv.high, found.at_least <= rho,
        ))  # fmt: skip
    return np.mean(held, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.7, 0.95, 1.0])
def test_intervals_hold_on_tables_of_known_truth(rho):
    shares = np.array([coverage(n, k, rho, 150) for n, k in ((3, 20), (5, 60), (8, 24))])
    assert shares[:, 0].min() >= 0.86
    assert shares[:, 2].min() >= 0.80
    assert shares[:, 3].min() >= 0.90


def main():
    """Print the table of docs/how-to/answers.md."""
    for number, rollouts in ((3, 20), (5, 20), (5, 60), (8, 24), (12, 50)):
        for rho in (0.0, 0.7, 0.95, 1.0):
            shares = " | ".join(f"{100 * share:.0f} %" for share in coverage(number, rollouts, rho, 200))
            print(f"| {number} x {rollouts} | {rho:g} | {shares} |", flush=True)


if __name__ == "__main__":
    main()


def test_cells_of_unequal_sizes_keep_their_rates():
    def arm(*cells):
        counts = {name: Count(successes=won, episodes=many) for name, (won, many) in zip("ab", cells, strict=True)}
        return Arm(replicates=(counts,))

    (found,) = policy_counts({"p": (arm((10, 20), (9, 20)), arm((2, 2), (12, 20)))})
    assert found.rates == pytest.approx((19 / 40, (1 + 12 / 20) / 2))
    assert found.second[1] == pytest.approx(4 / (1 / 2 + 1 / 20))
