"""Experiments: the file, cells and mixes, stages."""

import copy
from dataclasses import replace

import pytest
from trained_experiment import TEXT, config, planted

from roboxim_core.config import digest, from_plain, parse_yaml, to_plain
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import ExperimentConfig, analyse, cells_of, design_of, mix_of, scale_names, stages_of
from roboxim_eval.experiments.design import require_different

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
        (
            "scales:",
            "noise: {descents: 1, translation_mm: 0, rotation_mrad: 0}\nscales:",
            ["noise", "descents 1 is a share of translation_mm and rotation_mrad, which are both 0", "set one"],
        ),
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
