"""Intervals of a condition's success rate: how often they hold, over simulated experiments."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_eval.statistics.replicates import condition_rate
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_eval.statistics.training_spread import mean_rate_interval

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
        intervals = [condition_rate(replace(arm, rate_interval=method)) for arm in arms]
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
    low, high = mean_rate_interval(rates, 40)
    assert 0 <= low < max(np.mean(rates), 0.001)
    assert high <= 1
    assert mean_rate_interval([1 - rate for rate in rates], 40) == pytest.approx((1 - high, 1 - low), abs=1e-9)
    more = mean_rate_interval(rates * 3, 40)
    assert more[1] - more[0] < high - low
    wider = mean_rate_interval(rates, 40, confidence=0.99)
    assert wider[0] < low


def main():
    """Print the table of docs/explanation/statistics.md."""
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


if __name__ == "__main__":
    main()
