"""An experiment's folder after its run: its card and its report. Results are planted, not simulated."""

import itertools
import json
import shlex
from collections import Counter

import pytest
from click.testing import CliRunner
from planted_runs import PLANTED_EXPERIMENT, PLANTED_RATES, planted_folder

from roboxim_cli.main import group
from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.results_log import ResultsLog, line_of
from roboxim_eval.experiments import stages_of
from roboxim_eval.experiments.card import parse_card
from roboxim_runs.evaluation.report import EvaluationRecord
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.experiments.provenance import attestation_template
from roboxim_runs.experiments.report import (
    ExperimentFolder,
    checkpoint_episodes,
    experiment_episodes,
    folder_card,
    reproduction,
    write_evaluation_pages,
    write_experiment_report,
)
from roboxim_runs.experiments.trained.policies import named_policies
from roboxim_runs.policies.specs import PolicySpec


def test_a_folder_receives_a_card_and_a_page(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
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
    assert "No scene has distractors, so the scene alone reveals which object is meant." in page
    assert "Only scenes of place_on have the support plate, so the scene alone reveals this task." in page
    episodes = experiment_episodes(folder)
    assert len(episodes) == 3 * (80 + 80 + 40)
    assert {e.cell for e in episodes if e.arm == "blind"} == {"pick_up target=cube", "place_on target=soda_can"}


@pytest.mark.thorough
def test_card_and_page_have_the_measures_beside_success_of_tasks_with_limits(tmp_path):
    measures = {"limits.force_max_n": 30.0, "limits.keep_out_s": 0.2, "limits.crossed": 2.0}
    folder = planted_folder(tmp_path / "limited", PLANTED_RATES, predicates=measures)
    card = folder_card(folder)
    beside = card.evaluations[0].beside
    assert (beside.episodes, beside.crossed) == (80, 80)
    assert beside.measures["force_max_n"].median == 30.0
    assert parse_card(json.loads((folder.path / "card.json").read_text())) == card
    page = write_experiment_report(folder, card).read_text()
    assert "<th>crossed a limit</th><th>largest force of a contact</th><th>time in a keep-out volume</th>" in page
    assert '<td class="num">80 of 80</td><td class="num">30 N (30 N to 30 N)</td>' in page
    without = folder_card(planted_folder(tmp_path / "free", PLANTED_RATES)).plain
    assert [row for row in without["evaluations"] if "beside" in row] == [], "without limits, cards are as before"


def test_the_printed_command_names_the_file_the_renderer_and_the_policies(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
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
    text = PLANTED_EXPERIMENT.replace("steps: 7}", 'steps: 8, until: "--until {until}"}').replace(
        "count: 3", "count: 1"
    )
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, text + "curve: {every: 4, per_checkpoint: 4}\n")
    page = write_experiment_report(folder, folder_card(folder)).read_text()
    assert '<a href="#episodes?arm=leave_out%404"><circle' in page
    assert "Success in seen cells alone. The line is the mean" in page, (
        "held-out cells are kept for the final evaluation"
    )
    arms = Counter(episode.arm for episode in checkpoint_episodes(folder))
    assert arms["leave_out@4"] == arms["baseline@4"] == 4
    assert {e.arm for e in experiment_episodes(folder)} == {"leave_out", "baseline", "blind"}


def test_the_page_of_a_card_alone_warns_of_what_its_scenes_tell(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    folder_card(folder)
    html = tmp_path / "page.html"
    words = ("experiment", "report", "--from", str(folder.path / "card.json"), "--out", str(html))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    for text in (said, html.read_text()):
        assert "No scene has distractors, so the scene alone reveals which object is meant." in text


def test_results_that_changed_after_the_card_are_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    folder_card(folder)
    results = evaluation_folder(folder.path, "evaluate/baseline.1") / "results.jsonl"
    whole = results.read_text()
    results.write_text(whole.replace('"outcome":"failure"', '"outcome":"success"', 1))
    with pytest.raises(ConfigError, match=r"results.jsonl line \d+ was changed after it was written"):
        folder_card(ExperimentFolder.of(folder.path))
    results.write_text(whole)
    entries = ResultsLog(results).read()
    lines = [line_of(entry.key, {**entry.data, "outcome": "success"}) for entry in entries]  # with new checksums
    results.write_text("".join(lines))
    with pytest.raises(ConfigError, match=r"results of evaluate/baseline.1 have changed since card.json"):
        folder_card(ExperimentFolder.of(folder.path))
    with pytest.raises(ConfigError, match="not the folder of an experiment"):
        ExperimentFolder.of(tmp_path)


def test_attestations_are_stated_and_wrong_ones_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
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


def test_what_nobody_states_about_trainings_elsewhere_is_missed_not_filled_in(tmp_path):
    command = 'command: "train {dataset} {out} {seed}", policy: bc, '
    assert command in PLANTED_EXPERIMENT
    external = PLANTED_EXPERIMENT.replace(command, "")
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, external)
    attest, unstated = tmp_path / "run/attest.yaml", "The recipe of baseline and leave_out is not stated"
    for text in (None, attestation_template(("leave_out.0",))):
        if text is not None:
            attest.write_text(text)
        (tmp_path / "run/card.json").unlink(missing_ok=True)
        card = folder_card(ExperimentFolder.of(folder.path))
        first = card.trainings[0]
        assert (first.attest.recipe, first.attest.dataset_sha256, first.steps) == ({}, "", 0)
        assert any(warning.startswith(unstated) for warning in card.warnings)
    said = card.datasets["leave_out.0"].sha256
    attest.write_text(f"recipe: {{model: octo, steps: 9}}\ntrainings: {{leave_out.0: {{dataset_sha256: {said}}}}}\n")
    (tmp_path / "run/card.json").unlink()
    card = folder_card(ExperimentFolder.of(folder.path))
    assert card.trainings[0].attest.recipe == {"model": "octo", "steps": 9}
    assert [t.attest.dataset_sha256 for t in card.trainings if t.condition == "leave_out"][:2] == [said, ""]
    assert not any("is not stated" in warning for warning in card.warnings)
    attest.write_text("recipe: {augment: false, dropout: 0, batch: 0, weights: '', seed: null}\n")
    (tmp_path / "run/card.json").unlink()
    card = folder_card(ExperimentFolder.of(folder.path))
    assert card.trainings[0].attest.recipe == {"augment": False, "dropout": 0}


def test_the_printed_command_of_a_further_round_names_the_trainer(tmp_path):
    text = PLANTED_EXPERIMENT.replace(
        "  mine: ", '  first: {command: "go {dataset} {out} {seed}", policy: bc}\n  mine: '
    )
    planted_folder(tmp_path / "run", {**PLANTED_RATES, "pick_up target=soda_can": 0.9}, text)
    state = tmp_path / "run/experiment.json"
    state.write_text(json.dumps(json.loads(state.read_text()) | {"trainer": "mine"}))
    card = folder_card(ExperimentFolder.of(tmp_path / "run"))
    out = tmp_path / "a round.yaml"
    words = ["experiment", "collect", str(tmp_path / "run/card.json"), "--demonstrations", "9", "--out", str(out)]
    said = CliRunner().invoke(group, words, catch_exceptions=False).output
    command = shlex.split(said.splitlines()[-1].partition(": ")[2])
    assert command == ["roboxim", "experiment", "run", str(out), "--trainer", "mine", "--out", "OUT"]
    assert card.warnings
    assert all(f"The card warns: {warning}" in said for warning in card.warnings)
    copy = ["experiment", "plan", str(out), "--trainer", "mine", "--no-probe", "--out", str(tmp_path / "copy.yaml")]
    assert "copy.yaml --trainer mine --out OUT" in CliRunner().invoke(group, copy, catch_exceptions=False).output


def test_stored_proofs_and_substitutions_are_part_of_the_card(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    (folder.path / "proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    judged = [{"cell": "pick_up target=cube", "satisfied": ["place_on target=cube"]}] * 9
    (folder.path / "judged_again.json").write_text(json.dumps([*judged, {"cell": "place_on target=soda_can"}]))
    card = folder_card(folder)
    assert card.proofs == {"camera pose": (599, 600)}
    assert card.scores["substitution"]["rate"][0] == pytest.approx(0.9)
    page = write_experiment_report(folder, card).read_text()
    assert "Delivery is not proved for 1 of 600 episodes: camera pose." in page
    assert "<td>pick_up target=cube</td><td>place_on target=cube</td>" in page


def test_pages_of_evaluations_are_written_on_demand(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, PLANTED_EXPERIMENT.replace("count: 3", "count: 1"))
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
