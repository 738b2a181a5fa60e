"""A run divided among machines is the run: the same states, results and bags, byte by byte."""

from __future__ import annotations

import pytest
from planted_runs import recordings, repeatable_results

from roboxim_recorder.export import export_bags
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_runs.datasets.rewriting import merge_datasets
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.storage.merging import merge_shards

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SMALL = {"size": 32, "renderer": "tiny", "workers": 1}


def test_demonstrations_in_three_shards_are_those_of_one_run(tmp_path):
    generate(GenerationConfig(out=tmp_path / "whole", episodes=5, **SMALL))
    for number in (1, 2, 3):
        generate(GenerationConfig(out=tmp_path / str(number), episodes=5, shard=f"{number}/3", **SMALL))
    merge_shards(tmp_path / "out", [tmp_path / str(number) for number in (1, 2, 3)])
    assert len(recordings(tmp_path / "whole")) >= 5
    assert recordings(tmp_path / "out") == recordings(tmp_path / "whole")
    assert repeatable_results(tmp_path / "out") == repeatable_results(tmp_path / "whole")
    assert generate(GenerationConfig(out=tmp_path / "out", episodes=5, **SMALL)).summary.endswith("nothing was run")

    whole = export_bags("rlds", tmp_path / "out", tmp_path / "rlds").path
    parts = [
        export_bags("rlds", tmp_path / "out", tmp_path / f"rlds-{number}", ExportConfig(shard=f"{number}/2")).path
        for number in (1, 2)
    ]
    merged = merge_datasets(parts, tmp_path / "rlds-merged").path
    names = {path.name for path in whole.glob("*.tfrecord*")}
    assert names
    assert {path.name for path in merged.glob("*.tfrecord*")} == names
    assert all((whole / name).read_bytes() == (merged / name).read_bytes() for name in names)


def test_rollouts_in_two_shards_are_those_of_one_evaluation_with_its_report(tmp_path):
    def run(out, shard=""):
        config = EvaluationConfig(policies="random", out=out, episodes=3, max_steps=8, shard=shard, **SMALL)
        return evaluate(config)

    run(tmp_path / "whole")
    for number in (1, 2):
        run(tmp_path / str(number), shard=f"{number}/2")
    merge_shards(tmp_path / "out", [tmp_path / "1", tmp_path / "2"])
    assert recordings(tmp_path / "out" / "random") == recordings(tmp_path / "whole" / "random")
    assert repeatable_results(tmp_path / "out" / "random") == repeatable_results(tmp_path / "whole" / "random")
    assert "0 of 3" in (tmp_path / "out" / "report.html").read_text()
