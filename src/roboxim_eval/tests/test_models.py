"""Models side by side: what is comparable, numbers of trainings, errors, adjusted p values, letters of many models."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cards import planted_card, shipped
from scipy.stats import ttest_ind

from roboxim_core.config import load_yaml, named_config
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import design_of, experiment_config, scale_names
from roboxim_eval.experiments.card import CardCode, CardDataset, CardEnvironment, parse_card
from roboxim_eval.experiments.card_checks import concluded
from roboxim_eval.experiments.models import compare_models
from roboxim_eval.report.models import models_page
from roboxim_eval.statistics.multiple import compact_letters
from roboxim_eval.statistics.paired import newcombe
from roboxim_eval.statistics.rates import success_rate

RESULTS = Path(__file__).parents[3] / "docs/results"


def card_of(rates, *, errors=0, per_cell=20):
    """Return a card whose leave-out trainings have these rates in every cell, and errors in each cell."""
    design = shipped(replicates=len(rates), per_cell=per_cell)
    card = planted_card(design, lambda condition, cell: 0.5)
    evaluations = tuple(
        replace(
            one,
            by_cell={cell: (round(rates[one.replicate] * n), n, errors) for cell, (_, n, _) in one.by_cell.items()},
        )
        if one.condition == "leave_out"
        else one
        for one in card.evaluations
    )
    return concluded(replace(card, evaluations=evaluations), design)


# ------------------------------------------------------------------ what is comparable


def card_with(**changes):
    """Return a card of `skill_object`'s conditions with some keys of the file replaced."""
    config = replace(shipped(replicates=3).config, **changes)
    return planted_card(design_of(config), lambda condition, cell: 0.5)


def conditions_with(condition, **changes):
    conditions = shipped(replicates=3).config.conditions
    return {**conditions, condition: replace(conditions[condition], **changes)}


def test_experiments_with_equal_cells_and_other_scenes_are_refused():
    plain, worded = (
        planted_card(shipped(name, replicates=3), lambda condition, cell: 0.5)
        for name in ("skill_object", "skill_object_worded")
    )
    assert plain.evaluations[0].by_cell.keys() == worded.evaluations[0].by_cell.keys(), "names alone do not tell"
    with pytest.raises(ConfigError) as caught:
        compare_models({"a": plain, "b": worded})
    for said in ("a and b cannot be compared", "set.distractors.minimum: 0 in a, 3 in b", "Compare runs of one"):
        assert said in str(caught.value)
    with pytest.raises(ConfigError, match="b and c cannot be compared"):
        compare_models({"b": worded, "d": worded, "c": plain}, condition="blind")


@pytest.mark.parametrize(
    ("changes", "condition", "said"),
    [
        (
            {"factors": {**shipped().config.factors, "task": {
                "pick_up": {}, "place_on": {}, "rotate": {"arguments": {"direction": {"values": ["any"]}}}}}},
            "", 'factors.task.rotate.arguments.direction.values: ["clockwise"] in a, ["any"] in b',
        ),
        ({"set": {}}, "", "set.distractors.minimum: 0 in a, nothing in b"),
        (
            {"set": {"distractors": {"minimum": 0, "maximum": 0, "models": None}}}, "",
            'set.distractors.models: nothing in a, "null" in b',
        ),
        ({"evaluate": replace(shipped().config.evaluate, max_steps=50)}, "", "evaluate.max_steps: 0 in a, 50 in b"),
        (
            {"conditions": conditions_with("leave_out", set={"instruction": "Do it"})}, "",
            'conditions.leave_out.set.instruction: nothing in a, "Do it" in b',
        ),
        (
            {"conditions": conditions_with("leave_out", instruction="Do it")}, "leave_out",
            'conditions.leave_out.instruction: nothing in a, "Do it" in b',
        ),
        (
            {"conditions": conditions_with("baseline", latency_ticks=2)}, "baseline",
            "conditions.baseline.latency_ticks: 0 in a, 2 in b",
        ),
    ],
)  # fmt: skip
def test_rollouts_that_were_asked_different_things_are_refused(changes, condition, said):
    cards = {"a": card_of([0.5] * 3), "b": card_with(**changes)}
    with pytest.raises(ConfigError) as caught:
        compare_models(cards, condition=condition)
    assert said in str(caught.value)


def test_conditions_that_are_not_compared_and_replicates_may_differ():
    other = card_with(conditions=conditions_with("baseline", instruction="Do it"), decide=shipped().config.decide)
    found = compare_models({"a": card_of([0.5] * 4), "b": other})
    assert not found.circumstances
    with pytest.raises(ConfigError, match="conditions.baseline.instruction"):
        compare_models({"a": card_of([0.5] * 4), "b": other}, condition="baseline")


def test_two_scales_of_an_experiment_are_compared_in_the_cells_that_both_have():
    data = load_yaml(named_config("experiments", "skill_object"))
    cards = {}
    for scale in ("smoke", "laptop"):
        design = design_of(experiment_config(data, scale=scale))
        card = planted_card(design, lambda condition, cell: 0.5)
        cards[scale] = concluded(replace(card, experiment=replace(card.experiment, scale=scale)), design)
    found = compare_models(cards)
    assert found.cells == ("pick_up target=cube", "place_on target=soda_can")
    assert found.circumstances == (
        "The runs differ in scale, too: smoke (smoke); laptop (laptop). A difference of the models may be due to that.",
        "The runs differ in image size, too: 64x64 (smoke); 128x128 (laptop). A difference of the models may be due to "
        "that.",
    )
    assert set(found.circumstances) <= set(found.sentences)
    page = models_page(found, cards)
    assert all(sentence in page for sentence in found.circumstances)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["robustness", "camera_object", "triple", "zero_shot"])
def test_all_scales_of_a_shipped_experiment_can_be_compared(name):
    data = load_yaml(named_config("experiments", name))
    cards = {}
    for scale in scale_names(experiment_config(data)):
        config = experiment_config(data, scale=scale)
        cards[scale] = planted_card(design_of(config), lambda condition, cell: 0.5)
    for condition in list(experiment_config(data).conditions)[:4]:
        assert compare_models(cards, condition=condition).cells


CODE = CardCode(version="0.1.0", commit="a" * 40)


def run_of(card, *, trainer="", renderer="raster", packages="1" * 64, datasets=("aaaaaaaa", "bbbbbbbb"), code=CODE):
    """Return a card that states where it ran, and the hashes of the datasets of its first two generations."""
    generations = {
        f"{name}.{number}": CardDataset(sha256=f"{sha}{name}", by_cell={"pick_up target=onion": 324})
        for number, sha in enumerate(datasets)
        for name in ("leave_out", "baseline")
    }
    trainings = [replace(t, dataset=f"{t.dataset}.{min(t.replicate, len(datasets) - 1)}") for t in card.trainings]
    return replace(
        card, environment=CardEnvironment(renderer=renderer, packages_sha256=packages), datasets=generations,
        trainings=tuple(trainings), code=code, experiment=replace(card.experiment, trainer=trainer),
    )  # fmt: skip


def test_circumstances_that_differ_are_said():
    card = card_of([0.5] * 3)

    def said(**changes):
        return compare_models({"a": run_of(card), "b": run_of(card), "c": run_of(card, **changes)}).circumstances

    def expected(what, ours, theirs):
        return (
            f"The runs differ in {what}, too: {ours} (a and b); {theirs} (c). A difference of the models may be due to "
            "that.",
        )

    assert said() == said(trainer="external") == (), "two trainers of an experiment are what is compared"
    assert said(renderer="") == said(datasets=()) == (), "what a card does not state is not compared"
    assert said(renderer="tiny") == expected("renderer", "raster", "tiny")
    assert said(code=CardCode(version="0.1.0", commit="b29ef51411701234", dirty=True)) == expected(
        "version of the code", "0.1.0 at aaaaaaaaaaaa", "0.1.0 at b29ef5141170 with uncommitted changes"
    )  # fmt: skip
    assert said(packages="2" * 64) == expected("installed packages (by hash)", "11111111", "22222222")
    assert said(datasets=("cccccccc",)) == expected(
        "training datasets (by hash)", "324 demonstrations as rlds, aaaaaaaa, bbbbbbbb",
        "324 demonstrations as rlds, cccccccc",
    )  # fmt: skip


def test_datasets_of_replicates_that_only_some_models_have_are_not_compared():
    one, five = (run_of(card_of([0.5] * number)) for number in (1, 5))
    assert not compare_models({"a": one, "b": five}).circumstances
    (said,) = compare_models({"a": one, "b": run_of(card_of([0.5]), datasets=("cccccccc",))}, condition="blind",
                             where="unseen").circumstances  # fmt: skip
    assert "324 demonstrations as rlds, aaaaaaaa (a); 324 demonstrations as rlds, cccccccc (b)" in said


def test_published_cards_of_one_experiment_are_compared():
    cards = {
        name: parse_card(json.loads((RESULTS / f"skill_object-{name}/card.json").read_text()))
        for name in ("laptop", "night")
    }
    found = compare_models(cards)
    assert len(found.cells) == 6
    scale, code = found.circumstances
    assert scale.startswith("The runs differ in scale"), "both trained with the same datasets"
    assert "version of the code, too: 0.1.0 at 57ef49272" in code


# ------------------------------------------------------------------ different numbers of trainings


@pytest.mark.filterwarnings("ignore:Precision loss:RuntimeWarning")  # SciPy's, of B
def test_all_trainings_count_where_their_numbers_differ():
    found = compare_models({"A": card_of([0.5] * 3 + [0.9] * 3), "B": card_of([0.65] * 3)})
    (pair,) = found.pairs
    assert [model.rate.value for model in found.models.values()] == pytest.approx([0.7, 0.65])
    assert pair.difference.value == pytest.approx(0.05), "of the rates in the table"
    assert pair.test == "over 6 and 3 trainings"
    welch = ttest_ind([0.5] * 3 + [0.9] * 3, [0.65] * 3, equal_var=False)
    ends = welch.confidence_interval(0.95)
    assert (pair.difference.low, pair.difference.high) == pytest.approx((ends.low, ends.high))
    assert pair.p == pytest.approx(welch.pvalue)
    assert found.sentences[0] == (
        "Cannot tell whether A or B is better: -18 to +28 points are compatible, over 6 and 3 trainings."
    )


def test_welchs_test_agrees_with_scipy_where_both_vary():
    one, two = [0.1, 0.3, 0.45, 0.2], [0.9, 0.6, 0.7, 0.75, 0.95]
    (pair,) = compare_models({"A": card_of(one), "B": card_of(two)}).pairs
    welch = ttest_ind(one, two, equal_var=False)
    ends = welch.confidence_interval(0.95)
    assert (pair.difference.low, pair.difference.high) == pytest.approx((ends.low, ends.high))
    assert pair.p == pytest.approx(welch.pvalue)


def test_trainings_that_agree_by_chance_are_no_surer_than_their_rollouts():
    (pair,) = compare_models({"A": card_of([0.55] * 4), "B": card_of([0.5] * 3)}).pairs
    low, high = newcombe(success_rate(264, 480), success_rate(180, 360))
    assert (pair.difference.low, pair.difference.high) == pytest.approx((low, high))
    assert 0.1 < pair.p < 0.2
    equal = compare_models({"A": card_of([0.5] * 4), "B": card_of([0.5] * 3)}).pairs[0]
    assert equal.p == 1.0
    assert np.isfinite([equal.difference.low, equal.difference.high]).all()


def test_fewer_than_three_trainings_of_different_numbers_are_compared_by_all_their_rollouts():
    cards = {"A": card_of([0.1, 0.9]), "B": card_of([0.5])}
    scene = {("pick_up target=cube", str(i)): True for i in range(30)}
    found = compare_models(cards, scenes={"A": [scene, scene], "B": [dict.fromkeys(scene, False)]})
    assert found.pairs[0].difference.value == pytest.approx(0.0)
    assert found.pairs[0].test == "these checkpoints, without pairing their scenes"


def test_models_whose_interval_includes_0_are_not_said_to_differ():
    cards = {"few": card_of([0.0], per_cell=2), "many": card_of([0.25], per_cell=20)}
    found = compare_models(cards)
    (pair,) = found.pairs
    assert pair.p < 0.05, "Boschloo's test and Newcombe's interval disagree about 0 of 12 and 30 of 120"
    assert found.verdicts[0].startswith("Cannot tell whether few or many is better: -33 to +2 points are compatible")
    assert {model.letters for model in found.models.values()} == {"a"}


# ------------------------------------------------------------------ scenes that not all met


def test_models_that_met_different_scenes_have_strengths_over_those_that_pairs_met():
    cards = {name: card_of([rate]) for name, rate in (("A", 0.9), ("B", 0.6), ("C", 0.3))}

    def met(numbers, solved):
        return [{("pick_up target=cube", str(i)): i in solved for i in numbers}]

    scenes = {
        "A": met(range(40), range(10, 40)),
        "B": met(range(80), [*range(10), *range(40, 70)]),
        "C": met(range(40, 80), range(70, 80)),
    }
    found = compare_models(cards, scenes=scenes)
    assert list(found.strengths) == ["A", "B", "C"]
    assert found.strengths["A"] - found.strengths["B"] == pytest.approx(np.log(30 / 10), abs=0.05)
    assert found.strengths["B"] - found.strengths["C"] == pytest.approx(np.log(30 / 10), abs=0.05)
    (said,) = [sentence for sentence in found.verdicts if "Bradley-Terry" in sentence]
    assert "Not all models met the same scenes" in said
    assert said in models_page(found, cards)
    apart = {**scenes, "C": met(range(90, 99), range(95, 99))}
    assert not compare_models(cards, scenes=apart).strengths, "no scene connects C with the others"
    same = dict.fromkeys(scenes, scenes["A"])
    assert not compare_models(cards, scenes=same).strengths, "letters say it where all met the same scenes"


# ------------------------------------------------------------------ errors and warnings


def test_a_model_whose_episodes_ended_in_errors_is_named_with_its_errors():
    cards = {"A": card_of([0.0] * 3, errors=20), "B": card_of([0.6] * 3)}
    found = compare_models(cards)
    assert found.models["A"].errors == 360
    assert found.sentences[0] == found.errors[0]
    assert found.errors[0].startswith("A: 360 of 360 = 100 %")
    assert found.errors[0].endswith("ended in errors, more than 1 %; its results are not to be relied on.")
    assert found.verdicts[0].startswith("B is better than A by 60 points")
    assert found.verdicts[0].endswith("over 3 trainings each; errors of A count as failures.")
    page = models_page(found, cards)
    assert found.errors[0] in page
    few = compare_models({"A": card_of([0.5] * 3, errors=1, per_cell=100), "B": cards["B"]})
    assert few.models["A"].errors == 18, "1 %"
    assert not few.errors
    assert "errors" not in " ".join(few.verdicts)


def test_warnings_of_each_card_are_shown():
    exposed = planted_card(shipped(replicates=3), lambda condition, cell: 0.5, exposure="yes")
    cards = {"A": exposed, "B": card_of([0.5] * 3)}
    found = compare_models(cards)
    said = next(warning for warning in exposed.warnings if "pre-training" in warning)
    assert f"The card of A warns: {said}" in found.sentences
    own = models_page(found, cards).partition("Scores of each model")[2]
    of_a = own.partition(">A</h3>")[2].partition("</h3>")[0]
    of_b = own.partition(">B</h3>")[2]
    assert f'<p class="warning">{said}</p>' in of_a
    assert said not in of_b


# ------------------------------------------------------------------ adjusted p values


def test_an_interval_without_0_is_not_called_compatible_with_both():
    cards = {
        "A": card_of([0.5, 0.55, 0.6]), "D": card_of([0.7, 0.85, 0.8]),
        "E": card_of([0.6, 0.7, 0.75]), "F": card_of([0.65, 0.7, 0.6]),
    }  # fmt: skip
    found = compare_models(cards)
    pair = next(p for p in found.pairs if (p.first, p.second) == ("A", "D"))
    assert pair.difference.high < 0
    assert pair.p > 0.05
    sentence = next(s for s in found.sentences if s.startswith("Cannot tell whether A or D is better"))
    assert sentence == (
        f"Cannot tell whether A or D is better: the difference is {100 * pair.difference.value:+.0f} points, but p is "
        f"{pair.p:.2g} after adjustment for several comparisons, over 3 trainings each."
    )
    alone = compare_models({name: cards[name] for name in "AD"})
    assert alone.sentences[0].startswith("D is better than A by 23 points"), "one comparison needs no adjustment"


def test_letters_do_not_run_out():
    names = [f"model{i}" for i in range(56)]
    rates = {name: 1 - i / 100 for i, name in enumerate(names)}
    every = compact_letters(rates, {(a, b): True for i, a in enumerate(names) for b in names[i + 1 :]})
    assert [every[names[i]] for i in (0, 25, 26, 51, 52, 55)] == ["a", "z", "A", "Z", "(53)", "(56)"]
    assert len(set(every.values())) == 56
