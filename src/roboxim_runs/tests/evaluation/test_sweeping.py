"""A sweep plays the same scenes with the better half again, and fresh scenes with the winner alone."""

import json
import re
from dataclasses import replace

import pytest

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, EvaluationError
from roboxim_eval.answers.halving import HalvingConfig
from roboxim_runs.evaluation import sweeping
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.run import EvaluationConfig
from roboxim_runs.policies.specs import NAME, PolicySpec

SKILL = {"good": 9, "fair": 6, "poor": 2, "bad": 0}
"""Policy to the scenes, of ten, in which it succeeds."""


@pytest.fixture
def calls(monkeypatch):
    made = []

    def evaluate(config, **_):
        names = [policy.name for policy in config.policies]
        made.append((names, config.episodes, config.purpose, config.seed, config.out.name))

        def result(name):
            outcomes = ["success" if i % 10 < SKILL[name] else "failure" for i in range(config.episodes)]
            results = [EpisodeResult(episode_id=f"eval-{i}", index=i, outcome=o) for i, o in enumerate(outcomes)]
            return PolicyResult(name=name, results=tuple(results), folder=config.out / name)

        policies = {name: result(name) for name in names}
        return EvaluationResult(policies=policies, report=None, comparison="", privileged=())

    monkeypatch.setattr(sweeping, "evaluate", evaluate)
    return made


def swept(out, names=tuple(SKILL), halving=None, **changes):
    policies = [PolicySpec(spec="zero", name=name) for name in names]
    return sweeping.sweep(policies, EvaluationConfig(policies="zero", out=out, **changes), halving or HalvingConfig())


def test_the_better_half_plays_on_in_scenes_of_no_evaluation_and_the_winner_in_fresh_ones(calls, tmp_path):
    result = swept(tmp_path, seed=3, halving=HalvingConfig(first=10, fresh=30))
    assert calls == [
        (["good", "fair", "poor", "bad"], 10, "train", 3, "choosing"),
        (["good", "fair"], 20, "train", 3, "choosing"),
        (["good"], 30, "eval", 3 + sweeping.SEED_STEP, "fresh"),
    ]
    assert result.winner.name == "good"
    assert result.fresh.successes == 27
    told = json.loads((tmp_path / "sweep.json").read_text())
    assert told["winner"] == "good"
    assert told["rounds"][0]["successes"] == {"good": 9, "fair": 6, "poor": 2, "bad": 0}


def test_a_folder_of_something_else_is_refused_and_one_of_a_stopped_sweep_continues(calls, tmp_path):
    for name in ("lerobot/meta/info.json", "other/evaluation.json", "stopped/choosing/evaluation.json"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    with pytest.raises(ConfigError, match=r"lerobot is a dataset .* choose a new or empty output folder .*-sweep$"):
        swept(tmp_path / "lerobot")
    with pytest.raises(ConfigError, match="other is the folder of 'roboxim evaluate'"):
        swept(tmp_path / "other")
    assert calls == []
    assert swept(tmp_path / "stopped").winner.name == "good"


def test_a_shard_and_equal_names_are_refused(calls, tmp_path):
    with pytest.raises(ConfigError, match="a shard has a part of the scenes"):
        swept(tmp_path, shard="0/2")
    with pytest.raises(ConfigError, match="two policies of a sweep have one name"):
        swept(tmp_path, ("good", "good"))
    assert not calls


def test_too_many_scenes_are_refused_before_the_first_one(calls, tmp_path):
    for halving in (HalvingConfig(fresh=10**9), HalvingConfig(first=6_000_000)):
        with pytest.raises(ConfigError, match="episodes must be at most 10000000, got"):
            swept(tmp_path, halving=halving)
    assert not calls
    assert [HalvingConfig(first=8).most(policies) for policies in (2, 3, 4, 5, 8, 9)] == [8, 16, 16, 32, 32, 64]


def test_checkpoints_are_named_by_their_folders_and_apart(monkeypatch):
    monkeypatch.setattr(sweeping, "read_description", lambda path: {"family": "act"})
    from pathlib import Path

    paths = [Path("runs/a/checkpoint.npz"), Path("other/a/checkpoint.npz"), Path("runs/broad.npz")]
    paths += [Path("runs/a-2/checkpoint.npz")]  # what the second "a" would be called
    paths += [Path("night/train/baseline.0/checkpoint.npz")]  # as an experiment names its trainings
    found = sweeping.checkpoint_policies(paths)
    assert {policy.spec for policy in found} == {"act"}
    names = [policy.name for policy in found]
    assert names == ["a-1", "a-3", "broad", "a-2", "baseline-0"]
    assert all(re.fullmatch(NAME, name) for name in names), "a name that no evaluation takes"
    assert found[0].options == {"checkpoint": "runs/a/checkpoint.npz"}


def test_policies_that_only_err_are_not_chosen(calls, tmp_path, monkeypatch):
    whole = sweeping.evaluate

    def failing(config, **options):
        found = whole(config, **options)
        policies = {
            name: replace(one, results=tuple(replace(r, outcome="error", reason="policy_fault") for r in one.results))
            for name, one in found.policies.items()
        }
        return replace(found, policies=policies)

    monkeypatch.setattr(sweeping, "evaluate", failing)
    with pytest.raises(EvaluationError, match="good and fair and poor and bad could not be measured"):
        swept(tmp_path)
    assert not (tmp_path / "sweep.json").exists()
