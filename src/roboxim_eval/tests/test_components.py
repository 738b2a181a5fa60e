"""Variance components of cards, and what a budget buys by them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cards import RATES, planted_card, shipped

from roboxim_core.config import load_yaml, named_config
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_eval.experiments import experiment_config
from roboxim_eval.experiments.allocation import allocated, allocation_of
from roboxim_eval.experiments.card_checks import check_card
from roboxim_eval.experiments.spread import card_pairing, card_spreads, primary_components, spread_data, spread_rows
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.statistics.components import (
    Components,
    arm_components,
    difference_components,
    pooled_components,
)
from roboxim_eval.statistics.replicates import condition_difference
from roboxim_eval.statistics.tables import Arm, Count

RESULTS = Path(__file__).parents[3] / "docs/results"
PUBLISHED = {
    "skill_object-night": ((42, 21, 20), ((5.4, 2.7), (3.6, 2.7))),
    "skill_object-laptop": ((44, 21, 23), ((4.1, 2.6), (2.9, 3.0))),
    "camera_object-night": ((7, 10, 7), ((9.4, 3.0), (5.4, 3.0))),
    "camera_skill-night": ((18, 19, 6), ((6.7, 5.4), (1.7, 5.1))),
}
"""Card to SDs between cells (leave_out, baseline, and of the cells' own gaps), and of trainings with the part of the
rollouts, in points; from a script of its own."""


def published(name):
    return check_card(json.loads((RESULTS / name / "card.json").read_text()))


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_cards_have_the_components_that_were_computed_independently(name):
    between_cells, of_trainings = PUBLISHED[name]
    found = {one.name: one.components for one in card_spreads(published(name))}
    for key, cells in zip(("leave_out", "baseline"), between_cells, strict=False):
        assert 100 * found[key].cell ** 0.5 == pytest.approx(cells, abs=0.55)
    gap = found["leave_out - baseline"]
    assert 100 * (gap.mean_squares[1] / gap.replicates) ** 0.5 == pytest.approx(between_cells[2], abs=0.55)
    for key, (observed, rollouts) in zip(("leave_out", "baseline"), of_trainings, strict=True):
        assert 100 * found[key].observed ** 0.5 == pytest.approx(observed, abs=0.06)
        assert 100 * found[key].rollouts ** 0.5 == pytest.approx(rollouts, abs=0.06)


def test_intervals_of_a_card_are_those_of_its_scores_and_wider_with_cells_as_a_sample():
    card = published("skill_object-night")
    gap = spread_data(card)[-1]
    assert gap["cells_fixed"] == pytest.approx(card.verdicts[0].difference, abs=1e-6)
    assert gap["cells_random"][1] < gap["cells_fixed"][1]
    assert gap["cells_random"][2] > gap["cells_fixed"][2]
    assert [row["random"] for row in spread_rows(card)][-1] == "-47 to +4"
    page = experiment_page(ExperimentPage(card=card))
    assert "What the intervals are made of" in page
    assert "-47 to +4" in page


def test_a_report_says_what_pairs_of_one_seed_have_in_common():
    design = shipped("skill_object", replicates=8)
    card = planted_card(design, lambda condition, cell: 0.5)
    luck = np.random.default_rng(3).permutation(8)

    def of(shared):
        """Return the card with trainings of 6 to 13 successes in 20, the baseline's alike if `shared`."""
        rows = [
            replace(
                row,
                by_cell=dict.fromkeys(
                    row.by_cell,
                    (6 + int(luck[row.replicate if shared or row.condition != "baseline" else -row.replicate]), 20, 0),
                ),
            )
            for row in card.evaluations
        ]
        return replace(card, evaluations=tuple(rows))

    found = card_pairing(of(shared=True))
    assert found.trainings == 8
    assert found.correlation.value == pytest.approx(1)
    assert found.paired == pytest.approx(0, abs=1e-9)
    assert found.unrelated == pytest.approx(np.sqrt(2) * np.std(np.arange(8) / 20, ddof=1))
    apart = of(shared=False)
    other = card_pairing(apart)
    assert -1 < other.correlation.low < other.correlation.value < other.correlation.high < 0.99
    assert other.sentence in experiment_page(ExperimentPage(card=apart))
    assert card_pairing(published("skill_object-night")) is None, "three pairs have no interval of a correlation"


def simulated(rng, parts, replicates, cells, episodes, *, cell_rates=None):
    """Return the arm of a condition whose trainings and cells vary as told."""
    training, cell, both = parts
    offsets = rng.normal(0, cell, cells) if cell_rates is None else np.array(cell_rates)
    rates = 0.5 + rng.normal(0, training, (replicates, 1)) + offsets + rng.normal(0, both, (replicates, cells))
    counts = rng.binomial(episodes, np.clip(rates, 0, 1))
    return Arm(replicates=tuple({str(c): Count(successes=int(k), episodes=episodes) for c, k in enumerate(row)}
                                for row in counts))  # fmt: skip


def test_simulated_tables_have_the_components_that_were_put_in():
    rng, parts = np.random.default_rng(0), (0.08, 0.12, 0.06)
    found = [arm_components(simulated(rng, parts, 6, 8, 20)) for _ in range(300)]
    # estimates below 0 become 0, so that small components come out a little large
    for name, put_in in zip(("training", "cell", "cell_training"), parts, strict=True):
        assert np.sqrt(np.mean([getattr(one, name) for one in found])) == pytest.approx(put_in, rel=0.12), name
    assert np.sqrt(np.mean([one.scene for one in found])) == pytest.approx(np.sqrt(0.229 / 20), rel=0.05)
    pooled = pooled_components(found)
    assert np.sqrt(pooled.training) == pytest.approx(0.08, rel=0.12)


def test_one_training_or_one_cell_leaves_components_out():
    rng = np.random.default_rng(1)
    one = arm_components(simulated(rng, (0.05, 0.1, 0.0), 1, 4, 10))
    assert one.training is None
    assert one.cell_training is None
    assert np.isinf(one.random_interval().high)
    assert arm_components(simulated(rng, (0.05, 0.1, 0.0), 3, 1, 10)).cell is None
    single = arm_components(simulated(rng, (0.05, 0.1, 0.0), 3, 4, 1))
    assert single.scene > 0, "one rollout has no variance of its own: the trainings' together has"
    with pytest.raises(InvalidRequestError, match="no cell has a rollout"):
        arm_components(Arm(replicates=({"a": Count(successes=0, episodes=0)},)))


def test_components_need_a_comparison_and_two_trainings():
    with pytest.raises(ConfigError, match="one training"):
        primary_components(published("bc_ablation-laptop"))


BUDGET_S = 3.04 * 3600
PARTS = Components(value=0, replicates=3, cells=6, episodes=20, mean_squares=(0.035, 0.1, 0.012), scene=0.0088)


def laptop():
    return experiment_config(load_yaml(named_config("experiments", "skill_object")), scale="laptop")


@pytest.mark.thorough
def test_a_budget_buys_more_trainings_than_the_shipped_scale_and_costs_no_more():
    config = laptop()
    before, found = allocation_of(config, RATES, PARTS), allocated(config, RATES, PARTS, BUDGET_S)
    assert (before.trainings, before.cells, before.rollouts) == (3, 6, 20)
    assert found.seconds <= BUDGET_S
    assert found.trainings > 3
    assert found.half_width < 0.75 * before.half_width
    assert allocated(config, RATES, PARTS, 60) is None
    rollouts = replace(PARTS, mean_squares=(PARTS.scene,) * 3, scene=0.05)
    assert allocated(config, RATES, rollouts, 8 * 3600).rollouts > allocated(config, RATES, PARTS, 8 * 3600).rollouts


@pytest.mark.parametrize("training", [0.02, 0.05, 0.10])
def test_the_chosen_size_has_narrower_intervals_than_three_trainings_at_equal_cost(training):
    """Simulated experiments of both sizes; the components are those of one simulated earlier card."""
    rng = np.random.default_rng(7)
    parts, config, offsets = (training, 0.0, 0.04), laptop(), np.linspace(-0.3, 0.3, 6)

    def width(replicates, episodes):
        widths = []
        for _ in range(200):
            arms = [simulated(rng, parts, replicates, 6, episodes, cell_rates=offsets) for _ in range(2)]
            interval = condition_difference(*arms).interval()
            widths.append(interval.high - interval.low)
        return np.mean(widths)

    earlier = [simulated(rng, parts, 3, 6, 20, cell_rates=offsets) for _ in range(2)]
    chosen = allocated(config, RATES, difference_components(*earlier), BUDGET_S)
    assert width(chosen.trainings, chosen.rollouts) < 0.9 * width(3, 20), (chosen.trainings, chosen.rollouts)


def test_the_table_of_the_documentation_is_that_of_the_cards():
    text = (RESULTS.parent / "explanation/statistics.md").read_text()
    for name in PUBLISHED:
        for row in spread_rows(published(name)):
            if row["name"] != "blind":
                values = [row[key] for key in ("name", "training", "cell", "both", "scene", "fixed", "random")]
                assert f"| {name.replace('-', ' at ')} | {' | '.join(values)} |" in text
