"""Which demonstrations next: arms of equal numbers, spread by failures or evenly; rounds continue."""

import json
from dataclasses import replace

import pytest
from planted_cards import SKILL_AND_OBJECT, experiment_of, planted_card

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import design_of, experiment_config
from roboxim_eval.experiments.collection import next_round, shared_out
from roboxim_eval.experiments.config import ExperimentConfig

TEXT = (
    SKILL_AND_OBJECT
    + """
trainers: {bc: {command: "train {dataset} {out} {seed}", policy: bc, steps: 7}}
evaluate: {per_cell: 40, cells: {blind: unseen}}
compare: [{first: baseline, second: leave_out, where: unseen, primary: true}]
"""
)
WEAK = "place_on target=soda_can"


def planted(rate=lambda condition, cell: 0.1 if cell.key == WEAK else 0.9, config=None):
    return planted_card(design_of(config or experiment_of(TEXT)), rate)


def test_new_demonstrations_go_where_the_policy_fails_and_the_control_arm_has_as_many():
    found = next_round(planted(), 30)
    assert found.chosen[WEAK] > 15 > max(count for cell, count in found.chosen.items() if cell != WEAK)
    assert sorted(found.even.values()) == [7, 7, 8, 8]
    assert sum(found.chosen.values()) == sum(found.even.values()) == 30
    design = design_of(found.config)
    sizes = {name: sum(counts.values()) for name, counts in design.datasets.items()}
    assert sizes == {"made_to_order": 4 * 2 + 30, "uniform": 4 * 2 + 30}, "those of before and the new ones"
    assert design.demonstrations == {
        cell: max(counts[cell] for counts in design.datasets.values()) for cell in design.demonstrations
    }, "what both arms have is recorded once"
    assert len(design.trainings) == 6
    assert {training.seed for training in design.trainings} == {3, 4, 5}, "not those of the card"
    written = json.loads(json.dumps(to_plain(found.config)))
    assert experiment_config(written, source="round1.yaml") == found.config, "a file says all of it"


def test_the_next_round_continues_each_arm_from_its_own_demonstrations():
    first = next_round(planted(), 30)
    second = next_round(planted(lambda condition, cell: 0.5, first.config), 20)
    sizes = {name: sum(counts.values()) for name, counts in design_of(second.config).datasets.items()}
    assert sizes == {"made_to_order": 8 + 30 + 20, "uniform": 8 + 30 + 20}
    before, after = (one.config.datasets["made_to_order"].more[WEAK] for one in (first, second))
    assert after == before + second.chosen[WEAK]
    assert second.config.replicates.first_seed == 6
    plain = to_plain(second.config)
    assert from_plain(plain, ExperimentConfig, source="again") == second.config


def test_a_condition_without_held_out_cells_is_collected_and_judged_in_its_own_cells():
    found = next_round(planted(), 10, "leave_out")
    assert set(found.chosen) == {"pick_up target=soda_can", "place_on target=cube"}
    assert found.config.compare[0].where == "seen"
    assert {tuple(e.counts) for e in design_of(found.config).evaluations} == {tuple(found.chosen)}


def test_what_gives_no_round_is_refused():
    with pytest.raises(ConfigError, match="no condition 'blind' is trained"):
        next_round(planted(), 30, "blind")
    with pytest.raises(ConfigError, match="at least one demonstration a cell, 4; got 3"):
        next_round(planted(), 3)
    with pytest.raises(ConfigError, match="'baseline' is equally weak in all 4 cells.*both arms would have the same"):
        next_round(planted(lambda condition, cell: 1.0), 30)
    one = TEXT.replace("baseline: {cells: all", "baseline: {cells: all, only: [{task: pick_up, target: cube}]")
    with pytest.raises(ConfigError, match="'baseline' has one cell, 'pick_up target=cube', so that there is nothing"):
        next_round(planted(config=experiment_of(one)), 30)
    text = TEXT.replace("cells: {blind: unseen}", "cells: {blind: unseen, baseline: unseen, leave_out: unseen}")
    with pytest.raises(ConfigError, match="'baseline' was not evaluated in pick_up target=soda_can"):
        next_round(planted(config=experiment_of(text)), 30)
    odd = TEXT.replace("per_cell: 3}", "per_cell: 3, more: {fly: 2}}")
    with pytest.raises(ConfigError, match="datasets.leave_out.more: no cell 'fly'"):
        design_of(experiment_of(odd))


def test_shares_are_whole_and_add_up():
    assert shared_out(10, {"a": 1.0, "b": 1.0, "c": 1.0}) == {"a": 4, "b": 3, "c": 3}
    assert shared_out(7, {"a": 0.0, "b": 2.0}) == {"a": 0, "b": 7}


def test_the_next_round_is_judged_under_the_conditions_of_the_weak_cells():
    config = experiment_of(TEXT)
    conditions = dict(config.conditions)
    late = replace(conditions["baseline"], latency_ticks=2, instruction="Do it")
    found = next_round(planted(config=replace(config, conditions={**conditions, "baseline": late})), 30)
    assert {(one.latency_ticks, one.instruction) for one in found.config.conditions.values()} == {(2, "Do it")}
