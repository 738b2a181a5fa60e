"""An experiment's folder after its run: report, comparison, pack, benchmark. Results are planted, not simulated."""

import itertools
import json
import shlex
import tarfile
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from roboxim_bringup import options
from roboxim_bringup.cli import group
from roboxim_bringup.commands.benchmark import command as benchmark_command
from roboxim_bringup.experiment_card import collect_card, evaluation_folder
from roboxim_bringup.experiment_files import checked_design
from roboxim_bringup.runs import benchmark, evaluation, experiment_pack, sequential
from roboxim_bringup.runs.benchmark import (
    BenchmarkRunConfig,
    run_benchmark,
    stored_benchmark_card,
    write_benchmark_report,
)
from roboxim_bringup.runs.evaluation import EvaluationConfig
from roboxim_bringup.runs.evaluation_report import EvaluationRecord
from roboxim_bringup.runs.evaluation_results import EvaluationResult, PolicyResult
from roboxim_bringup.runs.experiment import ExperimentResult
from roboxim_bringup.runs.experiment_models import compared
from roboxim_bringup.runs.experiment_pack import pack, packed_files, unpack
from roboxim_bringup.runs.experiment_policies import named_policies
from roboxim_bringup.runs.experiment_report import (
    ExperimentFolder,
    checkpoint_episodes,
    experiment_episodes,
    folder_card,
    reproduction,
    write_card,
    write_evaluation_pages,
    write_experiment_report,
)
from roboxim_bringup.runs.folder import RunFolder
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_bringup.runs.results_log import ResultsLog
from roboxim_core.config import to_json, to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import stages_of
from roboxim_eval.experiments.card import sealed
from roboxim_eval.testing import SKILL_AND_OBJECT, experiment_of
from roboxim_tasks.config import task_mix

TEXT = SKILL_AND_OBJECT + """
dimensions: {task: skill, target: object}
trainers:
  mine: {command: "train {dataset} {out} {seed}", policy: bc, steps: 7}
evaluate: {per_cell: 20, cells: {blind: unseen}}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
"""  # fmt: skip
RATES = {"leave_out": 0.4, "baseline": 0.9, "blind": 0.0}


def planted_folder(out, rates, text=TEXT):
    """Write an experiment's folder with results: scene k of a cell is solved if its number is below the rate."""
    config = experiment_of(text)
    design = checked_design("mine", config)
    out.mkdir(parents=True)
    state = {"experiment": "mine.yaml", "scale": "full", "config": to_plain(config), "stages": {}}
    (out / "experiment.json").write_text(json.dumps(state))
    log = ResultsLog(out / "stages.jsonl")
    for stage in stages_of(design):
        log.append("key", {"stage": stage.name, "wall_s": 1.0, "sha256": f"hash of {stage.name}"})
        if stage.kind == "train":
            (out / stage.name).mkdir(parents=True)
            (out / stage.name / "checkpoint.npz").write_text(stage.name)
        if stage.kind != "evaluate":
            continue
        condition = stage.name.removeprefix("evaluate/").partition(".")[0]
        mix = task_mix(stage.inputs["mix"])
        folder = evaluation_folder(out, stage.name)
        folder.mkdir(parents=True)
        with RunFolder(folder).opened({"command": "evaluate"}) as run:
            for index in range(stage.inputs["episodes"]):
                number = int(mix.drawn(index)["cell_number"])
                won = number < 20 * rates[condition]
                run.append(EpisodeResult(
                    episode_id=f"eval-{index}", index=index, outcome="success" if won else "failure",
                    reason="" if won else "not_lifted", instruction="Pick it up",
                ))  # fmt: skip
    return ExperimentFolder.of(out)


def test_a_folder_receives_a_card_and_a_page(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    card = folder_card(folder)
    assert card.verdicts[0].sentence.startswith("leave_out in unseen cells is lower than baseline there by 50 points")
    assert card.scores["relative"][0] == pytest.approx(0.4 / 0.9, abs=1e-5)
    assert card.datasets["leave_out.0"].sha256 == "hash of export/leave_out.0"
    assert card.trainings[0].checkpoint_sha256 == "hash of train/leave_out.0"
    assert card.trainings[0].attest.recipe == {"steps": 7, "command": "train {dataset} {out} {seed}"}
    assert folder_card(folder) == card, "a stored card is checked, not written again"
    page = write_experiment_report(folder, card).read_text()
    assert card.verdicts[0].sentence in page
    assert "roboxim experiment run mine.yaml --scale full --out run" in page
    assert "No scene has distractors, so that the scene alone tells which object is meant." in page
    assert "Scenes of place_on alone have the support plate, so that the scene alone tells this task." in page
    episodes = experiment_episodes(folder)
    assert len(episodes) == 3 * (80 + 80 + 40)
    assert {e.cell for e in episodes if e.arm == "blind"} == {"pick_up target=cube", "place_on target=soda_can"}


def test_the_printed_command_names_the_file_the_renderer_and_the_policies(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    path = folder.path / "experiment.json"
    trained = {name: {"spec": "bc", "options": {"checkpoint": f"/old/train/{name}"}}
               for name in (f"{c}.{r}" for c in ("leave_out", "baseline") for r in range(3))}  # fmt: skip

    def printed(policies):
        def blind(replicate):
            words = {"policy": policies[f"leave_out.{replicate}"]["spec"], "instruction": ""}
            return {"spec": "reworded", "options": policies[f"leave_out.{replicate}"]["options"] | words}

        ran = {**{f"blind.{r}": blind(r) for r in range(3)}, **policies}
        stages = {f"evaluate/{name}": {"policy": {"name": "", **policy}} for name, policy in ran.items()}
        state = {**json.loads(path.read_text()), "experiment": "my files/mine.yaml", "renderer": "tiny"}
        path.write_text(json.dumps({**state, "stages": stages}))
        words = shlex.split(reproduction(ExperimentFolder.of(folder.path)))
        assert words[:4] == ["roboxim", "experiment", "run", "my files/mine.yaml"]
        assert words[words.index("--renderer") + 1] == "tiny"
        given = [
            [after for word, after in itertools.pairwise(words) if word == key] for key in ("--policy", "--option")
        ]
        return named_policies(*given)

    assert printed(trained) == {}, "policies that the experiment trains, and those that follow from them, are not named"
    mine = {"spec": "client.py:Mine", "options": {"port": 6000, "label": "6000", "note": "a: [b", "at": "runs/x"}}
    zero = {f"baseline.{r}": {"spec": "zero", "options": {}} for r in range(3)}
    named = {"leave_out.1": PolicySpec(**mine), "baseline": PolicySpec(spec="zero")}
    assert printed({**trained, **zero, "leave_out.1": mine}) == named
    blind = {"spec": "client.py:Other", "options": {}}
    assert printed({**trained, "blind.2": blind}) == {"blind.2": PolicySpec(**blind)}


def test_points_of_a_learning_curve_lead_to_episodes_of_their_own(tmp_path):
    text = TEXT.replace("steps: 7}", 'steps: 8, until: "--until {until}"}').replace("count: 3", "count: 1")
    folder = planted_folder(tmp_path / "run", RATES, text + "curve: {every: 4, per_checkpoint: 4}\n")
    page = write_experiment_report(folder, folder_card(folder)).read_text()
    assert '<a href="#episodes?arm=leave_out%404"><circle' in page
    arms = Counter(episode.arm for episode in checkpoint_episodes(folder))
    assert arms["leave_out@4"] == arms["baseline@4"] == 4
    assert {e.arm for e in experiment_episodes(folder)} == {"leave_out", "baseline", "blind"}


def test_the_page_of_a_card_alone_warns_of_what_its_scenes_tell(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    folder_card(folder)
    html = tmp_path / "page.html"
    words = ("experiment", "report", "--from", str(folder.path / "card.json"), "--html", str(html))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    for text in (said, html.read_text()):
        assert "No scene has distractors, so that the scene alone tells which object is meant." in text


def test_results_that_changed_after_the_card_are_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    folder_card(folder)
    results = evaluation_folder(folder.path, "evaluate/baseline.1") / "results.jsonl"
    results.write_text(results.read_text().replace('"outcome":"failure"', '"outcome":"success"', 1))
    with pytest.raises(ConfigError, match=r"results of evaluate/baseline.1 have changed since card.json"):
        folder_card(ExperimentFolder.of(folder.path))
    with pytest.raises(ConfigError, match="not the folder of an experiment"):
        ExperimentFolder.of(tmp_path)


def test_attestations_are_stated_and_wrong_ones_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    attest = tmp_path / "run/attest.yaml"
    attest.write_text(
        "recipe: {model: octo}\npretraining: octo-small-1.5\nexposure: unknown\n"
        "trainings: {baseline: {recipe: {steps: 3}}, leave_out.1: {exposure: 'yes'}}\n"
    )
    card = folder_card(folder)
    assert card.trainings[0].attest.recipe == {"steps": 7, "model": "octo"}
    assert any(
        "Recipes of leave_out and baseline differ in more than the dataset: steps 7 and 3" in w for w in card.warnings
    )
    assert any("pre-training of leave_out contained held-out combinations" in w for w in card.warnings)
    assert "octo-small-1.5" in write_experiment_report(folder, card).read_text()
    for text, said in (
        ("exposure: perhaps", "unknown 'perhaps'"),
        ("trainings: {leave_out.0: {dataset_sha256: abc}}", "used a dataset with hash abc, not the one"),
    ):
        attest.write_text(text)
        (tmp_path / "run/card.json").unlink(missing_ok=True)
        with pytest.raises(ConfigError, match=said):
            folder_card(ExperimentFolder.of(tmp_path / "run"))


def test_stored_proofs_and_substitutions_are_part_of_the_card(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    (folder.path / "proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    judged = [{"cell": "pick_up target=cube", "satisfied": ["place_on target=cube"]}] * 9
    (folder.path / "judged_again.json").write_text(json.dumps([*judged, {"cell": "place_on target=soda_can"}]))
    card = folder_card(folder)
    assert card.proofs == {"camera pose": (599, 600)}
    assert card.scores["substitution"]["rate"][0] == pytest.approx(0.9)
    page = write_experiment_report(folder, card).read_text()
    assert "Delivery is not proved for 1 of 600 episodes: camera pose." in page
    assert "<td>pick_up target=cube</td><td>place_on target=cube</td>" in page


def test_a_pack_survives_the_loss_of_its_machine(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    card = folder_card(folder)
    bag = evaluation_folder(folder.path, "evaluate/baseline.1") / "episodes/eval-0/eval-0_0.mcap"
    dataset = folder.path / "export/leave_out.0/train.tfrecord"
    for heavy in (bag, dataset, folder.path / "generate/0/episodes/a/a_0.mcap"):
        heavy.parent.mkdir(parents=True)
        heavy.write_bytes(b"0" * 1000)
    names = {file.relative_to(folder.path).as_posix() for file in packed_files(folder.path)}
    assert {"card.json", "experiment.json", "stages.jsonl", "train/baseline.2/checkpoint.npz"} <= names
    assert "evaluate/blind.0/blind/results.jsonl" in names
    assert not any(name.endswith((".mcap", ".tfrecord", ".lock")) for name in names)
    packed = pack(folder.path, tmp_path / "run.tar.gz")
    assert packed.files == len(names)
    found = unpack(packed.path, tmp_path / "again")
    assert found.files == packed.files
    again = ExperimentFolder.of(tmp_path / "again")
    assert folder_card(again) == card
    assert card.verdicts[0].sentence in write_experiment_report(again, card).read_text()
    with pytest.raises(ConfigError, match="is not empty"):
        unpack(packed.path, tmp_path / "again")
    with pytest.raises(ConfigError, match="exists; remove it"):
        pack(folder.path, packed.path)


def test_packs_that_are_too_large_or_damaged_are_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES)
    with pytest.raises(ConfigError, match=r"more than 0 MB; its largest files: .*results.jsonl"):
        pack(folder.path, tmp_path / "small.tar.gz", most_bytes=1000)
    assert list(tmp_path.glob("*small*")) == [], "nothing is left"
    packed = pack(folder.path, tmp_path / "run.tar.gz").path
    packed.write_bytes(packed.read_bytes()[:-200])
    with pytest.raises(ConfigError, match="is no whole pack"):
        unpack(packed, tmp_path / "torn")
    with pytest.raises(ConfigError, match="not the folder of an experiment or a benchmark"):
        pack(tmp_path, tmp_path / "none.tar.gz")
    evil = tmp_path / "evil.tar.gz"
    (tmp_path / "pack.json").write_text(json.dumps({"files": {"../outside": "0"}}))
    with tarfile.open(evil, "w:gz") as archive:
        archive.add(tmp_path / "pack.json", arcname=experiment_pack.MANIFEST)
    with pytest.raises(ConfigError, match="'../outside' leaves its folder"):
        unpack(evil, tmp_path / "evil")


def test_compare_says_what_the_cards_warn_of(tmp_path):
    one = TEXT.replace("count: 3", "count: 1")
    for name in ("one", "two"):
        planted_folder(tmp_path / name, RATES, one)
    (tmp_path / "one/proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    words = ("experiment", "compare", str(tmp_path / "one"), str(tmp_path / "two"))
    (tmp_path / "one/report.html").write_text("")
    words += ("--html", str(tmp_path / "models.html"))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "The card of one warns: Delivery is not proved for 1 of 600 episodes: camera pose." in said
    page = (tmp_path / "models.html").read_text()
    assert 'href="one/report.html#episodes?' in page
    assert "two/report.html" not in page, "it is not there"


def test_models_are_compared_on_the_scenes_that_they_shared(tmp_path):
    one = TEXT.replace("count: 3", "count: 1")
    planted_folder(tmp_path / "weak", {**RATES, "leave_out": 0.2}, one)
    planted_folder(tmp_path / "strong", {**RATES, "leave_out": 0.9}, one)
    models, cards = compared([tmp_path / "weak", tmp_path / "strong"])
    assert set(cards) == {"weak", "strong"}
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met"
    assert models.models["strong"].letters != models.models["weak"].letters
    card = tmp_path / "card.json"
    card.write_text((tmp_path / "weak/card.json").read_text())
    models, _ = compared([card, tmp_path / "strong"])
    assert models.pairs[0].test == "these checkpoints, on different scenes", "a card alone has no scenes"
    with pytest.raises(ConfigError, match="two of the runs are named 'weak'"):
        compared([tmp_path / "weak", tmp_path / "weak"])


# ------------------------------------------------------------------ benchmark


@pytest.fixture
def planted_benchmark(tmp_path, monkeypatch):
    """Replace the runs of experiments by planted ones; return the calls."""
    calls = []

    def run_experiment(config, **_):
        calls.append(config)
        folder = planted_folder(Path(config.out), RATES) if not Path(config.out).exists() else None
        if folder is not None:
            write_card(collect_card("mine", "full", folder.design, folder.path), folder.path)
        card = folder_card(ExperimentFolder.of(Path(config.out)))
        return ExperimentResult(out=Path(config.out), finished=(), missing=(), card=card)

    monkeypatch.setattr(benchmark, "run_experiment", run_experiment)
    file = tmp_path / "mine.yaml"
    file.write_text(
        "about: All of it?\nexperiments: [one, two]\nscales: {night: {replicates: {count: 3}}}\n"
        "reference: {name: Another model, dimensions: {object: {absolute: 0.21, relative: 0.76}}}\n"
    )
    return file, calls


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


def test_a_benchmark_runs_its_episodes_where_it_is_told(planted_benchmark, tmp_path, monkeypatch):
    file, _ = planted_benchmark
    planted, cluster, used = benchmark.run_experiment, nullcontext(), []

    def run_experiment(config, *, executor, **more):
        used.append(executor)
        return planted(config, **more)

    monkeypatch.setattr(benchmark, "run_experiment", run_experiment)
    monkeypatch.setattr(options, "make_executor", lambda *given: cluster if given[:2] == ("ray", "auto") else None)
    words = [str(file), "--scale", "night", "--out", str(tmp_path / "out"), "--executor", "ray", "--address", "auto"]
    CliRunner().invoke(benchmark_command, words, catch_exceptions=False)
    assert used == [cluster, cluster]


def test_experiments_that_ran_elsewhere_enter_a_benchmark_by_their_cards(planted_benchmark, tmp_path, monkeypatch):
    file, calls = planted_benchmark
    whole = run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "whole"))
    for name, card in whole.card.experiments.items():  # the planted ones have a name of their own
        (tmp_path / f"{name}.json").write_text(
            json.dumps(sealed(replace(card, experiment=replace(card.experiment, name=name))).plain)
        )
    planted = whole.card.experiments["one"].experiment.config
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": planted, "two": planted})
    calls.clear()
    here = BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "out", experiments=("two",))
    assert run_benchmark(here).missing == ("one",)
    result = run_benchmark(replace(here, cards=(tmp_path / "one.json",)))
    assert [call.experiment for call in calls] == ["two", "two"]
    assert result.card.dimensions == whole.card.dimensions
    assert run_benchmark(here).card.sha256 == result.card.sha256, "the folder keeps the card"
    assert "--card out/one/card.json" in (tmp_path / "out/report.html").read_text()


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
    other = replace(config, about="Another question")
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": other})
    refused(r"'one' differs from the one of this benchmark at scale night \(about: ", name="one")
    card.write_text(json.dumps({**one.plain, "sha256": "0"}))
    with pytest.raises(ConfigError, match=r"card.json"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "out", cards=(card,)))
    monkeypatch.setattr(benchmark, "benchmark_experiments", lambda *_: {"one": config})
    card.write_text(json.dumps(sealed(replace(one, experiment=replace(one.experiment, name="one"))).plain))
    with pytest.raises(ConfigError, match="has a run of 'one' already"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), scale="night", out=tmp_path / "whole", cards=(card,)))


def test_policies_of_a_benchmark_are_named_with_their_experiment(planted_benchmark, tmp_path):
    from roboxim_bringup.runs.policies import PolicySpec

    file, calls = planted_benchmark
    policies = {"one.leave_out.0": PolicySpec(spec="random"), "two.leave_out": PolicySpec(spec="zero")}
    run_benchmark(BenchmarkRunConfig(benchmark=str(file), out=tmp_path / "out", policies=policies))
    assert list(calls[0].policies) == ["leave_out.0"]
    assert calls[1].policies["leave_out"].spec == "zero"
    wrong = {"three.leave_out": PolicySpec(spec="zero")}
    with pytest.raises(ConfigError, match="expected EXPERIMENT.CONDITION"):
        run_benchmark(BenchmarkRunConfig(benchmark=str(file), out=tmp_path / "wrong", policies=wrong))


def test_pages_of_evaluations_are_written_on_demand(tmp_path):
    folder = planted_folder(tmp_path / "run", RATES, TEXT.replace("count: 3", "count: 1"))
    folder_card(folder)
    with pytest.raises(ConfigError, match=r"leave_out.0/evaluation.json"):
        write_evaluation_pages(folder)
    for stage in stages_of(folder.design):
        if stage.kind == "evaluate":
            name = stage.name.removeprefix("evaluate/").partition(".")[0]
            record = EvaluationRecord(task="mine", seed=1, policies=(name,))
            (folder.path / stage.name / "evaluation.json").write_text(to_json(record))
    tables = tmp_path / "results.md"
    words = ("experiment", "report", str(folder.path), "--evaluations", "--films", "0", "--markdown", str(tables))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    pages = sorted((folder.path / "evaluate").glob("*/report.html"))
    assert [page.parent.name for page in pages] == ["baseline.0", "blind.0", "leave_out.0"]
    assert all(f"report: {page}\n" in said for page in pages)
    assert "32 of 80" in pages[-1].read_text(), "by its own results"
    assert f"report: {tables}\n" in said
    assert "| 32 of 80 |" in tables.read_text()


# ------------------------------------------------------------------ stopping early


@pytest.fixture
def planted_evaluations(monkeypatch, tmp_path):
    """Replace evaluations by planted ones; return the numbers of scenes of the calls, and their reports' notes."""
    calls = []

    def made(rates):
        def evaluate(config, **_):
            calls.append((config.episodes, config.stopped, config.page, config.undecided))
            policies = {}
            for name, rate in zip(config.policies, rates, strict=True):
                results = tuple(
                    EpisodeResult(episode_id=f"{i}", index=i, outcome="success" if i % 10 < 10 * rate else "failure")
                    for i in range(config.episodes)
                )
                policies[name] = PolicyResult(name=name, results=results, folder=tmp_path)
            return EvaluationResult(policies=policies, report=tmp_path / "r.html", comparison="", privileged=())

        monkeypatch.setattr(sequential, "evaluate", evaluate)
        return calls

    return made


def test_an_evaluation_stops_when_two_policies_differ(planted_evaluations):
    calls = planted_evaluations((0.9, 0.2))
    config = EvaluationConfig(policies=["good", "bad"], episodes=200)
    found = sequential.evaluate_sequentially(config, 4)
    assert found.decided
    assert "Planned: at most 200 scenes, looks after 50, 100, 150, 200." in found.sentence
    assert "Stopped after 50: this checkpoint of good is better than this one of bad" in found.sentence
    assert [(episodes, page) for episodes, _, page, _ in calls] == [(50, False), (50, True)], "one page, at the end"
    assert calls[-1][1] == found.sentence, "the report states it"
    assert [undecided for *_, undecided in calls] == [True, False], "a report before the end decides nothing"


def test_an_evaluation_of_equal_policies_uses_all_scenes(planted_evaluations):
    calls = planted_evaluations((0.5, 0.5))
    found = sequential.evaluate_sequentially(EvaluationConfig(policies=["a", "b"], episodes=90), 3)
    assert not found.decided
    assert "cannot tell which is better" in found.sentence
    assert [episodes for episodes, *_ in calls] == [30, 60, 90, 90]
    with pytest.raises(ConfigError, match="exactly two"):
        sequential.evaluate_sequentially(EvaluationConfig(policies=["a"], episodes=90), 3)
    with pytest.raises(ConfigError, match="looks must be from 2"):
        sequential.evaluate_sequentially(EvaluationConfig(policies=["a", "b"], episodes=90), 91)


def test_the_report_agrees_with_looks_that_did_not_decide(monkeypatch, tmp_path):
    # 29 against 15 of 200 scenes: p is 0.049, which one look would call a difference and four looks do not
    wins = {"a": lambda i: i % 50 < 32 or i == 199, "b": lambda i: i % 50 < 25 or 32 <= i % 50 < 36 and i < 185}

    def planted(job, title, *_, **__):
        won = wins[title.removeprefix("rollouts of ")]
        return [
            EpisodeResult(episode_id=f"{i}", index=i, outcome="success" if won(i) else "failure")
            for i in range(job.episodes)
        ]

    monkeypatch.setattr(evaluation, "run_episodes", planted)
    config = EvaluationConfig(task="pick_up", policies=["a=random", "b=zero"], episodes=200, out=tmp_path)
    found = sequential.evaluate_sequentially(config, 4)
    assert not found.decided
    assert "cannot tell which is better" in found.sentence
    assert found.evaluation.comparison.startswith("Cannot tell whether this checkpoint of a differs from this one of b")
    page = (tmp_path / "report.html").read_text()
    assert found.sentence in page
    assert 'class="badge cannot_tell"' in page
    assert 'class="badge higher"' not in page
    record = EvaluationRecord(**json.loads((tmp_path / "evaluation.json").read_text()))
    assert record.undecided
