"""Fresh scenes: drawn once, committed to before the trainings, checked in the card; tuned policies are named."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from planted_cards import planted_card, shipped

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_eval.experiments import design_of, stages_of
from roboxim_eval.experiments.card import parse_card, sealed
from roboxim_eval.experiments.card_checks import check_card, concluded
from roboxim_eval.experiments.fresh import SceneSeed, committed_text, public_text
from roboxim_runs.experiments.benchmark import BenchmarkRunConfig, run_benchmark
from roboxim_runs.experiments.report import ExperimentFolder, card_page, reproduction
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.run_config import ExperimentRunConfig
from roboxim_runs.experiments.scenes import again
from roboxim_runs.experiments.scenes.again import _linked, attested_seed, take_trainings
from roboxim_runs.experiments.scenes.fresh import COMMITTED, card_part, drawn_seed, in_scenes_of
from roboxim_runs.storage.folder import locked


@pytest.fixture
def experiment(experiment):
    """Return an experiment of one replicate."""
    return experiment.replace("count: 3", "count: 1")


@pytest.fixture
def config(config, experiment):
    """Return a function that makes the configuration of a run of it."""
    return lambda **options: config(experiment, **options)


def seeds_of(card):
    return {row.seed for row in card.evaluations}


@pytest.mark.thorough
def test_public_scenes_keep_their_seeds_and_fresh_ones_have_one_seed_for_all_calls(fakes, config, tmp_path):
    public = run_experiment(config())
    assert seeds_of(public.card) == {2000}
    assert public.card.fresh is None
    assert "fresh" not in public.card.plain
    first = run_experiment(config(out=tmp_path / "a", fresh=True, only=("generate", "export", "train")))
    assert first.card is None
    fresh = run_experiment(config(out=tmp_path / "a")).card
    seed = fresh.fresh.seed
    assert seeds_of(fresh) == {seed}
    assert fresh.fresh.trained_before == 0
    assert f"--scene-seed {seed}" in reproduction(ExperimentFolder.of(tmp_path / "a"))
    given = run_experiment(config(out=tmp_path / "c", scene_seed=seed)).card
    assert seeds_of(given) == seeds_of(fresh)
    assert committed_text(given) == f"seed {seed}, which the run was given"


def test_trainings_that_the_card_has_no_longer_do_not_count_as_finished_before(tmp_path):
    seed, card = drawn_seed(tmp_path), planted_card(shipped(replicates=1), lambda *_: 0.5)
    assert {f"{one.condition}.{one.replicate}" for one in card.trainings} == {"leave_out.0", "baseline.0"}
    products = {"train/leave_out.0": {COMMITTED: seed.commitment}, "train/baseline.0": {}, "train/baseline.1": {}}
    assert card_part(tmp_path, products, card).trained_before == 1


def test_a_commitment_precedes_the_trainings_and_is_checked(fakes, config, tmp_path):
    out = tmp_path / "out"
    said = CliRunner().invoke(group, ("experiment", "attest", "--out", str(out)), catch_exceptions=False).output
    card = run_experiment(config()).card
    assert f"scenes committed to: {card.fresh.commitment}" in said
    assert "drawn before all 2 trainings; the commitment" in card_page(card)
    plain = json.loads((out / "card.json").read_text())
    assert check_card(plain) == card
    for key, value in {"seed": 54321, "nonce": "0" * 32}.items():
        with pytest.raises(ConfigError, match="is not the one of commitment"):
            check_card({**plain, "fresh": {**plain["fresh"], key: value}})
    other = SceneSeed(seed=54321, nonce="0" * 32)
    changed = {**plain["fresh"], "seed": 54321, "nonce": "0" * 32, "commitment": other.commitment}
    with pytest.raises(ConfigError, match="not all of its scenes are those of its fresh seed 54321"):
        check_card({**plain, "fresh": changed})
    (out / "scene_seed.json").unlink()
    with pytest.raises(ConfigError, match="other inputs.*seed"):
        run_experiment(config())


def test_a_seed_that_is_drawn_after_trainings_is_said_to_be(fakes, config, tmp_path):
    only = ("generate", "export", "train")
    run_experiment(config(only=only))
    with pytest.raises(ConfigError, match="2 trainings ended before a seed was committed to"):
        attested_seed(tmp_path / "out")
    card = run_experiment(config(fresh=True)).card
    assert "drawn after 2 of 2 trainings were finished" in committed_text(card)


@pytest.mark.thorough
def test_a_policy_that_is_better_in_the_public_scenes_is_named(fakes, config, tmp_path):
    public = run_experiment(config(out=tmp_path / "public")).card
    calls = len(fakes.calls)
    fakes.planted[("baseline", True)] = fakes.planted[("baseline", False)] = 0.4  # 0.8 in the public scenes
    card = run_experiment(config(fresh=True, trained=tmp_path / "public")).card
    later = fakes.calls[calls:]
    assert not any(call.startswith(("generate", "export")) for call in later), "trainings and data are those of before"
    assert [t.checkpoint_sha256 for t in card.trainings] == [t.checkpoint_sha256 for t in public.trainings]
    assert card.fresh.public_card_sha256 == public.sha256
    (warning,) = [text for text in card.warnings if "public scenes" in text]
    assert warning.startswith("baseline is better in the public scenes than in fresh ones: 80 % against 40 %")
    assert "leave_out +0 points" in public_text(card)
    assert check_card(card.plain) == card
    assert run_experiment(config(fresh=True, trained=tmp_path / "public")).card.sha256 == card.sha256
    with pytest.raises(ConfigError, match="its warnings do not follow"):
        check_card({**card.plain, "warnings": []})


def test_an_interrupted_taking_of_trainings_continues(fakes, config, tmp_path, monkeypatch):
    run_experiment(config(out=tmp_path / "public"))
    out, write = tmp_path / "out", again.write_whole
    for interrupted in ("public_card.json", "stages.jsonl"):

        def killed(path, text, interrupted=interrupted):
            if path.name == interrupted:
                raise KeyboardInterrupt
            write(path, text)

        monkeypatch.setattr(again, "write_whole", killed)
        with pytest.raises(KeyboardInterrupt):
            take_trainings(tmp_path / "public", out)
    monkeypatch.setattr(again, "write_whole", write)
    take_trainings(tmp_path / "public", out)
    names = [entry.data["stage"] for entry in ResultsLog(out / "stages.jsonl").read()]
    assert {name.partition("/")[0] for name in names} == {"generate", "export", "train", "prove"}


@pytest.mark.thorough
def test_trainings_of_another_run_are_refused(fakes, config, tmp_path):
    run_experiment(config(out=tmp_path / "fresh", fresh=True))
    with pytest.raises(ConfigError, match="has fresh scenes itself"):
        run_experiment(config(fresh=True, trained=tmp_path / "fresh"))
    public = run_experiment(config(out=tmp_path / "public")).card
    with pytest.raises(ConfigError, match="has a run of its own"):
        run_experiment(config(out=tmp_path / "fresh", fresh=True, trained=tmp_path / "public"))
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out"), pytest.raises(ConfigError, match="another command is running"):
        run_experiment(config(fresh=True, trained=tmp_path / "public"))
    assert [file.name for file in (tmp_path / "out").iterdir()] == [".lock"]
    run_experiment(config(fresh=True, trained=tmp_path / "public"))
    path = tmp_path / "out/public_card.json"
    trainings = [{**t, "checkpoint_sha256": "another"} for t in public.plain["trainings"]]
    path.write_text(json.dumps({**public.plain, "trainings": trainings}))
    with pytest.raises(ConfigError, match="sha256 do not follow"):
        run_experiment(config())
    other = sealed(parse_card({**public.plain, "trainings": trainings}))
    path.write_text(json.dumps(concluded(other).plain))
    with pytest.raises(ConfigError, match="its policy leave_out.0 is not the one of this run"):
        run_experiment(config())


def test_what_fresh_scenes_exclude_is_refused(config):
    with pytest.raises(ConfigError, match="leave it out of a shard") as refused:
        ExperimentRunConfig(experiment="skill_object", fresh=True, shard="1/2", only=("evaluate",))
    assert "--scene-seed" not in str(refused.value), "an option that was not given"
    with pytest.raises(ConfigError, match="leave out --scene-seed"):
        ExperimentRunConfig(experiment="skill_object", fresh=True, scene_seed=12345)
    with pytest.raises(ConfigError, match="--trained is for --shard and --fresh"):
        ExperimentRunConfig(experiment="skill_object", trained="runs/so")
    with pytest.raises(ConfigError, match="nonce of at least 32"):
        SceneSeed(seed=12345, nonce="short")
    one, two = SceneSeed.drawn(), SceneSeed.drawn()
    assert one.commitment != two.commitment
    assert len(one.commitment) == 64


@pytest.mark.parametrize("benchmark", [False, True])
def test_a_refused_call_with_fresh_scenes_leaves_no_seed_behind(fakes, config, tmp_path, monkeypatch, benchmark):
    experiment = config().experiment
    folder = tmp_path / "config"
    (folder / "experiments").mkdir(parents=True)
    Path(experiment).rename(folder / "experiments/mine.yaml")
    (folder / "both.yaml").write_text("about: Two of one?\nexperiments: [mine]\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(folder))

    def run(**options):
        if benchmark:
            return run_benchmark(BenchmarkRunConfig(benchmark=str(folder / "both.yaml"), out=tmp_path / "b", **options))
        return run_experiment(ExperimentRunConfig(experiment="mine", out=tmp_path / "b", **options))

    card = run().card
    with pytest.raises(ConfigError, match="other inputs.*seed"):
        run(fresh=True)
    assert not list(tmp_path.rglob("scene_seed.json"))
    assert run().card.sha256 == card.sha256


def test_curves_and_demonstrations_keep_their_scenes():

    design = shipped()
    before = {s.name: s.sha for s in stages_of(design)}
    after = {s.name: s.sha for s in stages_of(design_of(in_scenes_of(design.config, 12345)))}
    changed = {name for name in before if before[name] != after[name]}
    assert {name.partition("/")[0] for name in changed} == {"evaluate", "prove"}
    assert not any(name.startswith("prove/training") for name in changed)


@pytest.mark.thorough
def test_the_experiments_of_a_benchmark_share_the_seed(fakes, config, tmp_path, monkeypatch):
    config()  # writes the file
    folder = tmp_path / "config"
    (folder / "experiments").mkdir(parents=True)
    (tmp_path / "mine.yaml").rename(folder / "experiments/mine.yaml")
    (folder / "both.yaml").write_text("about: Two of one?\nexperiments: [mine]\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(folder))

    def run(**options):
        return run_benchmark(BenchmarkRunConfig(benchmark=str(folder / "both.yaml"), **options))

    run(out=tmp_path / "public")
    fresh = run(out=tmp_path / "fresh", fresh=True, trained=tmp_path / "public").card
    card = fresh.experiments["mine"]
    assert seeds_of(card) == {card.fresh.seed} != {2000}
    assert card.fresh.public
    path = tmp_path / "fresh/mine/card.json"
    attested = attested_seed(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="seed"):
        run(out=tmp_path / "elsewhere", cards=(path,))
    assert attested.seed != card.fresh.seed


def test_trainings_that_took_place_elsewhere_are_not_said_to_follow_the_draw(fakes, config):
    card = run_experiment(config(fresh=True)).card
    elsewhere = replace(card, trainings=tuple(replace(one, checkpoint_sha256="") for one in card.trainings))
    assert "drawn before all 2 trainings" in committed_text(card)
    assert "drawn before or after the trainings, which is unknown" in committed_text(elsewhere)


def test_an_interrupted_linking_continues(tmp_path):
    source, target = tmp_path / "a", tmp_path / "b"
    source.write_text("weights")
    _linked(str(source), str(target))
    _linked(str(source), str(target))
    assert (target.read_text(), target.samefile(source)) == ("weights", True)
