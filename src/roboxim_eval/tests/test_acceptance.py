"""What reports must say of policies with planted behaviour, on the shipped experiments (simulated tables)."""

import math

import numpy as np
import pytest
from planted_cards import planted_card, shipped

from roboxim_eval.benchmark.card import BenchmarkCard, concluded_benchmark
from roboxim_eval.experiments.card import Attestation, Card, CardEvaluation, CardExperiment, CardTraining
from roboxim_eval.experiments.card_checks import analysis_of, attestation_warnings, concluded
from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.replicates import condition_difference, condition_ratio
from roboxim_eval.statistics.tables import Arm, Count


def listens(condition, cell, held_out=0.7, seen=0.8):
    """Return the rate of a policy that combines what it has seen, and needs the words."""
    if condition == "blind":
        return 0.05
    return held_out if cell.unseen else seen


def shares(kinds):
    return {kind: kinds.count(kind) / len(kinds) for kind in set(kinds)}


# ------------------------------------------------------------------ equally good


@pytest.mark.slow
@pytest.mark.parametrize(("replicates", "spread"), [(3, 0.05), (5, 0.05), (5, 0.0)])
def test_equal_conditions_are_called_lower_or_higher_in_at_most_6_percent(replicates, spread):
    design = shipped(replicates=replicates)
    kinds, pooled = [], 0
    for seed in range(1000):
        card = planted_card(design, listens, seed=seed, spread=spread)
        kinds.append(card.verdicts[0].kind)
        together = [Pairs(both=a, first=b, second=c, neither=d) for a, b, c, d in card.pairs["0"]]
        pooled += paired_difference(sum(together[1:], start=together[0])).p_value <= 0.05
    found = shares(kinds)
    assert found.get("lower", 0) <= 0.06
    assert found.get("lower", 0) + found.get("higher", 0) <= 0.06
    if spread:
        assert pooled / 1000 > 0.06, "the pooled McNemar test, which is not used, must fail this test"


def test_a_policy_that_combines_is_as_good_or_cannot_be_told():
    kinds = [planted_card(shipped(), listens, seed=seed).verdicts[0].kind for seed in range(5)]
    assert set(kinds) <= {"as_good", "cannot_tell"}
    large = planted_card(shipped(per_cell=200), listens).verdicts[0]
    assert large.sentence.startswith("leave_out in unseen cells is as good as baseline there within 10 points")


# ------------------------------------------------------------------ policies that are not what they seem


def test_a_policy_that_memorises_pairs_is_named():
    design = shipped()
    unseen = [cell.key for cell in design.cells if cell.unseen]
    instead = {key: key.replace("pick_up", "rotate") if "pick_up" in key else "" for key in unseen}
    instead |= {key: "pick_up " + key.partition(" ")[2] for key, done in instead.items() if not done}
    rates = {"leave_out": {True: 0.01, False: 0.85}, "baseline": {True: 0.8, False: 0.8}, "blind": {True: 0.01}}
    card = planted_card(design, lambda name, cell: rates[name][cell.unseen], instead=instead)
    assert card.verdicts[0].kind == "lower"
    assert card.scores["relative"][2] < 0.1
    assert card.scores["substitution"]["rate"][1] > 0.9
    assert "pick_up target=" in card.scores["substitution"]["worst"]
    assert "->" in card.scores["substitution"]["worst"]


def test_a_policy_that_ignores_words_needs_an_experiment_with_words():
    easy = planted_card(shipped(), lambda name, cell: 0.8, seed=1)
    assert "This experiment needs no words here" in easy.warnings[0]
    assert easy.scores["relative"] is None
    worded = shipped("skill_object_worded")
    chance = planted_card(
        worded, lambda name, cell: 0.15 if name == "leave_out" else 0.7 if name == "baseline" else 0.15
    )
    value, low, high = chance.scores["words"]
    assert low < 0 < high
    assert abs(value) < 0.06
    assert chance.verdicts[0].kind == "lower"
    assert chance.warnings[0].startswith("The leave-out condition is not shown to use its words in held-out cells")


def test_a_baseline_with_3_of_120_has_no_ratio_but_a_gap():
    design = shipped()
    weak = planted_card(design, lambda name, cell: 0.025 if cell.unseen else 0.6, seed=4)
    assert weak.scores["relative"] is None
    assert "a ratio to it means nothing" in weak.scores["relative_refused"]
    assert weak.scores["gap"][1] < 0 < weak.scores["gap"][2]
    assert "to be as good as a baseline that fails is no success" in weak.warnings[0]


def test_a_shorter_recipe_of_the_baseline_is_flagged_and_its_competence_differs():
    rates = {"leave_out": {True: 0.5, False: 0.85}, "baseline": {True: 0.5, False: 0.6}, "blind": {True: 0.05}}
    card = planted_card(shipped(), lambda name, cell: rates[name][cell.unseen], steps={"baseline": 4000})
    assert any("differ in more than the dataset: steps 10000 and 4000" in warning for warning in card.warnings)
    assert any(warning.startswith("Competence differs") for warning in card.warnings)
    fair = planted_card(shipped(), listens)
    assert fair.warnings == ()


def test_arguments_of_conditions_are_one_sentence_and_other_differences_another():
    def training(name, arguments, steps=9):
        recipe = {"steps": steps, "arguments": arguments}
        return CardTraining(
            condition=name, replicate=0, dataset="all", attest=Attestation(recipe=recipe, exposure="no")
        )

    said = tuple(
        attestation_warnings([training("base", "none"), training("deep", "--depth 2"), training("long", "-x", 7)])
    )
    assert said == (
        "Conditions differ in the arguments of their trainings, not in the dataset alone (base: none; deep: --depth 2; "
        "long: -x).",
        "Recipes of base and long differ in more than the dataset: steps 9 and 7.",
    )
    assert not [*attestation_warnings([training("base", "-x"), training("deep", "-x")])]


def test_exposure_and_failed_proofs_are_said():
    exposed = planted_card(shipped(), listens, exposure="yes", proofs={"camera pose": (597, 600), "words": (600, 600)})
    assert any("contained held-out combinations" in warning for warning in exposed.warnings)
    assert "Delivery is not proved for 3 of 600 episodes: camera pose." in exposed.warnings
    unknown = planted_card(shipped(), listens, exposure="unknown")
    assert any("It is not known" in warning for warning in unknown.warnings)


# ------------------------------------------------------------------ the thesis's numbers


@pytest.mark.slow
def test_the_interval_of_the_thesis_ratio_holds_it_in_93_to_98_percent():
    rng = np.random.default_rng(11)
    held = 0
    for _ in range(1000):
        arms = []
        for rate in (0.19, 0.264):
            shifts = rng.normal(size=5) * 0.05 / 0.16
            chances = 1 / (1 + np.exp(-(math.log(rate / (1 - rate)) + shifts)))
            rows = [{"all": Count(successes=int(rng.binomial(120, p)), episodes=120)} for p in chances]
            arms.append(Arm(replicates=tuple(rows)))
        found = condition_ratio(*arms)
        held += found.low <= 0.19 / 0.264 <= found.high
    assert 0.93 <= held / 1000 <= 0.98


def exact_card(design, rate):
    """Return the card of counts that are as close to rates as whole numbers can be, over replicates."""
    rows = []
    for evaluation in design.evaluations:
        by_cell = {}
        for cell in design.cells:
            if cell.key in evaluation.counts:
                n = evaluation.counts[cell.key]
                wanted = rate(evaluation.condition, cell) * n
                whole = math.floor(wanted * (evaluation.replicate + 1)) - math.floor(wanted * evaluation.replicate)
                by_cell[cell.key] = (whole, n, 0)
        rows.append(
            CardEvaluation(condition=evaluation.condition, replicate=evaluation.replicate, by_cell=by_cell)
        )  # fmt: skip
    return concluded(
        Card(experiment=CardExperiment(name="t", scale="full", config=design.config), evaluations=tuple(rows)), design
    )  # fmt: skip


def test_the_thesis_cell_rates_give_object_021_and_76_percent():
    published = {"skill_object": (0.19, 0.19 / 0.72), "camera_object": (0.23, 0.23 / 0.80), "camera_skill": (0.8, 0.78)}
    cards = {}
    for name, (u, s) in published.items():
        design = shipped(name, per_cell=100)
        rates = {"leave_out": u, "baseline": s, "blind": 0.02}
        cards[name] = exact_card(design, lambda condition, cell, rates=rates: rates[condition])
        assert cards[name].scores["absolute"][0] == pytest.approx(u, abs=0.005)
    found = concluded_benchmark(BenchmarkCard(name="transfer", scale="full", experiments=cards))
    score = found.dimensions["object"]
    assert (round(score.absolute[0], 2), round(score.relative[0], 2)) == (0.21, 0.76)
    assert found.sentences[1] == (  # whole numbers of rollouts give the baseline 0.275, rates would give 0.276
        "object: 0.21 (0.20 to 0.22) absolute, 76 % (72 to 82 %) of the baseline; "
        "the baseline has 0.27 (0.26 to 0.29), a gap of +6 points (+5 to +8); mean of skill_object and camera_object."
    )
    assert found.dimensions["skill"].absolute[0] == pytest.approx(0.5, abs=0.02)


def test_shared_scenes_of_the_card_narrow_the_interval():
    card = planted_card(shipped(), listens)
    analysis = analysis_of(card)
    arms = {e.condition: [] for e in card.evaluations}
    for e in card.evaluations:
        arms[e.condition].append({c: Count(successes=s, episodes=n) for c, (s, n, _) in e.by_cell.items()})
    unseen = [c.key for c in shipped().cells if c.unseen]
    first, second = (Arm(replicates=tuple(arms[n])).within(unseen) for n in ("leave_out", "baseline"))
    assert analysis.comparisons[0].verdict.difference.value == pytest.approx(condition_difference(first, second).value)
