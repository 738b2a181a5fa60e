"""Intervals of a condition's success rate: how often they hold, over simulated experiments."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.replicates import condition_difference, condition_rate, more_trainings
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_eval.statistics.training_spread import Trainings, mean_rate_interval

EQUAL = (20,) * 6
UNEQUAL = (8, 12, 20, 20, 40, 10)
RATES = (0.5, 0.8, 0.9, 0.96, 0.985)
SPREADS = (0.0, 0.05, 0.1, 0.15)
EXPERIMENTS = 2000
METHODS = ("student", "beta_binomial")


def trainings(rng, family, rate, spread, shape):
    """Return the rates of trainings, and their mean over all trainings that there could be."""
    if not spread:
        return np.full(shape, rate), rate
    if family == "beta":
        size = rate * (1 - rate) / spread**2 - 1
        return rng.beta(rate * size, (1 - rate) * size, shape), rate
    many = np.clip(np.random.default_rng(5).normal(rate, spread, 400_000), 0, 1)
    return np.clip(rng.normal(rate, spread, shape), 0, 1), float(many.mean())


def experiment(rng, means, cells):
    """Return an arm whose trainings have these mean rates, in cells of different difficulty."""
    offsets = np.linspace(-0.8, 0.8, len(cells))
    rows = []
    for mean in means:
        counts = rng.binomial(cells, np.clip(mean + offsets * min(mean, 1 - mean), 0, 1))
        rows.append(
            {str(i): Count(successes=int(k), episodes=n) for i, (k, n) in enumerate(zip(counts, cells, strict=True))}
        )
    return Arm(replicates=tuple(rows))


def coverage(family, rate, spread, replicates, cells, *, experiments=EXPERIMENTS):
    """Return, for each method, the share of experiments whose interval holds the mean rate, and the mean width."""
    rng = np.random.default_rng([replicates, round(1000 * rate), round(1000 * spread)])
    means, truth = trainings(rng, family, rate, spread, (experiments, replicates))
    arms = [experiment(rng, row, cells) for row in means]
    found = {}
    for method in METHODS:
        intervals = [condition_rate(replace(arm, intervals=method)) for arm in arms]
        held = np.mean([one.low <= truth <= one.high for one in intervals])
        found[method] = held, np.mean([one.high - one.low for one in intervals])
    return found


def points():
    return [(r, s) for r in RATES for s in SPREADS if s**2 < 0.9 * r * (1 - r)]


@pytest.mark.slow
@pytest.mark.parametrize("cells", [EQUAL, UNEQUAL], ids=["equal", "unequal"])
@pytest.mark.parametrize("family", ["beta", "normal"])
@pytest.mark.parametrize("replicates", [3, 5])
def test_intervals_of_conditions_hold_at_every_rate_and_spread(replicates, family, cells):
    """The table of docs/explanation/statistics.md: run this file as a program."""
    found = {point: coverage(family, *point, replicates, cells)["beta_binomial"][0] for point in points()}
    assert min(found.values()) >= 0.94, found


def test_student_alone_misses_the_mean_near_the_ceiling_and_the_union_holds_it():
    found = coverage("beta", 0.96, 0.1, 3, EQUAL, experiments=150)
    assert found["student"][0] < 0.75
    assert found["beta_binomial"][0] >= 0.94


@pytest.mark.parametrize("rates", [(1.0, 1.0, 1.0), (0.9, 1.0, 0.95), (0.2, 0.6, 0.9), (0.0, 0.0)])
def test_the_interval_mirrors_and_narrows_with_trainings(rates):
    def interval(rates, **options):
        return mean_rate_interval(Trainings(rates=tuple(rates), episodes=40), **options)

    low, high = interval(rates)
    assert 0 <= low < max(np.mean(rates), 0.001)
    assert high <= 1
    assert interval([1 - rate for rate in rates]) == pytest.approx((1 - high, 1 - low), abs=1e-9)
    more = interval(rates * 3)
    assert more[1] - more[0] < high - low
    assert interval(rates, confidence=0.99)[0] < low


# ------------------------------------------------------------------ differences


DIFFERENCES = tuple((rate, rate) for rate in RATES) + (
    (1.0, 0.9), (0.98, 0.88), (0.95, 0.85), (0.9, 0.8), (0.96, 0.8), (0.6, 0.5), (0.1, 0.0),
)  # fmt: skip
MARGIN = 0.1


def difference_points():
    """Return rates of two conditions that the spread does not take out of 0..1; a rate of 0 or 1 has none."""
    return [
        (one, two, spread)
        for one, two in DIFFERENCES
        for spread in SPREADS
        if all(rate in (0, 1) or spread**2 < 0.9 * rate * (1 - rate) for rate in (one, two))
    ]


def verdicts(family, one, two, spread, replicates, cells, *, experiments=EXPERIMENTS):
    """Return, without and with the model of differences: shares of covering intervals, false verdicts, and "as good".

    A false verdict is "lower" or "higher" of equal conditions, or "as good" of conditions that differ by the margin.
    """
    rng = np.random.default_rng([replicates, *(round(1000 * x) for x in (one, two, spread))])
    means, truths = zip(
        *(
            trainings(rng, family, rate, spread if 0 < rate < 1 else 0.0, (experiments, replicates))
            for rate in (one, two)
        ),
        strict=True,
    )
    truth, found = truths[0] - truths[1], []
    for rows in zip(*means, strict=True):
        modelled = condition_difference(*(experiment(rng, row, cells) for row in rows))
        for difference in (replace(modelled, model=None), modelled):
            interval, decided = difference.interval(), difference.p_value <= 0.05
            as_good = not decided and difference.p_as_good(MARGIN) <= 0.05
            wrong = decided if abs(truth) < 1e-9 else as_good and abs(truth) >= MARGIN - 1e-9
            found.append((interval.low - 1e-9 <= truth <= interval.high + 1e-9, wrong, as_good))
    return np.array(found).reshape(experiments, 2, 3).mean(axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("replicates", [3, 5])
@pytest.mark.parametrize(("family", "cells"), [("beta", EQUAL), ("normal", UNEQUAL)], ids=["beta", "normal"])
def test_differences_hold_and_verdicts_are_seldom_false_at_every_rate_and_spread(replicates, family, cells):
    """The table of docs/explanation/statistics.md: run this file as a program."""
    found = {point: verdicts(family, *point, replicates, cells)[1] for point in difference_points()}
    assert min(row[0] for row in found.values()) >= 0.935, found  # Student's t alone at middle rates, see the docs
    assert max(row[1] for row in found.values()) <= 0.065, found


def test_student_alone_calls_a_policy_that_fails_as_good_as_one_that_never_does_and_the_model_does_not():
    student, model = verdicts("beta", 1.0, 0.9, 0.15, 3, EQUAL, experiments=150)
    assert student[1] > 0.15
    assert model[1] <= 0.05
    assert student[0] < 0.9 <= model[0]


def test_the_model_of_a_difference_mirrors_and_says_how_many_trainings_would_decide():
    arms = [experiment(np.random.default_rng(1), means, EQUAL) for means in ((1.0, 1.0, 1.0), (0.97, 0.95, 0.96))]
    found, other = condition_difference(*arms), condition_difference(*reversed(arms))
    interval, mirrored = found.interval(), other.interval()
    assert (interval.low, interval.high) == pytest.approx((-mirrored.high, -mirrored.low))
    assert found.p_as_good(MARGIN) == pytest.approx(other.p_as_good(MARGIN))
    assert found.p_as_good(MARGIN) > 0.05 >= replace(found, model=None).p_as_good(MARGIN)
    more = more_trainings(found, MARGIN)
    grown = [Arm(replicates=(arm.replicates * (more + 3))[: more + 3]) for arm in arms]
    assert 0 < more < 10
    assert condition_difference(*grown).p_as_good(MARGIN) <= 0.05


def test_conditions_of_the_same_trainings_are_modelled_by_the_scenes_that_they_lose_and_gain():
    arm = experiment(np.random.default_rng(1), (0.97, 0.98, 0.96), EQUAL)
    scenes = arm.pooled.episodes // 3
    same = [Pairs(both=scenes - 4, first=0, second=0, neither=4)] * 3
    apart, together = (condition_difference(arm, arm, same, same_trainings=same_ones) for same_ones in (False, True))
    assert together.p_as_good(MARGIN) < 0.05 < apart.p_as_good(MARGIN)
    assert condition_difference(arm, arm, same_trainings=True).model is None, "without pairs nothing is known of it"


@pytest.mark.parametrize("alpha", [0.05, 0.01])
def test_the_interval_of_a_modelled_difference_is_within_the_margin_as_its_p_value_says(alpha):
    rng = np.random.default_rng(4)
    within = 0
    for _ in range(60):
        arms = [experiment(rng, rng.uniform(0.9, 1.0, 6), EQUAL) for _ in range(2)]
        found = condition_difference(*arms)
        interval = found.interval(confidence=1 - 2 * alpha)
        inside = interval.low > -MARGIN and interval.high < MARGIN
        assert (found.p_as_good(MARGIN) <= alpha) == inside
        within += inside
    assert 0 < within < 60, "both answers occur"


def main():
    """Print the tables of docs/explanation/statistics.md."""
    for rate, spread in points():
        row = [f"{100 * rate:g} %", f"{100 * spread:g}"]
        for replicates in (3, 5):
            cases = [
                coverage(family, rate, spread, replicates, cells)
                for family in ("beta", "normal") for cells in (EQUAL, UNEQUAL)
            ]  # fmt: skip
            for method in METHODS:
                least = min(case[method][0] for case in cases)
                row.append(f"{100 * least:.1f} % ({100 * np.mean([case[method][1] for case in cases]):.0f})")
        print("| " + " | ".join(row) + " |", flush=True)  # noqa: T201
    for one, two, spread in difference_points():
        row = [f"{100 * one:g}, {100 * two:g} %", f"{100 * spread:g}"]
        for replicates in (3, 5):
            cases = [verdicts(f, one, two, spread, replicates, c) for f, c in (("beta", EQUAL), ("normal", UNEQUAL))]
            for method in range(2):
                least, most = (f([case[method][n] for case in cases]) for n, f in ((0, min), (1, max)))
                good = f", {100 * np.mean([case[method][2] for case in cases]):.0f}" if one == two else ""
                row.append(f"{100 * least:.1f}, {100 * most:.1f}{good}")
        print("| " + " | ".join(row) + " |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
