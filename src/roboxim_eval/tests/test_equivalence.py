"""Verdicts "as good": the p value of two one-sided tests, and its adjustment for all comparisons of a file."""

import math
from dataclasses import replace

import numpy as np
import pytest
from planted_cards import shipped

from roboxim_core.episode import EpisodeResult
from roboxim_eval.experiments.analysis import Outcomes, analyse
from roboxim_eval.report.evaluation import PolicyRun, comparisons
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import ConditionDifference, condition_difference
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_eval.statistics.verdicts import checkpoint_verdict, condition_verdict

MARGIN = 0.10


def over(differences, *, successes=1_000_000, episodes=1_250_000):
    """Return a difference whose rollouts leave hardly any doubt, so that the trainings decide."""
    return ConditionDifference(differences=differences, rollouts=(success_rate(successes, episodes),) * 2)


# ------------------------------------------------------------------ the p value


def test_the_p_value_over_trainings_is_that_of_two_t_tests():
    from scipy.stats import ttest_1samp

    rng = np.random.default_rng(1)
    for replicates in (3, 5, 9):
        values = tuple(rng.normal(0.03, 0.04, replicates))
        above = ttest_1samp(values, -MARGIN, alternative="greater").pvalue
        below = ttest_1samp(values, MARGIN, alternative="less").pvalue
        assert over(values).p_as_good(MARGIN) == pytest.approx(max(above, below))


@pytest.mark.parametrize("alpha", [0.05, 0.01, 0.05 / 16])
def test_the_p_value_is_the_alpha_at_which_the_interval_is_within_the_margin(alpha):
    rng = np.random.default_rng(2)
    within = 0
    for _ in range(100):
        first, second = rng.binomial(360, (0.83, 0.85))
        found = ConditionDifference(
            differences=tuple(rng.normal((first - second) / 360, rng.choice((0.0, 0.003, 0.02)), 3)),
            rollouts=(success_rate(int(first), 360), success_rate(int(second), 360)),
        )
        interval = found.interval(confidence=1 - 2 * alpha)
        inside = interval.low > -MARGIN and interval.high < MARGIN
        assert (found.p_as_good(MARGIN) <= alpha) == inside
        within += inside
    assert 5 < within < 95, "both answers occur"


def test_trainings_that_agree_leave_the_doubt_of_their_rollouts():
    same = ConditionDifference(differences=(0.0,) * 3, rollouts=(success_rate(96, 120),) * 2)
    assert 0.01 < same.p_as_good(MARGIN) < 0.05
    assert over((0.2, 0.2, 0.2)).p_as_good(MARGIN) > 0.5
    assert ConditionDifference(differences=(0.0,), rollouts=(success_rate(96, 120),) * 2).p_as_good(MARGIN) == 1.0


def test_the_p_value_of_two_checkpoints_is_that_of_their_interval():
    old = paired_difference(Pairs(both=500, first=30, second=40, neither=91), score=False)
    half = (old.value - old.low) / 1.959964
    z = (MARGIN + old.value) / half
    assert old.p_as_good(MARGIN) == pytest.approx(math.erfc(z / math.sqrt(2)) / 2)
    for pairs in (Pairs(both=500, first=30, second=40, neither=91), Pairs(both=50, first=0, second=2, neither=8)):
        found = paired_difference(pairs)
        p = found.p_as_good(MARGIN)
        low, high = found.narrowed(p)
        assert min(MARGIN + low, MARGIN - high) == pytest.approx(0, abs=1e-6)
        assert found.narrowed(0.025) == pytest.approx((found.low, found.high))
    assert paired_difference(Pairs(both=0, first=8, second=0, neither=2)).p_as_good(MARGIN) > 0.5


@pytest.mark.parametrize("scenes", [20, 60, 120])
def test_a_checkpoint_that_solves_a_tenth_less_is_seldom_called_as_good(scenes):
    """By all outcomes with their probabilities, at every share of scenes that the worse one alone solves."""
    from scipy.stats import multinomial

    outcomes = [
        (b, c) for b in range(scenes + 1) for c in range(scenes + 1 - b) if abs(b - c) <= MARGIN * scenes
    ]  # fmt: skip
    said = [
        paired_difference(Pairs(both=scenes - b - c, first=b, second=c, neither=0)).p_as_good(MARGIN) <= 0.05
        for b, c in outcomes
    ]
    for gained in (0.0, 0.01, 0.05, 0.1, 0.2, 0.4):
        rates = (gained, gained + MARGIN, max(0.0, 1 - 2 * gained - MARGIN))
        chances = multinomial.pmf([(b, c, scenes - b - c) for b, c in outcomes], scenes, rates)
        assert chances[np.array(said)].sum() <= 0.055


# ------------------------------------------------------------------ sentences


def test_a_sentence_names_the_adjustment():
    alone = over((0.01, -0.02, 0.0))
    said = condition_verdict("a", "b", alone)
    assert said.kind == "as_good"
    assert said.sentence.endswith("(90 % interval -3 to +2), over 3 trainings each.")
    among = condition_verdict("a", "b", alone, p_as_good=0.031, comparisons=4)
    assert among.kind == "as_good"
    assert among.sentence.endswith("over 3 trainings each (p 0.031 after adjustment for 4 comparisons).")
    assert "(p below 0.001 after" in condition_verdict("a", "b", alone, p_as_good=1e-9, comparisons=4).sentence
    lost = condition_verdict("a", "b", alone, p_as_good=0.12, comparisons=16)
    assert (lost.kind, lost.p_as_good) == ("cannot_tell", 0.12)
    assert lost.sentence.startswith(
        "Cannot tell whether a is as good as b within 10 points: the difference is +0 points (90 % interval -3 to +2), "
        "but p is 0.12 after adjustment for 16 comparisons, over 3 trainings each; "
    )


def test_the_file_s_alpha_decides():
    found = over((0.02, -0.04, 0.0))
    assert 0.01 < found.p_as_good(MARGIN) < 0.05
    assert condition_verdict("a", "b", found).kind == "as_good"
    strict = condition_verdict("a", "b", found, alpha=0.01)
    assert strict.kind == "cannot_tell"
    assert "98 % interval" in condition_verdict("a", "b", over((0.002, -0.004, 0.0)), alpha=0.01).sentence
    pairs = Pairs(both=90, first=10, second=8, neither=10)
    assert 0.001 < paired_difference(pairs).p_as_good(MARGIN) < 0.02
    assert checkpoint_verdict("a", "b", pairs).kind == "as_good"
    assert checkpoint_verdict("a", "b", pairs, alpha=0.001).kind == "cannot_tell"


def test_a_difference_within_the_margin_is_called_so_after_adjustment_alone():
    small = over((0.040, 0.041, 0.042))
    alone = condition_verdict("a", "b", small, p_value=0.01)
    assert alone.sentence.endswith("over 3 trainings each; the difference is within the margin of 10 points.")
    among = condition_verdict("a", "b", small, p_value=0.01, p_as_good=0.2, comparisons=16)
    assert (among.kind, among.sentence[-24:]) == ("higher", ", over 3 trainings each.")


# ------------------------------------------------------------------ several comparisons


def robustness(rates, *, each=40, only=None):
    """Return the analysis of `robustness` with counts of each training, by condition; others are as nominal."""
    design = shipped("robustness", replicates=3, per_cell=each)
    if only:
        compare = tuple(one for one in design.config.compare if one.first == only)
        design = replace(design, config=replace(design.config, compare=compare))
    (cell,) = design.cells
    counts = {
        name: [{cell.key: Count(successes=n, episodes=each)} for n in rates.get(name, rates["nominal"])]
        for name in design.config.conditions
    }
    return analyse(design, Outcomes(counts=counts))


def test_as_good_is_adjusted_for_all_comparisons_of_the_file():
    worse = {one.first: (37, 40, 39) for one in shipped("robustness").config.compare}
    rates = {**worse, "nominal": (39, 40, 40), "light": (39, 40, 40)}
    (alone,) = (one.verdict for one in robustness(rates, only="start").comparisons)
    assert alone.kind == "as_good"
    assert "adjustment" not in alone.sentence
    found = {one.config.first: one.verdict for one in robustness(rates).comparisons}
    assert found["start"].p_as_good == pytest.approx((len(worse) - 1) * alone.p_as_good)
    assert found["start"].kind == "cannot_tell"
    assert f"after adjustment for {len(worse)} comparisons" in found["start"].sentence
    assert found["light"].kind == "as_good", "equal counts are shown to be as good all the same"


def test_each_comparison_has_holm_s_p_value():
    rates = {"nominal": (39, 40, 40), "start": (37, 40, 39), "camera": (38, 40, 40), "light": (20, 10, 30)}
    found = {one.config.first: one.verdict.p_as_good for one in robustness(rates).comparisons}
    alone = {name: robustness(rates, only=name).comparisons[0].verdict.p_as_good for name in found}
    assert tuple(found.values()) == pytest.approx(holm(list(alone.values())))


def test_policies_of_an_evaluation_are_adjusted_too():
    def run(name, failed):
        results = [
            EpisodeResult(episode_id=f"e{i}", index=i, outcome="failure" if i in failed else "success")
            for i in range(120)
        ]
        return PolicyRun(policy=name, results=results)

    first, *others = (run("a", {0, 1, 2}), *(run(name, {3, 10, 15, 16}) for name in "bcdefghi"))
    (alone,) = comparisons([first, others[0]])
    among = comparisons([first, *others])
    assert alone.kind == "as_good"
    assert among[0].p_as_good == pytest.approx(min(1.0, len(others) * alone.p_as_good))
    assert "after adjustment for 8 comparisons" in among[0].sentence


@pytest.mark.parametrize(
    ("excluded", "said"), [(0, "scenes that both met"), (6, "without pairing their scenes (p ")]
)  # fmt: skip
def test_scenes_that_two_checkpoints_share_are_not_called_different_ones(excluded, said):
    design = shipped("skill_object", replicates=1, per_cell=20)
    keys = [cell.key for cell in design.cells]
    numbers = dict.fromkeys(keys, 20) | {key: 20 - excluded for key in keys[::2]}
    counts = {
        name: [{key: Count(successes=number // 2, episodes=number) for key, number in numbers.items()}]
        for name in design.config.conditions
    }
    pairs = {n: [Pairs(both=20, first=5, second=5, neither=20)] for n in range(len(design.config.compare))}
    met = analyse(design, Outcomes(counts=counts, pairs=pairs)).comparisons[0].verdict.sentence
    assert said in met
    assert "different scenes" not in met
    assert "on different scenes (p " in analyse(design, Outcomes(counts=counts)).comparisons[0].verdict.sentence


@pytest.mark.slow
def test_any_false_as_good_among_16_comparisons_is_rare():
    """Every change costs 10 points, the margin: without the adjustment a quarter of all experiments misses one."""
    rng = np.random.default_rng(3)
    names = [one.first for one in shipped("robustness", replicates=3, per_cell=120).config.compare]
    wrong = alone = 0
    for _ in range(1000):
        won = {name: rng.binomial(120, 0.8 if name in names else 0.9, size=3).tolist() for name in ("nominal", *names)}
        found = robustness(won, each=120).comparisons
        wrong += any(one.verdict.kind == "as_good" for one in found)
        arms = {
            name: Arm(replicates=tuple({"all": Count(successes=n, episodes=120)} for n in row))
            for name, row in won.items()
        }
        alone += any(
            condition_difference(arms[name], arms["nominal"]).p_as_good(MARGIN) <= 0.05 for name in names
        )  # fmt: skip
    assert wrong / 1000 <= 0.06
    assert alone / 1000 > 0.15, "what the adjustment prevents"
