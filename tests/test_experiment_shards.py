"""An experiment whose episodes several machines share is the experiment: the same bags, datasets and card."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner
from planted_runs import recordings, repeatable_results

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError

TEXT = """
about: Does a policy combine a skill and an object that it never saw together?
factors: {task: [pick_up], target: [cube, soda_can]}
unseen: [{target: cube}]
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 3}
  baseline: {cells: all, per_cell: 3}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
trainers:
  bc:
    command: "roboxim train bc {dataset} --out {out} --seed {seed} --steps {steps}"
    policy: bc
    steps: 20
evaluate: {per_cell: 2, max_steps: 12}
replicates: {count: 1}
compare: [{first: leave_out, second: baseline, where: unseen, primary: true}]
image_size: 64x64
"""


@pytest.fixture
def experiment(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(TEXT)

    def run(out, *words):
        command(["experiment", "run", str(file), "--out", str(out), "--workers", "1", *map(str, words)])

    return run


def command(words):
    result = CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.output


def test_a_shard_is_refused_stages_that_have_no_episodes_and_trainings_that_are_not_there(experiment, tmp_path):
    with pytest.raises(ConfigError, match="a shard runs episodes.*--only generate in shards"):
        experiment(tmp_path / "1", "--shard", "1/2")
    with pytest.raises(ConfigError, match="--trained is for --shard"):
        experiment(tmp_path / "1", "--trained", tmp_path)
    with pytest.raises(ConfigError, match=r"needs train/leave_out.0, not finished in .*/1; merge the shards"):
        experiment(tmp_path / "1", "--shard", "1/2", "--only", "evaluate")


@pytest.mark.ros
@pytest.mark.slow
def test_an_experiment_in_two_shards_has_the_bags_and_the_card_of_one_run(experiment, tmp_path):
    experiment(tmp_path / "whole")
    out, shards = tmp_path / "out", [tmp_path / "1", tmp_path / "2"]
    for number, shard in enumerate(shards, start=1):
        experiment(shard, "--only", "generate", "--shard", f"{number}/2")
    command(["merge", *shards, "--out", out])
    experiment(out, "--only", "generate,export,train")
    for number, shard in enumerate(shards, start=1):
        experiment(shard, "--only", "evaluate", "--shard", f"{number}/2", "--trained", out)
    command(["merge", *shards, "--out", out])
    experiment(out)
    assert recordings(out / "generate" / "0") == recordings(tmp_path / "whole" / "generate" / "0")
    for run in ("generate/0", "evaluate/leave_out.0/leave_out", "evaluate/baseline.0/baseline"):
        assert repeatable_results(out / run) == repeatable_results(tmp_path / "whole" / run)
    cards = [json.loads((folder / "card.json").read_text()) for folder in (out, tmp_path / "whole")]
    assert cards[0]["sha256"] == cards[1]["sha256"]
