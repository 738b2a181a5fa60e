"""Proofs of delivery from real bags: clean ones pass; a moved camera, a lost distractor, a held-out episode do not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.poses import Pose
from roboxim_eval.experiments.cells import mix_of
from roboxim_eval.experiments.design import design_of
from roboxim_eval.experiments.proving.changes import changed_parts
from roboxim_eval.experiments.proving.proofs import Tally, Trained, tally, training_tally
from roboxim_policies.builtin import ZeroPolicy
from roboxim_policies.reworded import RewordedPolicy
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.edited import copy_edited
from roboxim_recorder.export import export_bags
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.episodes.reenactment import Recorded, Reenactor
from roboxim_runs.experiments.delivery.demands import demands_of
from roboxim_runs.experiments.delivery.proving import (
    ArmClaim,
    DatasetClaim,
    Reading,
    prove_evaluation,
    prove_trained_on,
    prove_training,
)
from roboxim_runs.experiments.delivery.reader import DeliveryReader
from roboxim_runs.experiments.files import load_experiment
from roboxim_runs.training.run import name_dataset

CELL = "pick_up target=cube"
MIX = {
    "seed_by": "cell",
    "cells": [{"tasks": ["pick_up"], "models": {"target": ["cube"]}, "episodes": 4}],
    "set": {"distractors": {"minimum": 1, "maximum": 1}},
}
CAMERA = "workspace"


def record(out, mix, episodes, **config):
    """Record episodes of a mix, and the results as a run has them."""
    try:
        graph = CoreGraph(out, policy=config.pop("policy", None))
    except SimError as error:
        pytest.skip(str(error))
    with graph:
        runner = EpisodeRunner(
            graph.ports,
            RunConfig(task_config=yaml.safe_dump(mix), output_dir=str(out), image_width=96, image_height=96, **config),
        )
        results = [runner.run_index(index) for index in range(episodes)]
    lines = [json.dumps({**to_plain(result), "key": ""}) for result in results]
    (out / "results.jsonl").write_text("\n".join(lines) + "\n")
    return results


@pytest.fixture(scope="module")
def rollouts(tmp_path_factory):
    """Four short rollouts of a policy that holds still."""
    out = tmp_path_factory.mktemp("rollouts")
    record(out, MIX, 4, policy=ZeroPolicy(), max_steps=1, settle_ticks=1)
    return out


def shown_of(bags, mix=MIX):
    reader, demands = DeliveryReader(ModelLibrary()), demands_of(json.dumps(mix))
    try:
        return demands, [reader.read(bag, demands.get) for bag in bags]
    finally:
        reader.close()


def moved(camera, metres):
    x, y, z = camera.pose.position
    return replace(camera, pose=Pose(position=(x, y + metres, z), quat_xyzw=camera.pose.quat_xyzw))


def with_camera_moved(bags, out, metres):
    """Record episodes again with the camera elsewhere."""
    with Reenactor(out) as sim:
        for bag in bags:
            recorded = Recorded.of(bag)
            cameras = tuple(moved(c, metres) if c.name == CAMERA else c for c in recorded.info.scene.cameras)
            sim.record(recorded, replace(recorded.info.scene, cameras=cameras), recorded.acts)
    return list_bags(out)


def test_clean_rollouts_pass_every_check(rollouts, tmp_path):
    arm = ArmClaim(condition="mine", folder=rollouts, mix=MIX, words=None)
    other = replace(arm, condition="other", folder=Path(shutil.copytree(rollouts, tmp_path / "other")))
    found, excluded = prove_evaluation([arm, other], Reading(logs=tmp_path))
    assert found.faults == ()
    assert excluded == {}
    assert set(found.checks.values()) == {(8, 8)}
    assert "pairing" in found.checks
    (shown, *_) = shown_of(list_bags(rollouts)[:1])[1]
    assert shown.tool_px[CAMERA] == 0.0
    assert min(shown.pixels["target"], shown.pixels["distractor_1"]) > 100
    assert shown.received == (shown.instruction,)
    assert shown.weights["target"] == pytest.approx(shown.physics["target"]["mass_kg"], rel=0.01)


def test_a_camera_moved_by_5_cm_is_found_with_bag_and_figure(rollouts, tmp_path):
    bags = with_camera_moved(list_bags(rollouts)[:3], tmp_path / "moved", 0.05)
    demands, shown = shown_of(bags)
    found = tally(demands, shown)
    assert found.faulty == {str(bag) for bag in bags}
    assert found.checks["camera"] == (0, 3)
    assert all(
        "camera 'workspace' is 5.0 cm from the demanded pose" in str(f) for f in found.faults if f.check == "camera"
    )


def test_pictures_from_elsewhere_are_found_although_the_bag_claims_the_right_pose(rollouts, tmp_path):
    bag = list_bags(rollouts)[0]
    (elsewhere,) = with_camera_moved([bag], tmp_path / "moved", 0.05)
    right = next(m for _, _, m in BagReader(bag).messages((topics.INFO,)))

    def lie(topic, message):
        if topic == topics.INFO:
            message.scene.cameras = right.scene.cameras

    lying = (
        tmp_path
        / "lying"
        / copy_edited(elsewhere, tmp_path / "lying", (topics.INFO,), lie).relative_to(tmp_path / "lying")
    )
    demands, shown = shown_of([lying])
    assert shown[0].tool_px[CAMERA] > 2.0
    (fault,) = [fault for fault in tally(demands, shown).faults if fault.check == "camera"]
    assert fault.bag == str(lying)
    assert "px from its projection" in fault.text


def test_a_missing_distractor_is_found(rollouts, tmp_path):
    bag = list_bags(rollouts)[0]

    def drop(topic, message):
        for entity in message.entities if topic == topics.STATE else ():
            if entity.name == "distractor_1":
                entity.pose.position.z = -0.7

    fallen = copy_edited(bag, tmp_path / "fallen", (topics.STATE,), drop)
    demands, shown = shown_of([fallen])
    (fault,) = [fault for fault in tally(demands, shown).faults if fault.check == "distractors"]
    assert (fault.bag, fault.text) == (str(fallen), "0 distractors lie on the table, 1 expected")


def test_the_words_that_reach_a_policy_are_in_its_bag(tmp_path, monkeypatch):
    class Deaf(RewordedPolicy):
        """Claims to pass on no words, and passes on the task's at its requests."""

        def act(self, window):
            return self._policy.act(window)

    quick = {"max_steps": 1, "settle_ticks": 1}
    record(tmp_path / "blind", MIX, 1, policy=RewordedPolicy(policy="zero"), **quick)
    record(tmp_path / "broken", MIX, 1, policy=Deaf(policy="zero"), **quick)
    monkeypatch.setattr(GuardedPolicy, "_received", lambda self: ())
    record(tmp_path / "old", MIX, 1, policy=RewordedPolicy(policy="zero"), **quick)

    def proof(name, words):
        arm = ArmClaim(condition=name, folder=tmp_path / name, mix=MIX, words=words)
        return prove_evaluation([arm], Reading(logs=tmp_path))[0]

    assert proof("blind", "").checks["words"] == (1, 1)
    (fault,) = proof("blind", None).faults
    assert (fault.check, fault.text[:39]) == ("words", "the policy received '', expected 'Pick ")
    (fault,) = proof("broken", "").faults
    assert fault.check == "words"
    old = proof("old", "")
    assert "words" not in old.checks
    assert "the bags of 1 of 1 rollouts do not say which instruction" in old.statements[0]


def test_a_task_that_no_template_of_the_cell_says_is_found(rollouts, tmp_path):
    def lie(topic, message):
        if topic == topics.INFO:
            message.task.instruction = "Pick up the plate"

    lying = copy_edited(list_bags(rollouts)[0], tmp_path / "lying", (topics.INFO,), lie)
    demands, shown = shown_of([lying])
    assert {fault.check for fault in tally(demands, shown).faults} == {"instruction", "words"}


def test_the_physics_that_a_reset_draws_are_demanded(tmp_path):
    physics = {"table_friction": {"values": [0.5]}, "objects": {"mass_kg": {"values": [0.1]}}}
    mix = {**MIX, "set": {**MIX["set"], "reset": {"physics": physics}}}
    record(tmp_path / "drawn", mix, 1, policy=ZeroPolicy(), max_steps=1, settle_ticks=1)
    bags = list_bags(tmp_path / "drawn")
    demands, shown = shown_of(bags, mix)
    assert tally(demands, shown).faults == ()
    heavier = {**physics, "table_friction": {"values": [0.6]}, "objects": {"mass_kg": {"values": [0.15]}}}
    demands, shown = shown_of(bags, {**mix, "set": {**mix["set"], "reset": {"physics": heavier}}})
    (fault,) = tally(demands, shown).faults
    assert fault.check == "physics"
    assert "mass_kg of the target is 0.1, the cell demands 0.15" in fault.text
    assert "the table's friction is 0.5, the cell demands 0.6" in fault.text

    def lie(topic, message):
        for entity in message.scene.entities if topic == topics.INFO else ():
            for pair in entity.modifiers:
                if entity.name == "target" and pair.key == "mass":
                    pair.value = str(1.5 * float(pair.value))

    lying = copy_edited(bags[0], tmp_path / "lying", (topics.INFO,), lie)
    demands, shown = shown_of([lying], {**mix, "set": {**mix["set"], "reset": {"physics": heavier | {
        "table_friction": {"values": [0.5]}}}}})  # fmt: skip
    (fault,) = tally(demands, shown).faults
    assert "0.1 kg of the target press on the table, its model has 0.15 kg" in fault.text


def test_a_distractor_of_another_model_or_colour_is_found(rollouts):
    def faults(**distractors):
        other = {**MIX, "set": {"distractors": {**MIX["set"]["distractors"], **distractors}}}
        demands, shown = shown_of(list_bags(rollouts)[:1], other)
        return {fault.check for fault in tally(demands, shown).faults}

    assert faults() == set()
    assert faults(models={"values": ["plate"]}, modifiers=None) == {"distractors"}
    assert faults(models={"values": ["cube"]}, modifiers={"color": {"values": ["black"]}}) == {"distractors"}


@pytest.mark.thorough
def test_a_held_out_light_is_told_from_the_seen_one_by_what_bags_say(tmp_path):
    lights = {"intensity": {"values": [1.0]}, "lamps": {"number": {"values": [1]}}}
    cells = [{"tasks": ["pick_cube"], "key": "usual"}, {"tasks": ["pick_cube"], "key": "dim", "set": {"reset": {
        "lights": lights, "background": {"backdrop": {"values": [[0.2, 0.2, 0.2]]}}}}}]  # fmt: skip
    mix = {"seed_by": "cell", "cells": cells, "set": {"scene": "kitchen"}}
    seen, unseen = "pick_cube usual", "pick_cube dim"
    record(tmp_path / "runs", mix, 2, policy=ZeroPolicy(), max_steps=1, settle_ticks=1)

    def found(bags):
        demands, shown = shown_of(bags, mix)
        own = training_tally(demands, [unseen], {seen: len(bags)}, [Trained(shown=one) for one in shown])
        return own, tally(demands, shown)

    bags = {BagReader(bag).info.task.drawn["cell"]: bag for bag in list_bags(tmp_path / "runs")}
    unseen_tally, checks = found([bags[seen]])
    assert (unseen_tally.faults, checks.faults) == ((), ())
    assert found([bags[unseen]])[1].faults == (), "it is what its cell demands"

    def lie(topic, message):
        for pair in message.task.drawn if topic == topics.INFO else ():
            if pair.key == "cell":
                pair.value = seen

    lying = copy_edited(bags[unseen], tmp_path / "lying", (topics.INFO,), lie)
    (fault,) = found([bags[seen], lying])[0].faults
    assert (fault.check, fault.bag) == ("unseen", str(lying))
    assert fault.text == f"it is of the held-out cell '{unseen}', although it claims '{seen}'"


def test_pictures_of_renderers_that_are_not_drawn_again_are_said_to_be_unproven(rollouts, tmp_path):
    def photo(topic, message):
        if topic == topics.INFO:
            message.renderer = "photo (CPU)"

    demands, shown = shown_of([copy_edited(list_bags(rollouts)[0], tmp_path / "photo", (topics.INFO,), photo)])
    found = tally(demands, shown)
    assert (found.faults, found.checks["pictures"]) == ((), (0, 1))
    assert found.statements[0].startswith("pictures were not compared (renderer photo): where 'pictures' did not pass")


@pytest.mark.slow
def test_a_held_out_episode_that_claims_a_seen_cell_is_refused_by_name(tmp_path):
    cells = [{"tasks": [task], "models": {"target": ["cube"]}, "episodes": 1} for task in ("pick_up", "rotate")]
    mix = {"seed_by": "cell", "cells": cells, "set": {"distractors": {"minimum": 0, "maximum": 0}}}
    runs = tmp_path / "generate"
    record(runs, mix, 2, purpose="demo", keep="successful", max_attempts=5)
    seen = "rotate target=cube"

    def proof(bags, counts):
        target = tmp_path / f"export-{bags.name}-{len(counts)}"
        export_bags("rlds", bags, target, ExportConfig(val_fraction=0.0, where=(f"cell={','.join(counts)}",)))
        claim = DatasetClaim(name="leave_out", path=target, bags=bags, counts=counts, planted={})
        return claim, prove_training([claim], mix, [CELL], Reading(logs=tmp_path))

    claim, clean = proof(runs, {seen: 1})
    assert not clean.refusal(0.0)
    assert clean.checks["unseen"] == (1, 1)
    name_dataset(claim.path, tmp_path)
    assert prove_trained_on(tmp_path, claim).checks == {"trained_on": (1, 1)}
    other, _ = proof(runs, {seen: 1, CELL: 1})
    found = prove_trained_on(tmp_path, other) + Tally(checks={"skill": (1000, 1000)})
    assert "it was trained with the export" in found.refusal(), "however many episodes are as they should be"

    def lie(topic, message):
        for pair in message.task.drawn if topic == topics.INFO else ():
            if pair.key == "cell":
                pair.value = seen

    leaked = next(bag for bag in list_bags(runs) if BagReader(bag).info.task.drawn["cell"] == CELL)
    lying = copy_edited(leaked, tmp_path / "lying", (topics.INFO,), lie)
    _, found = proof(tmp_path / "lying", {seen: 1})
    assert f"{lying}: unseen: it is of the held-out cell '{CELL}', although it claims '{seen}'" in found.refusal(0.0)
    assert Path(lying).exists()


@pytest.mark.slow
def test_every_condition_of_robustness_is_compared_with_the_unchanged_one(tmp_path):
    config = load_experiment("robustness", "smoke")
    design = design_of(config)
    counts, arms = {cell.key: 2 for cell in design.cells}, []
    with CoreGraph(tmp_path, policy=ZeroPolicy()) as graph:
        for name, condition in config.conditions.items():
            mix = json.loads(json.dumps(mix_of(config, counts, condition.set)))
            out = tmp_path / name
            graph._recorder._output_dir = out
            graph._actor = CoreActor(
                ZeroPolicy()
                if condition.instruction is None
                else RewordedPolicy(policy="zero", instruction=condition.instruction)
            )
            runner = EpisodeRunner(
                graph.ports,
                RunConfig(
                    task_config=yaml.safe_dump(mix), output_dir=str(out), image_width=96, image_height=96, max_steps=1,
                    settle_ticks=1, latency_ticks=condition.latency_ticks,
                ),
            )  # fmt: skip
            results = [runner.run_index(index) for index in range(2)]
            lines = [json.dumps({**to_plain(result), "key": ""}) for result in results]
            (out / "results.jsonl").write_text("\n".join(lines) + "\n")
            arms.append(
                ArmClaim(
                    condition=name, folder=out, mix=mix, words=condition.instruction,
                    latency_ticks=condition.latency_ticks, changed=changed_parts(condition.set),
                )
            )  # fmt: skip
    found, excluded = prove_evaluation(arms, Reading(logs=tmp_path))
    assert (found.faults, excluded) == ((), {})
    number = 2 * len(arms)
    assert found.checks["pairing"] == found.checks["words"] == found.checks["physics"] == (number, number)
    unseen = {"nominal", "mass", "friction", "paraphrase", "no_words", "late_2"}
    seen = 2 * len(config.conditions.keys() - unseen)
    assert found.checks["changed"] == (seen, seen)
    # a condition whose rollouts were those of another one would not pass
    claims = {arm.condition: arm for arm in arms}
    for name, other, check in (
        ("mass", "friction", "object"), ("camera", "nominal", "changed"), ("paraphrase", "nominal", "instruction"),
        ("distractors", "nominal", "distractors"), ("exposure", "light", "pairing"),
    ):  # fmt: skip
        swapped = [claims["nominal"], replace(claims[name], folder=claims[other].folder)]
        if other == "nominal":
            copied = Path(shutil.copytree(claims[other].folder, tmp_path / f"copy-{name}"))
            swapped = [claims["nominal"], replace(claims[name], folder=copied)]
        faults = prove_evaluation(swapped, Reading(logs=tmp_path))[0].faults
        assert check in {fault.check for fault in faults}, (name, faults)
