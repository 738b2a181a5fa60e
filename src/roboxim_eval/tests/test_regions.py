"""Search for failing regions: planted boxes are found with fewer points, and policies without one have none."""

import re
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_eval.answers import regions
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


def oracle_of(region, rng, rate=0.95, else_rate=0.05, factors=FACTORS):
    """Return an oracle that fails in a region with a probability, and elsewhere with another one."""
    names = [factor.name for factor in factors]

    def oracle(points):
        inside = np.ones(len(points), bool)
        for name, (low, high) in region.items():
            values = points[:, names.index(name)]
            inside &= (values >= low) & (values <= high)
        return list(map(bool, rng.random(len(points)) < np.where(inside, rate, else_rate)))

    return oracle


def covered(bounds, region, factors=FACTORS):
    """Return the share of a region's volume that a box covers."""
    share = 1.0
    for factor in factors:
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


def test_a_range_that_ends_at_no_edge_is_named_with_its_axis_and_unit():
    place = replace(FACTORS[0], unit="m", axis="x")
    found = search(oracle_of({"x": (0.48, 0.52)}, np.random.default_rng(0), 1.0, 0.0), [place], SearchConfig(first=64))
    assert re.fullmatch(r"x of the object from 0\.4\d* to 0\.5\d* m", found[0].words)


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


# ------------------------------------------------------------------ against plain samples

EIGHT = (*FACTORS, *(Factor(name=f"other_{number}", lower=0.0, upper=1.0) for number in range(5)))
ROWS = {
    "one border of three factors": (FACTORS, PLANTED["one border"]),
    "two of three factors": (FACTORS, PLANTED["two factors"]),
    "a corner of two of three factors": (FACTORS, PLANTED["a corner"]),
    "one border of eight factors": (EIGHT, PLANTED["one border"]),
    "two of eight factors": (EIGHT, PLANTED["two factors"]),
    "a small corner of two of eight factors": (EIGHT, {"x": (0.4, 0.46), "light": (1.6, 2.02)}),
}
"""Name to factors and planted region."""


def uniform(number, dimensions, seed):
    """Return points of a plain random sample, in place of a Sobol sequence."""
    return np.random.default_rng([seed, 1]).random((number, dimensions))


def searched(method, row, rng, rates, total, seed):
    """Search with a number of points before the confirmation, by ``mine``, ``sobol`` or ``random``."""
    factors, region = ROWS[row]
    first, rounds = (32, (total - 32) // 16) if method == "mine" else (total, 0)
    config = SearchConfig(seed=seed, first=first, rounds=rounds, regions=1)
    with pytest.MonkeyPatch.context() as patch:
        if method == "random":
            patch.setattr(regions, "sobol", uniform)
        return search(oracle_of(region, rng, *rates, factors=factors), factors, config)


def found_share(row, method, searches, total=96):
    """Return the shares of searches that confirm a box, and that confirm one that is mostly the region.

    Failures are noisy: 95 % in the region, 5 % elsewhere. A box is mostly the region if its intersection with the
    region is at least 60 % of their union.
    """
    confirmed, matching = 0, 0
    for seed in range(searches):
        for one in searched(method, row, np.random.default_rng(seed), (0.95, 0.05), total, seed):
            confirmed += one.confirmed
            matching += one.confirmed and overlap(one.bounds, row) >= 0.6
    return confirmed / searches, matching / searches


def overlap(bounds, row):
    """Return the intersection of a box and a planted region, as a share of their union."""
    factors, region = ROWS[row]
    shared = covered(bounds, region, factors) * volume(region, factors)
    return shared / (volume(region, factors) + volume(bounds, factors) - shared)


def volume(box, factors):
    """Return a box's share of the factors' ranges."""
    share = 1.0
    for factor in factors:
        low, high = box.get(factor.name, (factor.lower, factor.upper))
        share *= (high - low) / (factor.upper - factor.lower)
    return share


def rollouts_until(row, method, searches):
    """Return the mean number of points until a box overlaps a region by 80 %, at most 512; failures are certain."""
    needed = []
    for seed in range(searches):
        for total in (48, 64, 96, 128, 192, 256, 384, 512):
            found = searched(method, row, np.random.default_rng(seed), (1.0, 0.0), total, seed)
            if any(overlap(one.bounds, row) >= 0.8 for one in found):
                break
        needed.append(total)
    return float(np.mean(needed))


@pytest.mark.thorough
def test_a_search_finds_more_than_as_many_random_points():
    rows = ("two of three factors", "two of eight factors")
    mined, plain = (np.mean([found_share(row, method, 40)[1] for row in rows]) for method in ("mine", "random"))
    assert mined > plain


def main():
    """Print the table of docs/how-to/answers.md."""
    for row, (factors, region) in ROWS.items():
        cells = [row, f"{100 * volume(region, factors):.0f} %"]
        for method in ("mine", "sobol", "random"):
            _, matching = found_share(row, method, 200)
            cells.append(f"{100 * matching:.0f} %, {rollouts_until(row, method, 50):.0f}")
        print(f"| {' | '.join(cells)} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
