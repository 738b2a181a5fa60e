"""Results of planted policies (simulated tables): verdicts, scores and warnings say what was planted."""

from dataclasses import replace

import pytest
from trained_experiment import SEEN_AND_UNSEEN, config, planted

from roboxim_core.errors import ConfigError
from roboxim_eval.benchmark.card import benchmark_scores
from roboxim_eval.benchmark.config import benchmark_config
from roboxim_eval.experiments import Outcomes, analyse, design_of
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.tables import Count


def test_a_policy_that_combines_is_as_good():
    design = design_of(config(evaluate={"per_cell": 100}))
    found = analyse(design, planted(design, lambda name, unseen: 0.05 if name == "blind" else 0.85))
    primary = found.comparisons[0].verdict
    assert primary.kind == "as_good"
    assert "leave_out in unseen cells is as good as baseline there within 10 points" in found.sentences[0]
    assert found.comparisons[1].verdict.kind == "higher", "words help"
    assert found.scores.relative.ratio.low < 1 < found.scores.relative.ratio.high
    assert found.warnings == ()


def test_a_policy_that_memorises_is_lower_and_named():
    design = design_of(config())
    failed = [("pick_up target=cube", ["rotate target=cube"])] * 60 + [("rotate target=apple", [])] * 4
    rate = {"leave_out": {True: 0.02, False: 0.9}, "baseline": {True: 0.9, False: 0.9}, "blind": {True: 0.02}}
    found = analyse(design, planted(design, lambda name, unseen: rate[name][unseen], failed=failed))
    assert found.comparisons[0].verdict.kind == "lower"
    assert found.scores.relative.ratio.value < 0.1
    assert found.scores.substitution.rate.rate > 0.9
    assert "pick_up target=cube -> rotate target=cube" in found.scores.substitution.worst
    assert found.warnings == (), "where a policy fails, words cannot help"


def test_a_policy_that_only_looks_is_warned_of():
    design = design_of(config())
    found = analyse(design, planted(design, lambda name, unseen: 0.8, seed=1))
    assert "needs no words here" in found.warnings[0]
    assert "not shown to be better than a policy without words" in found.scores.relative.refused


def test_a_weakened_baseline_is_seen_in_the_competence():
    design = design_of(config())
    rate = {"leave_out": {True: 0.5, False: 0.9}, "baseline": {True: 0.5, False: 0.6}, "blind": {True: 0.05}}
    found = analyse(design, planted(design, lambda name, unseen: rate[name][unseen]))
    assert any("Competence differs" in warning for warning in found.warnings)


def test_a_baseline_that_fails_has_no_ratio_but_a_gap():
    design = design_of(config())
    found = analyse(design, planted(design, lambda name, unseen: 0.03))
    assert found.scores.relative.ratio is None
    assert found.scores.gap.interval().low < 0 < found.scores.gap.interval().high


def test_one_training_compares_checkpoints_alone():
    design = design_of(config(replicates={"count": 1}))
    pairs = {0: [Pairs(both=5, first=0, second=30, neither=5)], 1: [Pairs(both=5, first=2, second=1, neither=32)]}
    outcomes = planted(design, lambda name, unseen: 0.5, pairs=pairs)
    found = analyse(design, outcomes)
    assert found.comparisons[0].verdict.question == "checkpoint"
    assert found.comparisons[0].verdict.kind == "lower"
    apart = analyse(design, planted(design, lambda name, unseen: 0.5))
    assert apart.comparisons[0].verdict.kind == "cannot_tell"
    assert "These two checkpoints differ by" in apart.sentences[0]


def test_an_excluded_rollout_leaves_the_scenes_shared():
    design = design_of(config(replicates={"count": 1}))
    pairs = {0: [Pairs(both=5, first=0, second=20, neither=14)]}  # 39 of the 40 scenes were met by both
    outcomes = planted(design, lambda name, unseen: 0.5, pairs=pairs)
    (row,) = outcomes.counts["leave_out"]
    cell = "pick_up target=cube"
    fewer = {**row, cell: Count(successes=row[cell].successes, episodes=row[cell].episodes - 1)}
    counts = {**outcomes.counts, "leave_out": [fewer]}
    verdict = analyse(design, replace(outcomes, counts=counts)).comparisons[0].verdict
    own = paired_difference(pairs[0][0])
    assert (verdict.question, verdict.kind) == ("checkpoint", "lower")
    assert verdict.p_value == pytest.approx(2 * own.p_value), "exact McNemar, of two comparisons"
    assert (verdict.difference.low, verdict.difference.high) == (own.low, own.high)
    assert "on 39 scenes that both met" in verdict.sentence


def test_other_cells_of_one_checkpoint_have_no_scenes_in_common():
    design = design_of(config(SEEN_AND_UNSEEN, replicates={"count": 1}))
    itself = {0: [Pairs(both=20, first=0, second=0, neither=20)]}  # a card's pairs are those of the first cells
    rate = {True: 0.2, False: 0.9}
    outcomes = planted(design, lambda name, unseen: rate[unseen], pairs=itself)
    found = analyse(design, outcomes)
    assert "These rates of one checkpoint differ by" in found.sentences[0]
    assert found.comparisons[0].verdict.kind == "cannot_tell"
    assert found == analyse(design, replace(outcomes, pairs={}))


def test_seen_and_unseen_cells_of_one_condition_are_compared():
    text = SEEN_AND_UNSEEN
    design = design_of(config(text))
    rate = {"leave_out": {True: 0.2, False: 0.9}, "baseline": {True: 0.5, False: 0.9}, "blind": {True: 0.05}}
    found = analyse(design, planted(design, lambda name, unseen: rate[name][unseen]))
    assert found.sentences[0].startswith("leave_out in unseen cells is lower than leave_out in seen cells by")
    assert found.scores is None
    with pytest.raises(ConfigError, match="compared with itself"):
        config(text.replace(", against: seen", ""))


def test_several_comparisons_are_adjusted():
    design = design_of(config())
    outcomes = planted(design, lambda name, unseen: 0.5 if name == "leave_out" else 0.6, seed=3)
    found = analyse(design, outcomes).comparisons
    alone = []
    for one in found:
        compare = {"first": one.config.first, "second": one.config.second, "where": one.config.where}
        alone.append(analyse(design_of(config(compare=[compare])), outcomes).comparisons[0].verdict.p_value)
    adjusted = [one.verdict.p_value for one in found]
    assert adjusted == pytest.approx(holm(alone))
    assert adjusted != pytest.approx(alone)


def test_scenes_of_one_checkpoint_are_adjusted_too():
    design = design_of(config(replicates={"count": 1}))
    pairs = {n: [Pairs(both=60, first=22, second=8, neither=30)] for n in range(len(design.config.compare))}
    found = analyse(design, planted(design, lambda name, unseen: 0.5, pairs=pairs)).comparisons
    single = paired_difference(pairs[0][0]).p_value
    assert single < 0.05
    assert [one.verdict.p_value for one in found] == pytest.approx([len(found) * single] * len(found))
    assert found[0].verdict.kind == ("cannot_tell" if len(found) * single > 0.05 else "higher")


def test_many_errors_are_named():
    design = design_of(config())
    outcomes = planted(design, lambda name, unseen: 0.5)
    broken = {cell: Count(successes=0, episodes=20, errors=5) for cell in outcomes.counts["baseline"][0]}
    counts = {**outcomes.counts, "baseline": [broken, *outcomes.counts["baseline"][1:]]}
    found = analyse(design, Outcomes(counts=counts))
    assert any(warning.startswith("baseline: 30 of 600") for warning in found.warnings)
    with pytest.raises(ConfigError, match="no outcomes of condition 'blind'"):
        analyse(design, Outcomes(counts={name: outcomes.counts[name] for name in ("leave_out", "baseline")}))


def test_a_benchmark_averages_by_dimension():
    design = design_of(config(evaluate={"per_cell": 100}))
    good = analyse(design, planted(design, lambda name, unseen: 0.05 if name == "blind" else 0.8))
    halves = {"leave_out": 0.4, "baseline": 0.8, "blind": 0.02}
    half = analyse(design, planted(design, lambda name, unseen: halves[name]))
    camera = config(dimensions={"task": "skill", "target": "camera"})
    found = benchmark_scores({"one": (design.config, good), "two": (camera, half)})
    assert found["skill"].relative.value == pytest.approx(0.75, abs=0.05)
    assert found["object"].relative.value == pytest.approx(1.0, abs=0.06)
    assert found["camera"].absolute.value == pytest.approx(0.4, abs=0.05)
    with pytest.raises(ConfigError, match="experiments must be different"):
        benchmark_config({"about": "b", "experiments": ["a", "a"]})
