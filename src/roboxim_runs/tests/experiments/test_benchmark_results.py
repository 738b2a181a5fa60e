"""A benchmark of planted experiments: its card, its report, and cards of experiments that ran elsewhere."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from planted_runs import PLANTED_RATES, planted_folder

from roboxim_cli import options
from roboxim_cli.commands.stages.benchmark import command as benchmark_command
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import sealed
from roboxim_runs.experiments import benchmark
from roboxim_runs.experiments.benchmark import (
    BenchmarkRunConfig,
    run_benchmark,
    stored_benchmark_card,
    write_benchmark_report,
)
from roboxim_runs.experiments.card import collect_card
from roboxim_runs.experiments.pack import pack
from roboxim_runs.experiments.report import (
    ExperimentFolder,
    folder_card,
    reproduction,
    write_card,
)
from roboxim_runs.experiments.run import ExperimentResult
from roboxim_runs.policies.specs import PolicySpec


@pytest.fixture
def planted_benchmark(tmp_path, monkeypatch):
    """Replace the runs of experiments by planted ones; return the calls."""
    calls = []

    def run_experiment(config, **_):
        calls.append(config)
        folder = planted_folder(Path(config.out), PLANTED_RATES) if not Path(config.out).exists() else None
        if folder is not None:
            write_card(collect_card("mine", "full", folder.design, folder.path), folder.path)
        card = folder_card(ExperimentFolder.of(Path(config.out)))
        return ExperimentResult(out=Path(config.out), finished=(), missing=(), card=card)

    monkeypatch.setattr(benchmark, "run_experiment", run_experiment)
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {})
    file = tmp_path / "mine.yaml"
    file.write_text(
        "about: All of it?\nexperiments: [one, two]\nscales: {night: {replicates: {count: 3}}}\n"
        "reference: {name: Another model, dimensions: {object: {absolute: 0.21, relative: 0.76}}}\n"
    )
    return file, calls


@pytest.mark.thorough
def test_a_benchmark_has_one_card_for_all_experiments(planted_benchmark, tmp_path):
    file, calls = planted_benchmark
    config = BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "out", trainings=2)
    result = run_benchmark(config)
    assert [(call.experiment, call.trainings) for call in calls] == [("one", 2), ("two", 2)]
    assert calls[0].changes == {"scales": {"night": {"replicates": {"count": 3}}}}
    assert result.card.dimensions["object"].absolute[0] == pytest.approx(0.4)
    assert result.card.dimensions["object"].relative[0] == pytest.approx(0.4 / 0.9, abs=1e-5)
    one = replace(ExperimentFolder.of(tmp_path / "out/one"), benchmark=calls[0].benchmark)
    assert reproduction(one).startswith(f"roboxim benchmark {file} --experiment "), "the scale is the benchmark's"
    assert stored_benchmark_card(tmp_path / "out/card.json") == result.card
    (tmp_path / "out/one/report.html").write_text("")
    write_benchmark_report(tmp_path / "out")
    page = (tmp_path / "out/report.html").read_text()
    assert f"roboxim benchmark {file} --scale night --out out" in page
    assert 'href="one/report.html#episodes?' in page
    assert result.card.sentences[0] in page
    assert "Another model" in page
    assert "76 %" in page
    assert run_benchmark(config).card.sha256 == result.card.sha256
    with pytest.raises(ConfigError, match="scale 'night', not 'full'"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), out=tmp_path / "out"))
    assert pack(tmp_path / "out", tmp_path / "all.tar.gz").files > 20


@pytest.mark.thorough
def test_a_benchmark_runs_its_episodes_where_it_is_told(planted_benchmark, tmp_path, monkeypatch):
    file, _ = planted_benchmark
    planted, cluster, nodes, used = benchmark.run_experiment, nullcontext(), object(), []

    def run_experiment(config, *, executor, training_executor, **more):
        used.append((executor, training_executor))
        return planted(config, **more)

    monkeypatch.setattr(benchmark, "run_experiment", run_experiment)
    asked = {("ray", "auto", "", 2): cluster, ("ray", "auto", "CPU=8,GPU=1", 3): nodes}
    monkeypatch.setattr(options, "make_executor", lambda *given, **_: asked[given])
    words = [str(file), "--scale", "night", "--out", str(tmp_path / "out"), "--executor", "ray", "--address", "auto"]
    words += ["--workers", "2", "--trainings", "3", "--training-resources", "CPU=8,GPU=1"]
    CliRunner().invoke(benchmark_command, words, catch_exceptions=False)
    assert used == [(cluster, nodes)] * 2


@pytest.mark.thorough
def test_experiments_that_ran_elsewhere_enter_a_benchmark_by_their_cards(planted_benchmark, tmp_path, monkeypatch):
    file, calls = planted_benchmark
    whole = run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "whole"))
    for name, card in whole.card.experiments.items():  # the planted ones have a name of their own
        (tmp_path / f"{name}.json").write_text(
            json.dumps(sealed(replace(card, experiment=replace(card.experiment, name=name))).plain)
        )
    planted = whole.card.experiments["one"].experiment.config
    planted = replace(planted, deviations=("Told in other words than in the cards.",))
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": planted, "two": planted})
    calls.clear()
    here = BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "out", experiments=("two",))
    assert run_benchmark(here).missing == ("one",)
    result = run_benchmark(replace(here, cards=(tmp_path / "one.json",)))
    assert [call.experiment for call in calls] == ["two", "two"]
    assert result.card.dimensions == whole.card.dimensions
    assert run_benchmark(here).card.sha256 == result.card.sha256, "the folder keeps the card"
    assert "--card out/one/card.json" in (tmp_path / "out/report.html").read_text()


@pytest.mark.thorough
def test_cards_that_do_not_belong_to_a_benchmark_are_refused(planted_benchmark, tmp_path, monkeypatch):
    file, _ = planted_benchmark
    whole = run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "whole")).card
    one = whole.experiments["one"]
    card = tmp_path / "card.json"

    def refused(match, trainer="", **change):
        card.write_text(json.dumps(sealed(replace(one, experiment=replace(one.experiment, **change))).plain))
        with pytest.raises(ConfigError, match=match):
            run_benchmark(BenchmarkRunConfig(
                benchmark=str(file), scale="night", out=tmp_path / "out", cards=(card,), trainer=trainer
            ))  # fmt: skip
        assert not (tmp_path / "out/one").exists()

    config = one.experiment.config
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": config})
    refused("is of experiment 'mine'; expected one of: one, two", name="mine")
    refused("has the first trainer of its file, and --trainer is 'mine'", name="one", trainer="mine")
    other = replace(config, image_size="32x32")
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": other})
    refused(r"'one' differs from the one of this benchmark at scale night \(image_size: ", name="one")
    card.write_text(json.dumps({**one.plain, "sha256": "0"}))
    with pytest.raises(ConfigError, match=r"card.json"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "out", cards=(card,)))
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": config})
    card.write_text(json.dumps(sealed(replace(one, experiment=replace(one.experiment, name="one"))).plain))
    with pytest.raises(ConfigError, match="has a run of 'one' already"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "whole", cards=(card,)))


@pytest.mark.thorough
def test_policies_of_a_benchmark_are_named_with_their_experiment(planted_benchmark, tmp_path):

    file, calls = planted_benchmark
    policies = {"one.leave_out.0": PolicySpec(spec="random"), "two.leave_out": PolicySpec(spec="zero")}
    run_benchmark(BenchmarkRunConfig(benchmark=str(file), out=tmp_path / "out", policies=policies))
    assert list(calls[0].policies) == ["leave_out.0"]
    assert calls[1].policies["leave_out"].spec == "zero"
    wrong = {"three.leave_out": PolicySpec(spec="zero")}
    with pytest.raises(ConfigError, match="expected EXPERIMENT.CONDITION"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), out=tmp_path / "wrong", policies=wrong))


@pytest.mark.parametrize("wrong", [{"scale": "tiny"}, {"trainer": "nobody"}])
def test_a_refused_benchmark_leaves_nothing_that_the_right_command_stumbles_over(tmp_path, wrong):
    with pytest.raises(ConfigError, match="tiny|nobody"):
        run_benchmark(BenchmarkRunConfig(benchmark="transfer", out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()
