"""Experiments with policies of known ability, the real expert and simulator: the card must state what was planted."""

import json
import shutil

import pytest
import yaml

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.config import load_yaml, named_config
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.merging import merged
from roboxim_runs.experiments.delivery.substitution import satisfied
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.run_config import ExperimentRunConfig
from roboxim_runs.policies.planted import PlantedPolicy
from roboxim_runs.policies.specs import PolicySpec

pytestmark = pytest.mark.slow

TEXT = """
about: Does a policy combine a skill and an object that it never saw together?
factors:
  task: {pick_up: {}, rotate: {arguments: {direction: {values: [clockwise]}}}}
  target: [cube, soda_can]
dimensions: {task: skill, target: object}
unseen: [{task: pick_up, target: cube}, {task: rotate, target: soda_can}]
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 2}
  baseline: {cells: all, per_cell: 1}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
  blind: {checkpoint_of: leave_out, instruction: ""}
trainers: {external: {}}
evaluate: {per_cell: 4, cells: {leave_out: unseen, baseline: unseen, blind: unseen}}
replicates: {count: 3}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
  - {first: leave_out, second: blind, where: unseen}
image_size: 64x64
"""
PICK, TURN = "Pick up the soda can", "Rotate the cube clockwise by 90 degrees"
"""Instructions of the seen cells."""
ALL = [PICK, TURN, "Pick up the cube", "Rotate the soda can clockwise by 90 degrees"]
WORDED = TEXT.replace("per_cell: 4", "per_cell: 8").replace(
    "distractors: {minimum: 0, maximum: 0}",
    "distractors: {minimum: 1, maximum: 1, models: {values: [cube, soda_can]}}, "
    "reset: {distractors: {near: null, area: {lower: [0.32, -0.25], upper: [0.72, 0.25]}}}",
)
"""The same among both objects."""


@pytest.mark.parametrize(
    ("options", "outcome", "did"),
    [
        ({}, "success", ()),
        ({"rate": 0.0}, "failure", ()),
        ({"rate": 0.0, "instead": {"pick_up target=cube": TURN}}, "failure", ("rotate target=cube",)),
        ({"words": False, "known": [TURN]}, "failure", ("rotate target=cube",)),
    ],
)
def test_the_policy_does_what_was_planted_and_its_bag_shows_it(tmp_path, options, outcome, did):
    cells = [{"tasks": ["pick_up"], "models": {"target": ["cube"]}}]
    mix = {"seed_by": "cell", "cells": cells, "set": {"distractors": {"minimum": 0, "maximum": 0}}}
    try:
        graph = CoreGraph(tmp_path, policy=PlantedPolicy(**options))
    except SimError as error:
        pytest.skip(str(error))
    run = RunConfig(task_config=yaml.safe_dump(mix), output_dir=str(tmp_path), image_width=64, image_height=64)
    with graph:
        result = EpisodeRunner(graph.ports, run).run_index(0)
    assert result.outcome == outcome
    training = {TURN: "rotate target=cube", "Pick up the cube": "pick_up target=cube"}
    assert satisfied(tmp_path / result.bag, training, ModelLibrary(), {}) == did


def planted(**options):
    return PolicySpec(spec="roboxim_runs.policies.planted:PlantedPolicy", options=options)


def with_data(folder, text):
    """Return the folder of an experiment with its training data and no evaluation."""
    (folder / "mine.yaml").write_text(text)
    half = run_experiment(ExperimentRunConfig(experiment=str(folder / "mine.yaml"), out=folder / "data"))
    assert len(half.waiting) == 9
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Scenes with the named object alone: they tell which one is meant."""
    return with_data(tmp_path_factory.mktemp("planted"), TEXT)


@pytest.fixture(scope="module")
def worded(tmp_path_factory):
    """Scenes with both objects, where each of the four instructions can be carried out."""
    return with_data(tmp_path_factory.mktemp("worded"), WORDED)


def result_of(data, name, leave_out, baseline):
    shutil.copytree(data / "data", data / name)
    policies = {"leave_out": leave_out, "baseline": baseline}
    config = ExperimentRunConfig(experiment=str(data / "mine.yaml"), out=data / name, policies=policies)
    return run_experiment(config).card


def test_a_memoriser_is_named(data):
    """It does the seen skill with the held-out object."""
    instead = {"pick_up target=cube": TURN, "rotate target=soda_can": PICK}
    memoriser = planted(rate=0.0, instead=instead, known=[PICK, TURN])
    card = result_of(data, "memoriser", memoriser, planted())
    assert card.verdicts[0].kind == "lower"
    assert card.scores["relative"][0] < 0.1
    assert card.scores["substitution"]["rate"][0] > 0.9
    assert "->" in card.scores["substitution"]["worst"]
    pairs = {(again.cell, again.satisfied) for again in card.judged_again}
    assert {("pick_up target=cube", ("rotate target=cube",)),
            ("rotate target=soda_can", ("pick_up target=soda_can",))} <= pairs  # fmt: skip


def test_equal_policies_are_not_called_lower_and_a_weaker_one_is(data):
    card = result_of(data, "equal", planted(rate=0.7, salt=1), planted(rate=0.7, salt=2))
    assert card.verdicts[0].kind in ("as_good", "cannot_tell")
    weaker = result_of(data, "weaker", planted(rate=0.1, salt=1), planted(rate=0.9, salt=2))
    assert weaker.verdicts[0].kind == "lower"
    assert weaker.scores["absolute"][0] == pytest.approx(0.1, abs=0.15)
    assert weaker.scores["baseline"][0] == pytest.approx(0.9, abs=0.15)


def test_a_policy_that_ignores_words_gets_the_warning_where_scenes_suffice(data):
    card = result_of(data, "looker", planted(words=False, known=ALL), planted(words=False, known=ALL))
    assert card.scores["absolute"][0] == pytest.approx(1 / 2, abs=0.2), "one of the two tasks with the only object"
    assert card.scores["words"][0] == pytest.approx(0.0, abs=0.3)
    assert any("needs no words here" in text for text in card.warnings)


def test_a_policy_that_ignores_words_guesses_where_only_words_tell(worded):
    guesser = planted(words=False, known=ALL)
    card = result_of(worded, "guesser", guesser, guesser)
    assert card.scores["absolute"][0] == pytest.approx(1 / 4, abs=0.15), "one of four instructions"
    assert card.scores["words"][0] == pytest.approx(0.0, abs=0.2)
    substitution = card.scores["substitution"]["rate"][0]
    assert substitution == pytest.approx(2 / 3, abs=0.2), "two of the three other instructions are of the training"
    assert not any("needs no words here" in text for text in card.warnings)
    listener = result_of(worded, "listener", planted(known=ALL), planted(known=ALL))
    assert listener.scores["absolute"][0] > 0.9
    assert listener.scores["words"][0] == pytest.approx(3 / 4, abs=0.2)
    assert not any("not shown to use its words" in text for text in listener.warnings)


def test_a_policy_that_ignores_words_guesses_in_the_shipped_scenes_where_only_words_tell(tmp_path):
    small = load_yaml(named_config("experiments", "skill_object_worded"))
    changes = {"evaluate": {"per_cell": 8, "cells": {"leave_out": "unseen", "baseline": "unseen", "blind": "unseen"}},
               "replicates": {"count": 3}, "compare": small["compare"][:2]}  # fmt: skip
    text = yaml.safe_dump(json.loads(json.dumps(merged(small, {"scales": {"smoke": changes}}))), sort_keys=False)
    (tmp_path / "mine.yaml").write_text(text)
    named = ("cube", "apple", "soda can", "onion", "cucumber", "knife")
    known = [text.format(name) for text in ("Pick up the {}", "Place the {} on the plate") for name in named]
    guesser = planted(words=False, known=known)
    card = run_experiment(ExperimentRunConfig(
        experiment=str(tmp_path / "mine.yaml"), scale="smoke", out=tmp_path / "out", trainer="external",
        policies={"leave_out": guesser, "baseline": guesser},
    )).card  # fmt: skip
    assert card.scores["absolute"][0] < 0.35, "one of the six: two skills, three objects"
    assert card.scores["words"][0] == pytest.approx(0.0, abs=0.2)
    assert card.verdicts[1].second == "blind"
    assert card.verdicts[1].kind in ("as_good", "cannot_tell"), "not better than without words"
    assert not any("needs no words here" in text for text in card.warnings)
