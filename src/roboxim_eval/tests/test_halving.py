"""Successive halving keeps good policies, and only fresh scenes give the winner's rate without a bias."""

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, counted
from roboxim_eval.answers.halving import HalvingConfig, choose, sentences
from roboxim_eval.answers.moments import SceneComparison, summary
from roboxim_eval.statistics.rates import success_rate


def planted(rates, rng):
    """Return what plays policies of known rates; a scene is as hard for one as for another."""
    luck = rng.uniform(size=(len(rates), 10_000)) * 0.7 + rng.uniform(size=10_000) * 0.3
    levels = {name: np.quantile(luck[i], rate) for i, (name, rate) in enumerate(rates.items())}
    outcomes = {name: luck[i] < levels[name] for i, name in enumerate(rates)}
    calls = []

    def play(names, scenes):
        calls.append((tuple(names), scenes))
        return {name: outcomes[name][:scenes].tolist() for name in names}

    return play, outcomes, calls


def simulated(rates, config, searches):
    """Return (the winner's rate, its rate while choosing, its rate in fresh scenes, interval covers) of each search."""
    found = []
    for seed in range(searches):
        play, outcomes, _ = planted(rates, np.random.default_rng(seed))
        choice = choose(list(rates), play, config)
        fresh = success_rate(int(outcomes[choice.winner][-config.fresh :].sum()), config.fresh)
        true = rates[choice.winner]
        found.append((true, choice.choosing.rate, fresh.rate, fresh.low <= true <= fresh.high))
    return np.array(found)


def test_each_round_has_half_the_policies_and_twice_the_scenes():
    rates = dict(zip("abcdef", (0.1, 0.2, 0.99, 0.3, 0.5, 0.4), strict=True))
    play, _, calls = planted(rates, np.random.default_rng(0))
    choice = choose(list(rates), play, HalvingConfig(first=20))
    assert [(len(names), scenes) for names, scenes in calls] == [(6, 20), (3, 40), (2, 80)]
    assert choice.winner == "c"
    assert choice.rollouts == 3 * 20 + 1 * 40 + 2 * 80
    assert next(iter(choice.rounds[0].successes)) == "c"
    told = sentences(choice, success_rate(39, 40))
    assert told[0].startswith("round 1, 20 scenes: c ")
    assert "c is chosen; in fresh scenes it succeeds in 39 of 40" in told[3]


def test_numbers_of_things_are_in_the_singular_for_one():
    choice = choose(["a", "b"], lambda names, scenes: {name: [True] * scenes for name in names}, HalvingConfig(first=1))
    first, _, chose = sentences(choice, success_rate(1, 1))
    assert first == "round 1, 1 scene: a 1, b 1"
    assert "in the 1 scene that chose it: 100 %" in chose
    one = SceneComparison(scene=0, outcome=(True, True), diverge_at=None)
    assert summary(("a", "b"), [one])[0].startswith("1 scene: both")
    assert summary(("a", "b"), [one, one])[0].startswith("2 scenes: both")
    assert [counted(number, "policy", "policies") for number in (0, 1, 2)] == ["0 policies", "1 policy", "2 policies"]


def test_the_first_named_wins_among_equals():
    choice = choose(["b", "a"], lambda names, scenes: {name: [True] * scenes for name in names}, HalvingConfig())
    assert choice.winner == "b"
    assert "b is chosen, though a succeeded as often; in fresh" in sentences(choice, success_rate(39, 40))[1]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rates", "bias", "regret"),
    [
        (dict.fromkeys("abcdefgh", 0.7), 0.03, 0.001),
        ({name: 0.5 + 0.05 * i for i, name in enumerate("abcdefgh")}, 0.005, 0.07),
        ({name: 0.9 if name == "c" else 0.5 for name in "abcdefgh"}, 0.0, 0.03),
    ],
)
def test_fresh_scenes_have_no_bias_and_their_interval_covers(rates, bias, regret):
    true, choosing, fresh, covers = simulated(rates, HalvingConfig(), 600).T
    assert (choosing - true).mean() > bias - 0.015
    assert abs((fresh - true).mean()) < 0.012
    assert covers.mean() >= 0.93
    assert max(rates.values()) - true.mean() <= regret + 0.02


def test_one_policy_or_two_of_a_name_are_no_choice():
    for names in (["a"], ["a", "a"], []):
        with pytest.raises(ConfigError, match="at least two policies of different names"):
            choose(names, lambda *_: {}, HalvingConfig())
    with pytest.raises(ConfigError, match="first and fresh must be >= 1"):
        HalvingConfig(first=0)


if __name__ == "__main__":
    print("| policies | rate of the chosen | in the scenes that chose it | in fresh scenes | interval covers |")
    print("| --- | --- | --- | --- | --- |")
    for words, rates in (
        ("8 of 70 %", dict.fromkeys("abcdefgh", 0.7)),
        ("50, 55, ... 85 %", {name: 0.5 + 0.05 * i for i, name in enumerate("abcdefgh")}),
        ("one of 90 %, 7 of 50 %", {name: 0.9 if name == "c" else 0.5 for name in "abcdefgh"}),
        ("32 of 50 to 81 %", {f"p{i}": 0.5 + 0.01 * i for i in range(32)}),
    ):
        true, choosing, fresh, covers = simulated(rates, HalvingConfig(), 2000).T
        print(f"| {words} | {true.mean():.1%} | {choosing.mean():.1%} | {fresh.mean():.1%} | {covers.mean():.1%} |")
