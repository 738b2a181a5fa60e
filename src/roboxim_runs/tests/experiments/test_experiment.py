"""An experiment as a graph of runs: planted policies, resuming, refusals, the card."""

import json
import shutil
from pathlib import Path

import pytest

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments.card import CardCode
from roboxim_eval.experiments.card_checks import check_card
from roboxim_eval.experiments.proving.proofs import Fault, Tally
from roboxim_runs.events import Notice
from roboxim_runs.experiments import card as experiment_card
from roboxim_runs.experiments import provenance as experiment_provenance
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.trained.policies import named_policies
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.storage.folder import locked
from roboxim_runs.storage.store import STORED_FILE


def test_all_stages_run_once_and_the_card_has_the_planted_result(fakes, config, tmp_path):
    result = run_experiment(config())
    assert result.missing == ()
    assert fakes.calls[:3] == ["generate 10", "export leave_out.0 6", "export baseline.0 8"]
    assert len([call for call in fakes.calls if call.startswith("evaluate")]) == 9
    assert "evaluate blind.2 reworded" in fakes.calls
    assert (tmp_path / "out/train/baseline.2/model").read_text() == "2 7\n"
    assert result.card.sentences[0].startswith("leave_out in unseen cells is lower than baseline there by 50 points")
    scores = result.card.scores
    assert scores["absolute"][0] == pytest.approx(0.3)
    assert scores["relative"][0] == pytest.approx(0.375)
    assert fakes.judged == [("leave_out.0", 14)] * 3, "failed held-out episodes of the leave-out condition"
    assert scores["substitution"]["rate"][0] == 1.0
    assert result.card.pairs["0"] == ((6, 0, 10, 4),) * 3
    before = list(fakes.calls)
    assert before.index("prove leave_out.0 baseline.0") == 3, "before any training"
    assert before.index("prove rollouts leave_out.0 baseline.0 blind.0") < before.index("evaluate leave_out.1 bc")
    again = run_experiment(config())
    assert fakes.calls == before, "nothing runs twice"
    assert again.card.sha256 == result.card.sha256


def test_two_commands_do_not_write_one_folder(fakes, config, tmp_path):
    out = config().out
    out.mkdir()
    with locked(out), pytest.raises(ConfigError, match="another command is running"):
        run_experiment(config())
    assert fakes.calls == []


@pytest.mark.thorough
def test_an_interrupted_experiment_continues_and_ends_with_the_same_card(fakes, config, tmp_path):
    whole = run_experiment(config(out=tmp_path / "whole")).card.sha256
    fakes.fail_at, fakes.calls = "baseline.1", []
    with pytest.raises(RoboximError, match="switched off"):
        run_experiment(config(trainings=3))
    before, fakes.fail_at, fakes.calls = list(fakes.calls), "", []
    result = run_experiment(config(trainings=3))
    assert not set(before) & set(fakes.calls)
    assert result.card.sha256 == whole, "the number of trainings at once does not matter either"
    assert "continued" not in (tmp_path / "whole/stages.jsonl").read_text(), "its times are whole, for later plans"


def test_a_changed_input_is_refused_by_name(fakes, config, experiment):
    run_experiment(config())
    with pytest.raises(ConfigError, match="stage 'train/leave_out.0' was finished with other inputs.*steps: 7 .*8"):
        run_experiment(config(experiment.replace("steps: 7", "steps: 8")))
    with pytest.raises(ConfigError, match="stage 'generate/0' was finished with other inputs.*episodes: 10 .*12"):
        run_experiment(config(experiment.replace("per_cell: 3", "per_cell: 4")))
    more = experiment.replace("count: 3", "count: 4")
    assert run_experiment(config(more)).missing == (), "more replicates are no change of the others"


TASK = (Path(__file__).parents[4] / "config/tasks/pick_cube.yaml").read_text()
GIVEN = """
about: Is a policy as good as another one?
factors: {{task: [{task}]}}
conditions: {{a: {{given: true}}, b: {{given: true}}}}
evaluate: {{per_cell: 2}}
replicates: {{count: 1}}
compare: [{{first: a, second: b}}]
"""


def test_another_shard_in_the_folder_of_a_finished_one_is_refused_as_such(fakes, config):
    run_experiment(config(shard="1/2", only=("generate",)))
    with pytest.raises(ConfigError, match='inputs \\(shard: "1/2" stored, "2/2" requested\\); choose another output'):
        run_experiment(config(shard="2/2", only=("generate",)))


def test_a_changed_task_file_is_refused_by_name(fakes, config, tmp_path):
    task = tmp_path / "pick_cube.yaml"
    task.write_text(TASK)
    text, fakes.planted = GIVEN.format(task=task), {("a", False): 1.0, ("b", False): 0.5}
    run_experiment(config(text, policies=named_policies(["a=random"])))
    task.write_text(TASK + "# as before\n")
    run_experiment(config(text, policies=named_policies(["a=random"])))
    task.write_text(TASK.replace("lift_m: 0.05", "lift_m: 0.01"))
    with pytest.raises(ConfigError, match=f"the task {task} has changed since stage 'evaluate/a.0' was begun"):
        run_experiment(config(text, policies=named_policies(["a=random", "b=random"])))
    task.write_text(TASK)
    assert run_experiment(config(text, policies=named_policies(["a=random", "b=random"]))).missing == ()


def test_a_changed_policy_file_is_refused_by_name(fakes, config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = tmp_path / "mine.py"
    policy.write_text("from roboxim_policies.builtin import RandomPolicy\n\nclass Mine(RandomPolicy):\n    pass\n")
    text, fakes.planted = GIVEN.format(task="pick_cube"), {("a", False): 1.0, ("b", False): 0.5}
    run_experiment(config(text, policies=named_policies(["a=mine.py:Mine"])))
    monkeypatch.chdir(tmp_path.parent)
    a = f"a={tmp_path.name}/mine.py:Mine"
    run_experiment(config(text, policies=named_policies([a])))
    policy.write_text(policy.read_text() + "    version = 2\n")
    with pytest.raises(ConfigError, match="'evaluate/a.0' was finished with an earlier state.*mine.py has changed"):
        run_experiment(config(text, policies=named_policies([a, "b=random"])))


@pytest.mark.thorough
def test_what_a_pack_leaves_out_runs_again_if_it_is_read(fakes, config, tmp_path):
    fakes.fail_at = "baseline.1"
    with pytest.raises(RoboximError, match="switched off"):
        run_experiment(config())
    before, fakes.fail_at, fakes.calls, out = list(fakes.calls), "", [], tmp_path / "out"
    for folder in ("generate", "export"):
        shutil.rmtree(out / folder)
    for bags in out.glob("evaluate/*/*/" + STORED_FILE):
        bags.unlink()
    card = run_experiment(config()).card
    assert card is not None
    left = {call.removesuffix(" bc").removesuffix(" reworded") for call in before if call not in fakes.calls}
    rollouts = {"evaluate leave_out.0", "evaluate baseline.0", "evaluate blind.0"}
    assert left == {"prove leave_out.0 baseline.0", "prove rollouts leave_out.0 baseline.0 blind.0", *rollouts}
    assert (out / "evaluate/.leave_out.1-without-bags").is_dir(), "results are set apart, not removed"
    fakes.calls = []
    shutil.rmtree(out / "export")
    assert run_experiment(config()).card.sha256 == card.sha256
    assert fakes.calls == [], "nothing reads them any more"


@pytest.mark.thorough
def test_trainings_that_are_added_after_results_were_seen_are_stated(fakes, config, experiment):
    first = run_experiment(config()).card
    assert not [text for text in first.statements if "after results were seen" in text]
    more = experiment.replace("count: 3", "count: 4")
    (said,) = [text for text in run_experiment(config(more)).card.statements if "after results were seen" in text]
    assert "replicates.count: 3 stored, 4 requested" in said
    again = run_experiment(config(more)).card
    assert said in again.sentences


@pytest.fixture
def at(monkeypatch):
    """Return a function that changes the commit of the code, as `git commit` between two calls does."""

    def moved(letter):
        found = CardCode(version="0.1.0", commit=letter * 40)
        monkeypatch.setattr(experiment_provenance, "code", lambda: found)

    return moved


def differing(card):
    """Return what a card says about stages that ran with something else than others."""
    return [text for text in card.statements if text.startswith("stages ran with")]


def older(out):
    """Make a folder one of a version that did not store what stages ran with."""
    lines = [json.loads(line) for line in (out / "stages.jsonl").read_text().splitlines()]
    assert all("ran" in line for line in lines)
    texts = [
        json.dumps({key: value for key, value in line.items() if key not in ("ran", "checksum")}) for line in lines
    ]
    (out / "stages.jsonl").write_text("\n".join(texts) + "\n")


@pytest.mark.thorough
def test_another_renderer_is_a_changed_input(fakes, config, tmp_path):
    said = (
        'stage \'generate/0\' was finished with other inputs .renderer: "raster" stored, "tiny" requested.*--renderer'
    )
    run_experiment(config(only=("generate", "export")))
    for only in (("evaluate",), ("generate",), ("generate", "export", "train", "evaluate")):
        with pytest.raises(ConfigError, match=said):
            run_experiment(config(renderer="tiny", only=only))
    shard = {"out": tmp_path / "shard", "shard": "1/2", "only": ("evaluate",), "trained": tmp_path / "out"}
    with pytest.raises(ConfigError, match=said):
        run_experiment(config(renderer="tiny", **shard))
    assert not [call for call in fakes.calls if call.startswith("evaluate")]
    card = run_experiment(config()).card
    assert (card.environment.renderer, differing(card)) == ("raster", [])


@pytest.mark.thorough
def test_stages_that_draw_nothing_do_not_need_the_renderer_s_name(fakes, config, tmp_path):
    run_experiment(config(renderer="tiny"))
    again = run_experiment(config(only=("export", "train")))
    assert again.card.environment.renderer == "tiny"
    assert json.loads((tmp_path / "out/experiment.json").read_text())["renderer"] == "tiny"


@pytest.mark.thorough
def test_a_folder_of_an_older_version_keeps_its_renderer_and_its_card(fakes, config, at, tmp_path):
    at("a")
    card = run_experiment(config(renderer="tiny")).card
    older(tmp_path / "out")
    at("b")
    with pytest.raises(ConfigError, match='renderer: "tiny" stored, "raster" requested.*run with --renderer tiny'):
        run_experiment(config())
    again = run_experiment(config(renderer="tiny")).card
    assert again.sha256 == card.sha256
    assert again.code.commit == "a" * 40
    (tmp_path / "out/experiment.json").unlink()
    with pytest.raises(ConfigError, match='renderer: "raster" stored, "tiny" requested'):
        run_experiment(config(renderer="tiny"))


@pytest.mark.thorough
def test_a_finished_run_keeps_its_card_after_a_commit_and_on_another_machine(fakes, config, at, monkeypatch):
    at("a")
    card = run_experiment(config()).card
    at("b")
    monkeypatch.setattr(experiment_provenance, "packages_sha256", lambda: "others")
    monkeypatch.setattr(experiment_provenance, "device", lambda: "another processor")
    monkeypatch.setattr(experiment_card, "device", lambda: "another processor")
    again = run_experiment(config()).card
    assert (again.code, again.sha256) == (card.code, card.sha256)
    assert again.code.commit == "a" * 40
    assert differing(again) == []


@pytest.mark.thorough
def test_a_card_names_the_versions_of_the_code_that_its_stages_ran_with(fakes, config, experiment, at, tmp_path):
    at("a")
    fakes.fail_at = "leave_out.0"
    with pytest.raises(RoboximError, match="switched off"):
        run_experiment(config())
    at("b")
    fakes.fail_at = ""
    card = run_experiment(config()).card
    assert card.code.commit == "b" * 40, "that of the evaluations"
    said = "stages ran with 2 versions of the code: 0.1.0 at aaaaaaaaaaaa (generate/0 and "
    (statement,) = differing(card)
    assert statement.startswith(said)
    assert "0.1.0 at bbbbbbbbbbbb (evaluate/leave_out.0 and " in statement
    assert statement in card.sentences, "the report shows it"
    assert check_card(card.plain) == card
    at("c")
    assert run_experiment(config()).card.sha256 == card.sha256
    older(tmp_path / "out")
    more = run_experiment(config(experiment.replace("count: 3", "count: 4"))).card
    assert more.code.commit == "c" * 40
    assert "2 versions of the code: unknown (generate/0 and " in differing(more)[0]


@pytest.mark.thorough
def test_a_card_names_the_machines_that_its_stages_ran_on(fakes, config, monkeypatch):
    monkeypatch.setattr(experiment_provenance, "device", lambda: "AMD EPYC, NVIDIA H100")
    run_experiment(config(only=("generate", "export", "train")))
    monkeypatch.setattr(experiment_provenance, "device", lambda: "AMD EPYC")
    card = run_experiment(config()).card
    assert card.environment.device == "AMD EPYC", "that of the evaluations"
    (statement,) = differing(card)
    assert statement.startswith("stages ran with 2 machines: AMD EPYC, NVIDIA H100 (generate/0 and ")
    assert "AMD EPYC (evaluate/" in statement


def test_an_experiment_waits_for_policies_that_are_trained_elsewhere(fakes, config):
    half = run_experiment(config(trainer="external"))
    assert fakes.calls == ["generate 10", "export leave_out.0 6", "export baseline.0 8", "prove leave_out.0 baseline.0"]
    assert len(half.waiting) == 9
    assert half.card is None
    first = run_experiment(config(trainer="external", policies=named_policies(["leave_out.0=random"])))
    assert "evaluate leave_out.0 random" in fakes.calls
    assert len(first.waiting) == 7, "blind.0 has its policy too"
    with pytest.raises(ConfigError, match="no such condition or replicate; did you mean"):
        run_experiment(config(trainer="external", policies=named_policies(["leave_out.9=random"])))
    with pytest.raises(ConfigError, match="evaluate/leave_out.0' was finished with other inputs"):
        run_experiment(config(trainer="external", policies=named_policies(["leave_out=zero"])))


def test_policies_that_are_trained_elsewhere_are_evaluated(fakes, config):
    policies = named_policies(["leave_out=random", "baseline=zero"], ["leave_out.scale=0.1"])
    assert policies["leave_out"] == PolicySpec(spec="random", options={"scale": 0.1})
    result = run_experiment(config(trainer="external", policies=policies))
    assert "evaluate leave_out.1 random" in fakes.calls
    assert "evaluate blind.1 reworded" in fakes.calls
    assert result.missing == ()


def test_wrong_names_are_refused(fakes, config):
    unknown = {name: PolicySpec(spec="randon") for name in ("leave_out", "baseline")}
    with pytest.raises(ConfigError, match="unknown policy 'randon'"):
        run_experiment(config(trainer="external", policies=unknown))
    with pytest.raises(ConfigError, match="the expert reads the task"):
        run_experiment(config(trainer="external", policies=named_policies(["leave_out=expert", "baseline=expert"])))
    with pytest.raises(ConfigError, match="expected CONDITION"):
        named_policies(["leave_out"])
    with pytest.raises(ConfigError, match="none of the policies"):
        named_policies(["leave_out=random"], ["other.scale=1"])
    with pytest.raises(ConfigError, match="did you mean 'train'"):
        config(only=("trian",))
    with pytest.raises(ConfigError, match="trainings: expected at least 1"):
        config(trainings=0)


def test_a_command_that_fails_ends_the_run(fakes, config, experiment, tmp_path):
    broken = experiment.replace("mkdir -p {out} && echo {seed} {steps} > {out}/model; :", "exit 3; : {out} {seed}")
    with pytest.raises(RoboximError, match=r"ended with exit code 3.*leave_out.0.log"):
        run_experiment(config(broken))
    absent = experiment.replace("sh -c 'mkdir", "no-such-program 'mkdir")
    with pytest.raises(ConfigError, match="cannot be started: no-such-program"):
        run_experiment(config(absent, out=tmp_path / "other"))


def test_datasets_may_differ_in_what_their_actions_mean(fakes, config, experiment):
    text = experiment.replace("baseline: {cells: all,", "baseline: {export: {actions: tool}, cells: all,")
    assert text != experiment
    result = run_experiment(config(text))
    assert [fakes.exports[f"{name}.0"][1].actions for name in ("leave_out", "baseline")] == ["", "tool"]
    assert fakes.policies["baseline.0"].options == {"checkpoint": fakes.policies["baseline.0"].options["checkpoint"]}
    assert result.missing == ()


def test_cells_of_a_dataset_may_have_demonstrations_of_their_own_number(fakes, config, experiment):
    more = "per_cell: 3, more: {pick_up target=soda_can: 4}}"
    run_experiment(config(experiment.replace("per_cell: 3}", more), only=("generate", "export")))
    assert "export leave_out.0 10" in fakes.calls
    assert "generate 14" in fakes.calls
    assert fakes.exports["leave_out.0"][1].cell_counts == {"place_on target=cube": 3}


def test_a_card_is_checked_against_its_counts(fakes, config, tmp_path):
    run_experiment(config())
    card = json.loads((tmp_path / "out/card.json").read_text())
    assert check_card(card).sentences == (*(v["sentence"] for v in card["verdicts"]), *card["warnings"])
    assert check_card({**card, "times": {}}).sha256 == card["sha256"], "times are no part of the hash"
    for part, value in (("warnings", ["It is the best."]), ("sha256", "0")):
        with pytest.raises(ConfigError, match=f"its {part} do not follow"):
            check_card({**card, part: value})
    flattered = json.loads(json.dumps(card))
    flattered["evaluations"][0]["by_cell"]["pick_up target=cube"] = [10, 10, 0]
    with pytest.raises(ConfigError, match="do not follow"):
        check_card(flattered)
    with pytest.raises(ConfigError, match="no card of schema"):
        check_card({"schema": 0})


def test_training_data_with_a_held_out_episode_are_refused_before_any_training(fakes, config, tmp_path):
    fault = Fault(check="unseen", bag="episodes/demo-3", text="it is of the held-out cell 'pick_up target=cube'")
    fakes.training = Tally(checks={"unseen": (999, 1000)}, faults=(fault,))
    for _ in range(2):
        with pytest.raises(
            RoboximError, match=r"prove/training.0: 1 of 1000 .*\n  episodes/demo-3: .*pick_up target=cube"
        ):
            run_experiment(config())
    assert not (tmp_path / "out/train").exists()
    assert (
        json.loads((tmp_path / "out/prove/training.0/proof.json").read_text())["faults"][0]["bag"] == "episodes/demo-3"
    )


def test_an_episode_without_proof_is_none_of_its_cell(fakes, config, experiment):
    fakes.evaluation = Tally(checks={"camera": (119, 120)}, faults=(Fault(check="camera", bag="a", text="moved"),))
    fakes.excluded = {"leave_out": [0]}
    card = run_experiment(config()).card.plain
    rollouts = {row["condition"]: sum(n for _, n, _ in row["by_cell"].values()) for row in card["evaluations"]}
    assert rollouts == {"leave_out": 39, "baseline": 40, "blind": 20}
    assert card["proofs"] == {"camera": [357, 360]}
    fakes.evaluation = Tally(checks={"camera": (118, 120)}, faults=tuple(
        Fault(check="camera", bag=bag, text="camera 'workspace' is 5.0 cm from the demanded pose") for bag in "ab"
    ))  # fmt: skip
    with pytest.raises(RoboximError, match=r"2 of 120 .*1 % are tolerated.*\n  a: camera.*5.0 cm"):
        run_experiment(config(experiment.replace("count: 3", "count: 4")))


@pytest.mark.thorough
def test_tolerated_faults_are_named_with_bag_and_figure(fakes, config, experiment, tmp_path):
    out = tmp_path / "out"
    bags = [f"evaluate/baseline.0/baseline/episodes/eval-{number}" for number in range(7)]
    moved = "camera 'workspace' is 5.0 cm from the demanded pose"
    faults = tuple(Fault(check="camera", bag=str(out / bag), text=moved) for bag in bags)
    fakes.evaluation = Tally(checks={"camera": (993, 1000)}, faults=faults[:3])
    fakes.excluded = {"baseline": [0, 1, 2]}
    events = []
    one = experiment.replace("count: 3", "count: 1")
    card = run_experiment(config(one), on_event=events.append).card
    (said,) = [text for text in card.statements if text.startswith("prove/evaluation.0: ")]
    assert "tolerated faults in 3 of 1000 episodes, 3 of them left out of the results: " in said
    assert all(f"{bag}: camera: {moved}" in said for bag in bags[:3])
    assert str(tmp_path) not in said, "the same on every machine"
    assert [event.text for event in events if isinstance(event, Notice)].count(said) == 1
    assert said in card.sentences, "the report shows it"
    assert said in (out / "report.html").read_text().replace("&#39;", "'")
    again = run_experiment(config(one)).card
    assert again.sha256 == card.sha256
    fakes.evaluation = Tally(checks={"camera": (993, 1000)}, faults=faults)
    card = run_experiment(config(one, out=tmp_path / "other")).card
    said = next(text for text in card.statements if text.startswith("prove/evaluation.0: "))
    assert said.count(": camera: ") == 5
    assert said.endswith("; and 2 more (all of them are in prove/evaluation.0/proof.json)")
