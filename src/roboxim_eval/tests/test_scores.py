"""Scores and verdicts of experiments, on simulated tables of policies with planted behaviour."""

import math

import numpy as np
import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_eval.statistics.multiple import bradley_terry, compact_letters, holm
from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.power import Design, detectable, power
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import (
    ConditionDifference,
    Interval,
    condition_difference,
    condition_rate,
    condition_ratio,
    mean_interval,
    more_trainings,
)
from roboxim_eval.statistics.scores import ExperimentScore, dimension_scores, relative_score, scores, substitutions
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_eval.statistics.verdicts import checkpoint_verdict, condition_verdict

HELD_OUT = tuple(f"held-out {i}" for i in range(6))
SEEN = tuple(f"seen {i}" for i in range(12))


def arm(rng, rates, *, replicates=5, each=20, spread=0.0):
    """Simulate an arm: each training shifts all rates on the logit, by `spread` points at a rate of 0.8."""
    found = []
    for _ in range(replicates):
        shift = rng.normal() * spread / 0.16
        chances = {cell: 1 / (1 + math.exp(-(math.log(p / (1 - p)) + shift))) for cell, p in rates.items()}
        found.append({cell: Count(successes=int(rng.binomial(each, p)), episodes=each) for cell, p in chances.items()})
    return Arm(replicates=tuple(found))


def flat(rate, cells=HELD_OUT):
    return dict.fromkeys(cells, rate)


def one_cell(rate):
    """All rollouts of a training in one cell: as good for a simulation as many equal cells, and quicker."""
    return {"all": rate}


def exactly(rate, *, replicates=5, each=20, cells=HELD_OUT):
    count = Count(successes=round(rate * each), episodes=each)
    return Arm(replicates=(dict.fromkeys(cells, count),) * replicates)


# ------------------------------------------------------------------ conditions


@pytest.mark.parametrize("replicates", [3, 5])
@pytest.mark.thorough
def test_equal_conditions_seldom_differ_although_trainings_do(replicates):
    rng = np.random.default_rng(replicates)
    alarms = pooled = 0
    for _ in range(1000):
        arms = [arm(rng, one_cell(0.8), each=120, replicates=replicates, spread=0.05) for _ in range(2)]
        alarms += condition_verdict("a", "b", condition_difference(*arms)).kind in ("lower", "higher")
        one, two = (a.pooled for a in arms)
        half = 1.96 * math.sqrt(2 * 0.16 / one.episodes)
        pooled += abs(one.successes / one.episodes - two.successes / two.episodes) > half
    assert alarms / 1000 <= 0.06
    assert pooled / 1000 > 0.10, "rollouts pooled over trainings find differences between equal conditions"


@pytest.mark.thorough
def test_a_policy_that_is_equally_good_everywhere_is_not_called_worse():
    rng = np.random.default_rng(0)
    kinds = [
        condition_verdict(
            "leave_out", "baseline", condition_difference(*(arm(rng, one_cell(0.7), each=120) for _ in range(2)))
        ).kind
        for _ in range(1000)
    ]
    assert kinds.count("lower") / 1000 <= 0.06
    assert kinds.count("as_good") + kinds.count("cannot_tell") > 900
    assert kinds.count("as_good") > 500


def test_a_real_drop_is_found_as_often_as_the_plan_says():
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(400):
        arms = (arm(rng, one_cell(rate), each=120, spread=0.046) for rate in (0.6, 0.8))
        found += condition_verdict("a", "b", condition_difference(*arms)).kind == "lower"
    # scenes here are equally difficult and not shared, so the plan is a little more hopeful
    assert found / 400 == pytest.approx(power(Design(replicates=5, scenes=120), 0.8, 0.6), abs=0.12)


def test_verdicts_are_sentences():
    def said(first, second, **options):
        return condition_verdict("leave_out", "baseline", condition_difference(first, second), **options)

    lower = said(exactly(0.4), exactly(0.8))
    assert (lower.kind, lower.question) == ("lower", "condition")
    assert lower.sentence.startswith("leave_out is lower than baseline by 40 points (")
    assert "over 5 trainings each" in lower.sentence
    assert said(exactly(0.8), exactly(0.4)).kind == "higher"
    assert said(exactly(0.8, each=100), exactly(0.8, each=100)).sentence.startswith(
        "leave_out is as good as baseline within 10 points: the difference is +0 points"
    )
    shaky = ConditionDifference(differences=(0.3, -0.1, 0.1), rollouts=(success_rate(60, 90), success_rate(51, 90)))
    unclear = condition_verdict("leave_out", "baseline", shaky)
    assert unclear.kind == "cannot_tell"
    assert "points are compatible with 3 trainings each" in unclear.sentence
    one = said(exactly(0.8, replicates=1), exactly(0.1, replicates=1))
    assert one.kind == "cannot_tell"
    assert "1 training each does not show how much trainings differ; at least 3 are needed" in one.sentence
    assert (one.difference.low, one.p_value) == (-math.inf, 1.0)
    assert "within the margin" in said(exactly(0.9, each=2000), exactly(0.95, each=2000)).sentence
    adjusted = said(exactly(0.4), exactly(0.8), p_value=0.3)
    assert adjusted.kind == "cannot_tell", "Holm's adjustment counts"
    assert "the difference is -40 points, but p is 0.3 after adjustment for several" in adjusted.sentence
    assert "compatible" not in adjusted.sentence, "the interval alone excludes 0"
    strict = said(exactly(0.4), exactly(0.8), p_value=0.03, alpha=0.01)
    assert strict.kind == "cannot_tell"
    assert "but p is 0.03 (limit 0.01) after adjustment" in strict.sentence


def test_one_checkpoint_says_nothing_about_the_way_to_train():
    found = checkpoint_verdict("a", "b", Pairs(both=10, first=40, second=2, neither=8))
    assert (found.kind, found.question) == ("higher", "checkpoint")
    assert found.sentence.endswith("One training says nothing about the way to train.")
    assert checkpoint_verdict("a", "b", Pairs(both=500, first=4, second=5, neither=91)).kind == "as_good"
    assert checkpoint_verdict("a", "b", Pairs(both=10, first=4, second=5, neither=1)).kind == "cannot_tell"
    few = Pairs(both=0, first=5, second=0, neither=15)  # Newcombe's interval excludes 0, the exact test decides
    assert "the difference is +25 points, but p is 0.062, on 20 scenes" in checkpoint_verdict("a", "b", few).sentence
    several = checkpoint_verdict("a", "b", few, p_value=0.19).sentence
    assert "but p is 0.19 after adjustment for several comparisons" in several


def test_replicates_that_agree_by_chance_do_not_end_the_doubt():
    always = condition_difference(exactly(1.0, replicates=3, each=5), exactly(1.0, replicates=3, each=5))
    interval = always.interval()
    assert interval.low < 0 < interval.high
    rates = condition_rate(exactly(1.0, replicates=3, each=5))
    assert rates.low < 0.97


def test_shared_scenes_narrow_the_rollouts_share_of_the_doubt():
    first, second = exactly(0.8, each=50), exactly(0.7, each=50)
    same = [Pairs(both=210, first=30, second=0, neither=60)] * 5
    apart, paired = condition_difference(first, second), condition_difference(first, second, same)
    assert paired.interval().low > apart.interval().low
    assert paired.value == apart.value == pytest.approx(0.1)


def test_more_trainings_decide_a_margin():
    def spread(*differences):
        return ConditionDifference(differences=differences, rollouts=(success_rate(300, 360), success_rate(280, 360)))

    shaky = spread(0.15, -0.10, 0.05)
    more = more_trainings(shaky, 0.10)
    assert 10 < more < 25
    assert more_trainings(shaky, 0.05) > more
    assert more_trainings(spread(0.1), 0.10) is None
    assert more_trainings(spread(0.01, 0.011, 0.009), 0.10) == 0


def test_different_cells_or_replicates_are_not_compared():
    with pytest.raises(InvalidRequestError, match="5 and 3"):
        condition_difference(exactly(0.5), exactly(0.5, replicates=3))
    with pytest.raises(InvalidRequestError, match="held-out 5"):
        condition_difference(exactly(0.5), exactly(0.5, cells=HELD_OUT[:5]))
    with pytest.raises(InvalidRequestError, match="replicate 1 met other cells"):
        Arm(replicates=({"a": Count(successes=0, episodes=1)}, {"b": Count(successes=0, episodes=1)}))
    with pytest.raises(InvalidRequestError, match="successes"):
        Count(successes=3, episodes=2)


# ------------------------------------------------------------------ scores


def test_the_interval_of_the_ratio_holds_the_thesis_ratio():
    rng = np.random.default_rng(7)
    held = {3: 0, 5: 0}
    alone = 0
    for replicates in held:
        for _ in range(500):
            u = arm(rng, one_cell(0.19), each=120, replicates=replicates, spread=0.05)
            s = arm(rng, one_cell(0.264), each=120, replicates=replicates, spread=0.05)
            found = condition_ratio(u, s)
            held[replicates] += found.low <= 0.19 / 0.264 <= found.high
            if replicates == 3:
                error = math.sqrt(sum((1 - a.rate) / a.rate / a.pooled.episodes for a in (u, s)))
                alone += abs(math.log(found.value / (0.19 / 0.264))) <= 1.96 * error
    assert 0.93 <= held[5] / 500 <= 0.985
    assert held[3] / 500 >= 0.93
    assert alone / 500 < 0.90, "the rollouts alone are too sure of themselves"


def test_trainings_that_agree_do_not_make_a_ratio_certain():
    every = condition_ratio(exactly(1.0, replicates=3), exactly(1.0, replicates=3))
    assert (every.low, every.high) == (pytest.approx(1 / every.high), pytest.approx(1 / every.low))
    assert every.high > 1.01
    halves = {cell: Count(successes=20 * (number < 3), episodes=20) for number, cell in enumerate(HELD_OUT)}
    half = condition_ratio(Arm(replicates=(halves,) * 3), exactly(1.0, replicates=3))
    assert half.low < 0.46, "as the interval of the rate alone: 0.45 to 0.55"
    assert half.high > 0.54
    none = condition_ratio(exactly(0.0, replicates=3), exactly(0.2, replicates=3))
    assert none.high > condition_rate(exactly(0.0, replicates=3)).high / 0.2, "the baseline is uncertain, too"


def test_cells_with_few_rollouts_widen_the_interval():
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(400):
        cells = {f"seen {i}": Count(successes=int(rng.binomial(3, 0.5)), episodes=3) for i in range(12)}
        cells |= {f"held out {i}": Count(successes=int(rng.binomial(60, 0.5)), episodes=60) for i in range(6)}
        rate = condition_rate(Arm(replicates=(cells,)))
        covered += rate.low <= 0.5 <= rate.high
    assert covered >= 0.93 * 400, "396 rollouts, but the mean of the cells is as uncertain as that of 77"
    even = {cell: Count(successes=12, episodes=20) for cell in HELD_OUT}
    pooled = success_rate(72, 120)
    assert (condition_rate(Arm(replicates=(even,))).low) == pytest.approx(pooled.low)


def test_a_ratio_to_a_baseline_that_fails_is_refused():
    weak = Arm(replicates=({"a": Count(successes=3, episodes=120)},) * 3)
    found = relative_score(weak, weak)
    assert found.ratio is None
    assert str(found).startswith("refused: the baseline may succeed in as little as")
    guessed = relative_score(exactly(0.5), exactly(0.6), exactly(0.6))
    assert "not shown to be better than a policy without words" in guessed.refused
    good = relative_score(exactly(0.9), exactly(0.6), exactly(0.1))
    assert good.ratio.value == pytest.approx(1.5), "a ratio is not clipped at 1"


def test_no_limit_does_not_allow_a_ratio_to_what_may_be_0():
    seldom = Arm(replicates=tuple({"a": Count(successes=n, episodes=120)} for n in (0, 0, 36)))
    never = Arm(replicates=({"a": Count(successes=0, episodes=120)},) * 3)
    found = relative_score(never, seldom, refuse_below=0.0)
    assert found.refused.startswith("the baseline may succeed in as little as 0 %")


def test_a_policy_that_memorises_pairs_is_found_out():
    rng = np.random.default_rng(5)
    leave_out = arm(rng, flat(0.01) | flat(0.9, SEEN))
    baseline = arm(rng, flat(0.85) | flat(0.85, SEEN))
    failed = [("pick_up target=cube", ["place_on target=cube"])] * 95 + [("pick_up target=cube", [])] * 5
    found = scores(leave_out, baseline, unseen=HELD_OUT, blind=arm(rng, flat(0.01)), failed=failed)
    assert found.relative.ratio.high < 0.1
    assert found.substitution.rate.low > 0.85
    assert found.substitution.worst == "pick_up target=cube -> place_on target=cube (95 of 100 failures)"
    assert found.gap.interval().low > 0.5
    never = condition_ratio(exactly(0.0), exactly(0.8))
    assert (never.value, never.low) == (0.0, 0.0)
    assert 0 < never.high < 0.13


def test_a_policy_that_ignores_words_is_warned_of():
    rng = np.random.default_rng(6)
    leave_out, baseline, blind = (arm(rng, flat(0.8)) for _ in range(3))
    found = scores(leave_out, baseline, unseen=HELD_OUT, blind=blind)
    assert found.relative.ratio is None
    assert "needs no words here" in found.warnings[0]
    listens = scores(leave_out, baseline, unseen=HELD_OUT, blind=arm(rng, flat(0.1)))
    assert listens.warnings == ()
    assert listens.words.interval().low > 0.5
    unasked = scores(leave_out, baseline, unseen=HELD_OUT)
    assert "without words was evaluated" in unasked.warnings[0]


def test_a_weakened_baseline_shows_in_the_competence():
    rng = np.random.default_rng(8)
    leave_out = arm(rng, flat(0.5) | flat(0.9, SEEN))
    baseline = arm(rng, flat(0.5) | flat(0.6, SEEN))
    found = scores(leave_out, baseline, unseen=HELD_OUT, blind=arm(rng, flat(0.05)))
    assert found.competence.interval().low > 0.1
    assert any("Competence differs" in warning for warning in found.warnings)
    assert found.relative.ratio.value == pytest.approx(1.0, abs=0.15), "the ratio alone would look good"


def test_substitutions_of_nothing_are_none():
    assert substitutions([]).rate.episodes == 0
    assert substitutions([("a", [])]).worst == ""


def test_the_benchmarks_scores_are_those_of_the_thesis():
    # sections 5.4.3 and 5.4.4 give 0.19, 0.72 and 0.23, 0.80; camera and skill a little over 1 at about 0.8
    def score(value):
        return Interval(value=value, low=value - 0.06, high=value + 0.08)

    def scored(u, ratio, *dimensions):
        s = u / (ratio or 1)
        return ExperimentScore(
            dimensions=dimensions, absolute=score(u), baseline=score(s), gap=score(s - u),
            relative=None if ratio is None else score(ratio),
        )  # fmt: skip

    found = dimension_scores(
        {
            "skill_object": scored(0.19, 0.72, "skill", "object"),
            "camera_object": scored(0.23, 0.80, "camera", "object"),
            "camera_skill": scored(0.80, 1.02, "camera", "skill"),
        }
    )
    both = found["object"]
    assert both.baseline.value == pytest.approx((0.19 / 0.72 + 0.23 / 0.80) / 2)
    assert both.gap.value == pytest.approx(both.baseline.value - both.absolute.value)
    assert both.gap.low == pytest.approx(both.gap.value - 0.06 / math.sqrt(2))
    assert (both.absolute.value, both.relative.value) == (pytest.approx(0.21), pytest.approx(0.76))
    assert both.absolute.low == pytest.approx(0.21 - 0.06 / math.sqrt(2)), "two independent estimates"
    assert both.relative.high == pytest.approx(0.76 + 0.08 / math.sqrt(2))
    assert found["skill"].absolute.value == pytest.approx(0.5, abs=0.03)
    assert found["camera"].absolute.value == pytest.approx(0.5, abs=0.03)
    refused = dimension_scores({"a": scored(0.1, None, "skill"), "b": scored(0.3, 0.9, "skill")})
    assert (refused["skill"].relative, refused["skill"].refused) == (None, ("a",))
    assert refused["skill"].absolute.value == pytest.approx(0.2)


def test_the_interval_of_a_mean_of_experiments_covers_the_truth():
    rng = np.random.default_rng(5)
    means = [
        mean_interval([
            condition_rate(arm(rng, one_cell(rate), replicates=3, each=60, spread=0.08)) for rate in (0.6, 0.9)
        ])
        for _ in range(1000)
    ]  # fmt: skip
    truth = np.mean([mean.value for mean in means])
    assert 0.95 <= np.mean([mean.low <= truth <= mean.high for mean in means]) < 1.0


# ------------------------------------------------------------------ several comparisons, planning


def test_adjusted_p_values_agree_with_statsmodels():
    p_values = [0.01, 0.04, 0.03, 0.005, 0.2]
    assert holm(p_values) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.2])
    assert holm([]) == ()


def test_models_without_a_common_letter_differ():
    rates = {"octo": 0.3, "bc": 0.8, "vla": 0.75, "zero": 0.0}
    different = {
        ("octo", "bc"): True, ("octo", "vla"): False, ("bc", "vla"): False,
        ("zero", "bc"): True, ("zero", "vla"): True, ("zero", "octo"): True,
    }  # fmt: skip
    letters = compact_letters(rates, different)
    assert letters == {"bc": "a", "vla": "ab", "octo": "b", "zero": "c"}
    for (one, two), differs in different.items():
        assert differs == (not set(letters[one]) & set(letters[two]))
    with pytest.raises(InvalidRequestError, match="no comparison"):
        compact_letters({"a": 1.0, "b": 0.5}, {})


def test_strengths_of_models_that_met_different_scenes():
    found = bradley_terry({("a", "b"): 30, ("b", "a"): 10, ("b", "c"): 30, ("c", "b"): 10})
    assert found["a"] - found["b"] == pytest.approx(math.log(3), abs=0.05)
    assert found["b"] - found["c"] == pytest.approx(math.log(3), abs=0.05)
    assert math.isfinite(bradley_terry({("a", "b"): 9})["a"])


def test_cells_weigh_alike_over_trainings_but_scenes_are_the_sample_of_one():
    uneven = {"a": Count(successes=10, episodes=19), "b": Count(successes=10, episodes=20)}
    pairs = Pairs(both=10, first=10, second=2, neither=17)
    one, three = (Arm(replicates=(uneven,) * replicates) for replicates in (1, 3))
    assert condition_difference(one, one, [pairs]).pairs == pairs
    assert condition_difference(three, three, [pairs] * 3).pairs is None


@pytest.mark.thorough
@pytest.mark.parametrize(("shared", "planned"), [(True, 0.26), (False, 0.30)])
def test_the_same_checkpoints_show_smaller_differences(shared, planned):
    size = Design(replicates=3, scenes=50, other_scenes=0 if shared else 50, same_checkpoints=True)
    assert detectable(size) == pytest.approx(planned, abs=0.01)
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(400):
        middles = {0.8: 2.03, 0.5: 0.0}  # of the logit, where scenes spread by 1.5
        counts, pairs = {0.8: [], 0.5: []}, []
        for _ in range(3):
            shift, ease = rng.normal() * 0.046 / 0.16, 1.5 * rng.normal(size=(2, 50))
            logits = {0.8: middles[0.8] + ease[0], 0.5: middles[0.5] + ease[0 if shared else 1]}
            won = {rate: rng.random(50) < 1 / (1 + np.exp(-logit - shift)) for rate, logit in logits.items()}
            pairs.append(Pairs.of(zip(won[0.5], won[0.8], strict=True)))
            for rate, outcomes in won.items():
                counts[rate].append({"all": Count(successes=int(outcomes.sum()), episodes=50)})
        low, high = (Arm(replicates=tuple(counts[rate])) for rate in (0.5, 0.8))
        difference = condition_difference(low, high, pairs if shared else ())
        found += condition_verdict("a", "b", difference).kind == "lower"
    assert found / 400 == pytest.approx(power(size, 0.8, 0.5), abs=0.06)


def test_replicates_before_scenes():
    assert detectable(Design(replicates=5, scenes=120)) == pytest.approx(0.16, abs=0.02)
    assert detectable(Design(replicates=3, scenes=120)) == pytest.approx(0.32, abs=0.02)
    more_scenes, more_trainings_ = Design(replicates=3, scenes=240), Design(replicates=6, scenes=120)
    assert detectable(more_trainings_) < detectable(more_scenes)
    assert detectable(Design(replicates=3, scenes=2)) is None
    assert power(Design(replicates=5, scenes=120), 0.8, 0.8) == pytest.approx(0.05, abs=0.005)
    assert power(Design(replicates=1, scenes=120), 0.8, 0.6) == pytest.approx(0.96, abs=0.03)
    assert power(Design(replicates=1, scenes=5), 1.0, 0.0) == 0.0, "five scenes cannot show anything"
    assert power(Design(replicates=1, scenes=6), 1.0, 0.0) == pytest.approx(1.0)
    assert power(Design(replicates=2, scenes=500), 1.0, 0.0) == 0.0, "two trainings always end in 'cannot tell'"
