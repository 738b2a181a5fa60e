"""Search for failing regions: planted boxes are found with fewer points, and policies without one have none."""

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_eval.answers.regions import Factor, SearchConfig, failing_box, search, sobol

FACTORS = (
    Factor(name="x", lower=0.4, upper=0.6, words="the object", edges=("near edge of its area", "far edge of its area")),
    Factor(name="y", lower=-0.15, upper=0.15, words="the object", edges=("right edge", "left edge")),
    Factor(name="light", lower=1.6, upper=3.0, words="light intensity"),
)
PLANTED = {
    "one border": {"x": (0.4, 0.45)},
    "two factors": {"x": (0.4, 0.48), "light": (1.6, 2.2)},
    "a corner": {"y": (0.02, 0.15), "light": (2.3, 3.0)},
}


def oracle_of(region, rng, rate=0.95, else_rate=0.05):
    """Return an oracle that fails in a region with a probability, and elsewhere with another one."""
    names = [factor.name for factor in FACTORS]

    def oracle(points):
        inside = np.ones(len(points), bool)
        for name, (low, high) in region.items():
            values = points[:, names.index(name)]
            inside &= (values >= low) & (values <= high)
        return list(map(bool, rng.random(len(points)) < np.where(inside, rate, else_rate)))

    return oracle


def covered(bounds, region):
    """Return the share of a region's volume that a box covers."""
    share = 1.0
    for factor in FACTORS:
        low, high = region.get(factor.name, (factor.lower, factor.upper))
        a, b = bounds.get(factor.name, (factor.lower, factor.upper))
        share *= max(0.0, min(high, b) - max(low, a)) / (high - low)
    return share


@pytest.mark.thorough
@pytest.mark.parametrize("name", PLANTED)
def test_planted_regions_are_found_and_confirmed(name):
    found = []
    for seed in range(20):
        regions = search(oracle_of(PLANTED[name], np.random.default_rng(seed)), FACTORS, SearchConfig(seed=seed))
        found.append(any(one.confirmed and covered(one.bounds, PLANTED[name]) >= 0.6 for one in regions))
    assert np.mean(found) >= 0.8


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [0.0, 0.2, 0.5])
def test_policies_without_a_region_have_none_in_19_of_20_searches(rate):
    false = 0
    for seed in range(100):
        regions = search(oracle_of({}, np.random.default_rng(seed), rate, rate), FACTORS, SearchConfig(seed=seed))
        false += any(one.confirmed for one in regions)
    assert false <= 5


def test_a_region_is_named_in_words():
    oracle = oracle_of(PLANTED["two factors"], np.random.default_rng(3), 1.0, 0.0)
    region = search(oracle, FACTORS, SearchConfig(seed=3, first=128, rounds=6, per_round=32))[0]
    assert region.words.startswith("the object closer than ")
    assert "cm to the near edge of its area and light intensity under 2" in region.words
    assert region.inside[0] >= 10
    assert region.outside[0] <= 2


def test_points_without_a_scene_are_left_out():
    def oracle(points):
        return [None if x > 0.55 else bool(x < 0.44) for x in points[:, 0]]

    assert search(oracle, FACTORS)[0].confirmed
    assert search(lambda points: [None] * len(points), FACTORS) == []


def test_what_cannot_be_searched_is_refused():
    with pytest.raises(ConfigError, match="at least one factor"):
        search(lambda points: [], ())
    with pytest.raises(ConfigError, match="first"):
        SearchConfig(first=2)
    assert failing_box(np.zeros((20, 2)), np.zeros(20, bool)) is None
    assert sobol(5, 2, 0).shape == (5, 2)


def rollouts_until(name, seeds, refine):
    """Return the mean number of points until 90 % of a region are in the box, at most 512."""
    needed = []
    for seed in range(seeds):
        oracle = oracle_of(PLANTED[name], np.random.default_rng(seed), 1.0, 0.0)
        for total in (48, 64, 96, 128, 192, 256, 384, 512):
            config = SearchConfig(
                seed=seed, first=32 if refine else total, rounds=(total - 32) // 16 if refine else 0, regions=1
            )  # fmt: skip
            if any(covered(one.bounds, PLANTED[name]) >= 0.9 for one in search(oracle, FACTORS, config)):
                break
        needed.append(total)
    return float(np.mean(needed))


def main():
    """Print the tables of docs/how-to/answers.md."""
    for name in PLANTED:
        refined, plain = (rollouts_until(name, 20, refine) for refine in (True, False))
        print(f"| {name} | {refined:.0f} | {plain:.0f} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
