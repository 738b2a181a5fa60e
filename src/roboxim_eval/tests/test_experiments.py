"""Experiments: the file, cells and mixes, stages, and results of planted policies (simulated tables)."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from planted_cards import RATES, experiment_of

from roboxim_core.config import digest, from_plain, parse_yaml, to_plain
from roboxim_core.errors import ConfigError
from roboxim_eval.benchmark.config import benchmark_config
from roboxim_eval.benchmark.scores import benchmark_scores
from roboxim_eval.experiments import (
    ExperimentConfig,
    Outcomes,
    Rates,
    SideBySide,
    analyse,
    cells_of,
    cost_of,
    design_of,
    mix_of,
    scale_names,
    stages_of,
)
from roboxim_eval.experiments.cost import ASSUMED_SUCCEEDED, detectable_drop, fitted
from roboxim_eval.experiments.design import require_different
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Pairs, paired_difference
from roboxim_eval.statistics.power import Design as Size
from roboxim_eval.statistics.power import detectable
from roboxim_eval.statistics.tables import Count

TEXT = """
about: Do policies combine a skill and an object that they never saw together?
thesis: "5.4.3"
factors:
  task: {pick_up: {}, rotate: {arguments: {direction: {values: [clockwise]}}}}
  target: [cube, apple, onion]
dimensions: {task: skill, target: object}
unseen:
  - {task: pick_up, target: cube}
  - {task: rotate, target: apple}
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 27}
  baseline: {cells: all, per_cell: 18}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
  blind: {checkpoint_of: leave_out, instruction: ""}
trainers:
  bc: {command: "roboxim train bc {dataset} --out {out} --seed {seed} --steps {steps}", until: "--until {until}",
    policy: bc, steps: 4000}
evaluate: {per_cell: 20, cells: {blind: unseen}}
replicates: {count: 5}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
  - {first: leave_out, second: blind, where: unseen}
scales:
  smoke: {replicates: {count: 1}, evaluate: {per_cell: 2}, trainers: {bc: {steps: 50}}}
"""


def config(text=TEXT, **changes):
    return experiment_of(text, **changes)


# ------------------------------------------------------------------ the file


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("target: cube}", "target: cub}", ["unseen.0.target (line 9)", "'cub'", "did you mean 'cube'"]),
        ("{task: pick_up, target", "{skill: pick_up, target", ["unseen.0.skill (line 9)", "'skill'", "target, task"]),
        ("train: baseline}", "train: base_line}", ["conditions.baseline.train", "did you mean 'baseline'"]),
        ("checkpoint_of: leave_out", "checkpoint_of: blind", ["conditions.blind.checkpoint_of", "'blind'"]),
        ("{train: leave_out}", "{train: leave_out, given: true}", ["conditions.leave_out", "give one of"]),
        ("second: baseline,", "second: base,", ["compare.0.second (line 25)", "'base'"]),
        ("cells: seen,", "cells: unknown,", ["datasets.leave_out", "unknown 'unknown'", "seen"]),
        ("per_cell: 27", "per_cells: 27", ["per_cells", "did you mean 'per_cell'"]),
        ("{out}", "{output}", ["trainers.bc", "unknown placeholder 'output'"]),
        ("{seed}", "1", ["trainers.bc", "needs {seed}"]),
        ("{seed}", "{seed}{", ["trainers.bc", "command:", "a brace itself is written twice"]),
        ("policy: bc,", "policy: bc, options: {a: 1},", ["trainers.bc", "none has {checkpoint}"]),
        ("policy: bc,", "options: {a: '{checkpoint}'},", ["trainers.bc", "arguments of a policy"]),
        ("per_cell: 27", "per_cell: 27, export: {format: lerobot}", ["datasets.leave_out", "the trainer chooses"]),
        ("count: 5", "count: 0", ["replicates.count", "from 1"]),
        ("smoke: {replicates", "smoke: {thesis", ["scales.smoke.thesis"]),
        ("  task: {", "  skill: {", ["factors", "needs the factor 'task'"]),
        ("[cube, apple, onion]", "[cube, apple, cube]", ["factors.target", "appears twice"]),
        (
            "cells: {blind: unseen}",
            "cells: {baseline: seen}",
            ["compare.0", "'baseline' is not evaluated in", "pick_up"],
        ),
        (
            "  - {first: leave_out, second: blind, where: unseen}\nscales:",
            "scales:\n  full: {evaluate: {cells: {blind: seen}}}",
            ["evaluate.cells.blind", "'leave_out' without words", "pick_up target=cube", "blind: unseen or all"],
        ),
        ("count: 5}", "count: 5, vary: []}", ["replicates.vary", "would have the same seed", "vary: [training]"]),
        ("count: 5}", "count: 5, vary: [train]}", ["replicates.vary", "unknown 'train'"]),
    ],
)
def test_a_wrong_experiment_is_refused_at_the_door(old, new, said):
    assert old in TEXT
    with pytest.raises(ConfigError) as caught:
        design_of(config(TEXT.replace(old, new, 1)))
    for words in said:
        assert words in str(caught.value)


def test_a_scale_replaces_keys_of_the_file():
    assert scale_names(config()) == ("smoke", "full")
    small = config(scale="smoke")
    assert (small.replicates.count, small.evaluate.per_cell, small.trainers["bc"].steps) == (1, 2, 50)
    assert small.evaluate.cells == {"blind": "unseen"}
    assert small.trainers["bc"].policy == "bc"
    with pytest.raises(ConfigError, match="no scale 'smok'.*did you mean 'smoke'"):
        config(scale="smok")


def test_keys_that_came_later_change_no_hash_of_experiments_without_them():
    plain = to_plain(config())
    assert not {"dataset", "options", "serve"} & plain["trainers"]["bc"].keys()
    assert "export" not in plain["datasets"]["leave_out"]
    hashes = {stage.name: stage.sha for stage in stages_of(design_of(config()))}
    other = config(TEXT.replace("per_cell: 27", "per_cell: 27, export: {actions: tool}"))
    assert to_plain(other)["datasets"]["leave_out"]["export"] == {"actions": "tool"}
    assert from_plain(to_plain(other), ExperimentConfig) == other
    changed = {stage.name for stage in stages_of(design_of(other)) if stage.sha != hashes[stage.name]}
    assert {"export/leave_out.0", "train/leave_out.0"} <= changed
    assert not {"generate/0", "export/baseline.0"} & changed
    served = config(TEXT.replace("policy: bc,", "policy: mine, options: {url: 'ws://a:1', v: '{checkpoint}'},"))
    changed = {stage.name for stage in stages_of(design_of(served)) if stage.sha != hashes[stage.name]}
    assert {name.partition("/")[0] for name in changed} == {"evaluate", "prove"}


def test_a_policy_without_words_may_be_evaluated_anywhere_if_no_score_needs_it():
    text = TEXT.replace("  - {first: leave_out, second: blind, where: unseen}\n", "")
    for cells in ("unseen", "all"):
        design = design_of(config(text, evaluate={"cells": {"blind": cells}}))
        found = analyse(design, planted(design, lambda name, unseen: 0.05 if name == "blind" else 0.85))
        assert found.scores.words.value > 0.5
    whole = text.replace("where: unseen, primary", "where: seen, primary")
    design = design_of(config(whole, evaluate={"cells": {"blind": "seen"}}))
    assert analyse(design, planted(design, lambda name, unseen: 0.5)).scores is None


# ------------------------------------------------------------------ cells, mixes, stages


def test_cells_are_named_as_mixes_record_them():
    assert [cell.key for cell in cells_of(config()) if cell.unseen] == ["pick_up target=cube", "rotate target=apple"]
    camera = TEXT.replace("  target: [cube", "  camera: {left: {reset: {}}, right: {}}\n  target: [cube")
    keys = [cell.key for cell in cells_of(config(camera))]
    assert keys[0] == "pick_up target=cube camera=left"
    assert len(keys) == 12
    some = config(camera, cells=[{"camera": "left", "target": "cube"}, {"camera": "right", "target": "apple"}])
    assert len(cells_of(some)) == 4
    with pytest.raises(ConfigError, match="unseen: no cell matches"):
        cells_of(config(camera, cells=[{"target": "onion"}]))


def test_a_mix_has_a_part_for_each_cell():
    mix = mix_of(config(), {"pick_up target=apple": 3, "rotate target=cube": 2}, {"distractors": {"models": None}})
    assert mix == {
        "seed_by": "cell",
        "cells": [
            {"tasks": ["pick_up"], "episodes": 3, "models": {"target": ["apple"]}},
            {
                "tasks": ["rotate"], "episodes": 2, "models": {"target": ["cube"]},
                "set": {"arguments": {"direction": {"values": ["clockwise"]}}},
            },
        ],
        "set": {"distractors": {"minimum": 0, "maximum": 0, "models": None}},
    }  # fmt: skip


def test_arms_share_the_demonstrations_of_the_cells_that_they_share():
    design = design_of(config())
    assert sum(design.datasets["leave_out"].values()) == 4 * 27
    assert sum(design.datasets["baseline"].values()) == 6 * 18
    assert design.episodes == 4 * 27 + 2 * 18, "not the sum of both"
    assert design.demonstrations["pick_up target=cube"] == 18
    assert design.compared_scenes == 40
    varied = design_of(config(replicates={"count": 5, "vary": ["training", "data"]}))
    assert varied.episodes == 5 * design.episodes


def seeds_of(vary):
    """Return the seeds of a condition's trainings, and their exports, where these things vary."""
    stages = [s for s in stages_of(design_of(config(replicates={"count": 3, "vary": vary}))) if s.kind == "train"]
    mine = [stage for stage in stages if stage.name.startswith("train/baseline.")]
    return [stage.inputs["seed"] for stage in mine], [stage.needs[0] for stage in mine]


def test_trainings_differ_in_what_varies_alone():
    same, each = ["export/baseline.0"] * 3, [f"export/baseline.{replicate}" for replicate in range(3)]
    assert seeds_of(["training"]) == ([0, 1, 2], same)
    assert seeds_of(["training", "data"]) == ([0, 1, 2], each)
    assert seeds_of(["data"]) == ([0, 0, 0], each)
    design = design_of(config(replicates={"count": 3, "vary": ["data"]}))
    assert {training.seed for training in design.trainings} == {0}
    given = {name: {"given": True} for name in ("leave_out", "baseline")}
    public = design_of(config(conditions=given, compare=[], evaluate={}, replicates={"count": 3, "vary": []}))
    assert not public.trainings, "nothing is trained, so nothing has to vary"


def test_stages_keep_their_hashes():
    """A change of these hashes makes every experiment that is under way begin again."""
    curve = {"every": 1000, "per_checkpoint": 10, "replicates": 1}
    assert digest({stage.name: stage.sha for stage in stages_of(design_of(config()))}) == "a1469aabb1bdf38a"
    varied = config(curve=curve, replicates={"count": 3, "vary": ["training", "data"]})
    assert digest({stage.name: stage.sha for stage in stages_of(design_of(varied))}) == "68dc6e05ecae66a6"


def test_every_condition_and_replicate_is_trained_and_evaluated():
    design = design_of(config())
    assert {(t.condition, t.replicate) for t in design.trainings} == {
        (name, r) for name in ("leave_out", "baseline") for r in range(5)
    }
    assert len(design.evaluations) == 15
    assert design.rollouts == 5 * (120 + 120 + 40)


def test_a_condition_adds_arguments_to_the_command_of_its_trainer_alone():
    text = TEXT.replace("baseline: {train: baseline}", "baseline: {train: baseline, arguments: {bc: --set depth=2}}")
    changed = config(text)
    before = {s.name: s for s in stages_of(design_of(config()))}
    after = {s.name: s for s in stages_of(design_of(changed))}
    plain = before["train/baseline.1"].inputs["command"]
    assert after["train/baseline.1"].inputs["command"] == f"{plain} --set depth=2"
    assert after["train/leave_out.1"].sha == before["train/leave_out.1"].sha
    assert "arguments" not in to_plain(changed)["conditions"]["leave_out"]
    other = replace(changed, trainers={**changed.trainers, "mine": changed.trainers["bc"]})
    with pytest.raises(ConfigError, match="conditions.baseline: arguments are for bc alone.*mine"):
        design_of(other, "mine")
    with pytest.raises(ConfigError, match="arguments.bd .line 17.: unknown name 'bd'; expected one of: act, bc, "):
        config(text.replace("arguments: {bc:", "arguments: {bd:"))
    with pytest.raises(ConfigError, match="arguments: are those of a training"):
        config(TEXT.replace("{checkpoint_of: leave_out,", "{checkpoint_of: leave_out, arguments: {bc: --set depth=2},"))


def test_conditions_that_would_be_trained_alike_are_refused():
    alike = TEXT.replace("baseline: {train: baseline}", "baseline: {train: leave_out}")
    assert alike != TEXT
    with pytest.raises(ConfigError, match=r"conditions.baseline: would be trained like 'leave_out'.*checkpoint_of"):
        require_different(design_of(config(alike)))
    longer = alike.replace("baseline: {train: leave_out}", "baseline: {train: leave_out, steps: 3}")
    require_different(design_of(config(longer)))


def test_a_faulty_dataset_has_all_demonstrations_so_that_its_share_is_exact():
    data = copy.deepcopy(dict(parse_yaml(TEXT)["datasets"]))
    data["baseline"] |= {"fault": "wrong_instruction", "share": 0.3}
    with pytest.raises(ConfigError, match="datasets.baseline: a fault is planted in a share of all demonstrations"):
        design_of(config(datasets=data))
    data["baseline"]["per_cell"] = data["leave_out"]["per_cell"]
    stages = {stage.name: stage for stage in stages_of(design_of(config(datasets=data)))}
    assert stages["export/baseline.0"].needs == ("corrupt/baseline.0",)
    assert stages["export/leave_out.0"].needs == ("generate/0",)
    assert stages["train/baseline.0"].needs == ("export/baseline.0", "prove/training.0")


def test_curves_and_final_evaluations_never_meet_the_same_scenes():
    design = design_of(config(curve={"every": 1000, "per_checkpoint": 10, "replicates": 1}))
    assert [t.checkpoints for t in design.trainings if t.replicate == 0] == [(1000, 2000, 3000, 4000)] * 2
    assert not any(t.checkpoints for t in design.trainings if t.replicate)
    curve = [e for e in design.evaluations if e.checkpoint]
    assert all(e.rollouts == 10 and not set(e.counts) & {"pick_up target=cube"} for e in curve)
    stages = [stage for stage in stages_of(design) if stage.kind == "evaluate"]
    seeds = {bool(stage.inputs["checkpoint"]): set() for stage in stages}
    for stage in stages:
        seeds[bool(stage.inputs["checkpoint"])].add(stage.inputs["seed"])
    assert not seeds[True] & seeds[False]


def test_the_points_of_a_curve_are_proved_by_a_stage_of_their_own():
    curve = {"every": 1000, "per_checkpoint": 10, "replicates": 1}
    without = {stage.name: stage.sha for stage in stages_of(design_of(config()))}
    assert not any(name.startswith("prove/curve") for name in without)
    stages = {stage.name: stage for stage in stages_of(design_of(config(curve=curve)))}
    proof = stages["prove/curve.0"]
    assert set(proof.needs) == {name for name in stages if "@" in name}
    assert len(proof.needs) == 8
    assert (proof.part, proof.of_curve, stages["prove/evaluation.0"].of_curve) == ("evaluate", True, False)
    assert "prove/curve.1" not in stages
    assert stages["prove/evaluation.1"].sha == without["prove/evaluation.1"]


def test_arms_of_a_replicate_meet_the_same_scenes_and_replicates_meet_others():
    stages = {s.name: s for s in stages_of(design_of(config())) if s.kind == "evaluate"}
    assert stages["evaluate/leave_out.1"].inputs["seed"] == stages["evaluate/baseline.1"].inputs["seed"]
    assert stages["evaluate/leave_out.1"].inputs["seed"] != stages["evaluate/leave_out.2"].inputs["seed"]
    assert stages["evaluate/blind.1"].needs == ("train/leave_out.1",)
    assert stages["evaluate/blind.1"].inputs["instruction"] == ""


def test_a_changed_input_changes_the_stages_behind_it_alone():
    def changed(**changes):
        before = {s.name: s.sha for s in stages_of(design_of(config()))}
        after = {s.name: s.sha for s in stages_of(design_of(config(**changes)))}
        return {name.split("/")[0] for name in before if before[name] != after[name]}

    assert changed(evaluate={"per_cell": 10, "cells": {"blind": "unseen"}}) == {"evaluate", "prove"}
    data = copy.deepcopy(dict(parse_yaml(TEXT)["datasets"]))
    data["baseline"] = {"cells": "all", "per_cell": 12}
    assert changed(datasets=data) == {"generate", "export", "train", "evaluate", "prove"}
    assert changed(about="Other words") == set()
    names = [s.name for s in stages_of(design_of(config()))]
    for stage in stages_of(design_of(config())):
        assert all(names.index(need) < names.index(stage.name) for need in stage.needs)


# ------------------------------------------------------------------ cost


def test_the_cost_follows_from_measured_rates():
    design = design_of(config())
    cost = cost_of(design, RATES)
    assert cost.train_s == pytest.approx(10 * (4000 / 5.7 + 10))
    assert cost.evaluate_s == pytest.approx(1400 * (4.0 + 0.1) + 15 * 10 + 5 * 5 + 7 + 3 * 8 * 0.5)
    assert cost.generate_s == pytest.approx(144 * (1.2 + 0.1) + 216 * 0.1 + 10 + 5)
    assert cost.disk_bytes == pytest.approx((144 + 10 + 1400) * 1e7 + 216 * 1e6)
    assert 0.1 < cost.detectable < 0.3
    away = cost_of(design_of(config(trainers={"external": {}})), RATES)
    assert away.train_s is None
    assert away.total_s == pytest.approx(cost.generate_s + cost.evaluate_s)
    assert cost.failing_s == pytest.approx(cost.evaluate_s + 1400 * 0.8 * (8.0 - 3.0))
    with pytest.raises(ConfigError, match="share of successes"):
        replace(RATES, succeeded=1.5)
    with pytest.raises(ConfigError, match="steps_per_s"):
        Rates(**{**vars(RATES), "steps_per_s": 0.0})


def test_faults_are_planted_in_one_process():
    design = design_of(config())
    faulty = replace(design.config.datasets["baseline"], fault="wrong_instruction", share=0.25)
    datasets = {**design.config.datasets, "baseline": faulty}
    planted = replace(design, config=replace(design.config, datasets=datasets))
    more_s = cost_of(planted, RATES).generate_s - cost_of(design, RATES).generate_s
    assert more_s == pytest.approx(0.25 * sum(design.datasets["baseline"].values()) * 2 * 1.2)


def test_failures_last_longer_and_their_share_is_that_of_the_last_run():
    design = design_of(config())
    assumed, ran = cost_of(design, RATES), cost_of(design, replace(RATES, succeeded=0.25))
    assert (assumed.succeeded, ran.succeeded) == (ASSUMED_SUCCEEDED, 0.25)
    assert ran.evaluate_s - assumed.evaluate_s == pytest.approx(1400 * 0.55 * (8.0 - 3.0))
    short = replace(design, trainings=tuple(replace(one, steps=50) for one in design.trainings))
    assert cost_of(short, RATES).evaluate_s == pytest.approx(assumed.failing_s), "50 steps teach nothing"


def side_by_side(trainings, steps_per_s, start_s):
    return SideBySide(
        trainings=trainings, steps_per_s=steps_per_s, start_s=start_s, measured="2026-01-02", source="test"
    )


def test_trainings_side_by_side_share_what_there_is():
    rates, design = RATES.learned(side_by_side(2, 4.0, 20.0)), design_of(config())
    one = design.trainings[0]

    def train_s(trainings, *, of, known=rates):
        return cost_of(
            replace(design, trainings=tuple(replace(one, steps=steps) for steps in of)), known, trainings
        ).train_s

    assert cost_of(design, rates).train_s == pytest.approx(10 * (4000 / 5.7 + 10)), "one at a time"
    assert cost_of(design, rates, 2).train_s == pytest.approx(5 * (4000 / 4.0 + 20))
    assert train_s(2, of=[4000] * 3) == pytest.approx(4000 / 4.0 + 20 + 4000 / 5.7 + 10), "the last one is alone"
    left = 1 - (1000 / 4.0 + 20) / (2000 / 4.0 + 20)
    assert train_s(2, of=[2000, 1000]) == pytest.approx(1000 / 4.0 + 20 + left * (2000 / 5.7 + 10)), "the rest is alone"
    assert train_s(8, of=[4000], known=RATES) == pytest.approx(4000 / 5.7 + 10)
    with pytest.raises(ConfigError, match="rate of 4 trainings at a time was not measured.*--trainings 4"):
        cost_of(design, rates, 4)
    one_after_the_other, two = (fitted(config(), rates, 6 * 3600, trainings=number) for number in (1, 2))
    assert two.replicates.count > one_after_the_other.replicates.count


def test_rates_of_trainings_are_kept_by_their_number():
    rates = RATES.learned(side_by_side(4, 3.0, 40.0)).learned(side_by_side(2, 4.0, 20.0), side_by_side(4, 2.0, 30.0))
    assert [(rate.trainings, rate.steps_per_s) for rate in rates.side_by_side] == [(2, 4.0), (4, 2.0)]
    assert (rates.at_once(1).steps_per_s, rates.at_once(4).steps_per_s) == (RATES.steps_per_s, 2.0)
    between = rates.at_once(3)
    assert (between.steps_per_s, between.start_s) == (pytest.approx(3.0), pytest.approx(25.0))
    assert between.source == "between 2 and 4 at a time, which were measured"
    assert rates.at_once(5) is None
    with pytest.raises(ConfigError, match="start_s"):
        side_by_side(2, 4.0, 0.0)


def test_a_budget_buys_the_smallest_difference_that_can_be_found():
    cheap, dear = (fitted(config(), RATES, hours * 3600) for hours in (2, 6))
    assert cost_of(design_of(cheap), RATES).total_s <= 2 * 3600
    assert cheap.replicates.count >= 3
    assert dear.replicates.count > cheap.replicates.count
    assert cost_of(design_of(dear), RATES).detectable < cost_of(design_of(cheap), RATES).detectable
    assert fitted(config(), RATES, 60.0) is None
    one = config(evaluate={"per_cell": 20, "per_unseen_cell": 1})
    for hours in (2, 3, 4, 6):
        assert 1 <= fitted(one, RATES, hours * 3600).evaluate.per_unseen_cell <= 3, "0 would be as many as per_cell"


# ------------------------------------------------------------------ planted policies


def planted(design, rate, *, seed=0, spread=0.0, failed=None, pairs=None):
    """Return the outcomes of policies whose success rates are planted: `rate(condition, cell)`."""
    rng = np.random.default_rng(seed)
    counts = {}
    for name in design.config.conditions:
        wanted = next(e.counts for e in design.evaluations if e.condition == name and not e.checkpoint)
        unseen = {cell.key: cell.unseen for cell in design.cells}
        counts[name] = []
        for _ in range(design.config.replicates.count):
            shift = rng.normal() * spread / 0.16
            row = {}
            for key, episodes in wanted.items():
                p = rate(name, unseen[key])
                p = 1 / (1 + math.exp(-(math.log(p / (1 - p)) + shift))) if 0 < p < 1 else p
                row[key] = Count(successes=int(rng.binomial(episodes, p)), episodes=episodes)
            counts[name].append(row)
    return Outcomes(counts=counts, failed=failed, pairs=pairs or {})


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


SEEN_AND_UNSEEN = TEXT.replace(
    "  - {first: leave_out, second: baseline, where: unseen, primary: true}\n",
    "  - {first: leave_out, second: leave_out, where: unseen, against: seen, primary: true}\n",
)


def test_other_cells_of_one_checkpoint_have_no_scenes_in_common():
    design = design_of(config(SEEN_AND_UNSEEN, replicates={"count": 1}))
    itself = {0: [Pairs(both=20, first=0, second=0, neither=20)]}  # a card's pairs are those of the first cells
    rate = {True: 0.2, False: 0.9}
    outcomes = planted(design, lambda name, unseen: rate[unseen], pairs=itself)
    found = analyse(design, outcomes)
    assert "These rates of one checkpoint differ by" in found.sentences[0]
    assert found.comparisons[0].verdict.kind == "cannot_tell"
    assert found == analyse(design, replace(outcomes, pairs={}))


def test_a_plan_knows_where_both_sides_are_the_same_checkpoints():
    def drop(text=TEXT, **changes):
        changes = {"replicates": {"count": 3}, "evaluate": {"per_cell": 12, "per_unseen_cell": 25}} | changes
        return detectable_drop(design_of(config(text, **changes)))

    apart = drop()
    against_seen = drop(SEEN_AND_UNSEEN)
    in_other_words = drop(compare=[{"first": "leave_out", "second": "blind", "where": "unseen"}])
    assert apart == pytest.approx(detectable(Size(replicates=3, scenes=50)))
    assert against_seen == pytest.approx(
        detectable(Size(replicates=3, scenes=48, other_scenes=50, same_checkpoints=True))
    )
    assert in_other_words < against_seen < apart
    one = SEEN_AND_UNSEEN.replace("replicates: {count: 5}", "replicates: {count: 1}")
    assert detectable_drop(design_of(config(one))) is None, "on different scenes one training always 'cannot tell'"


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
