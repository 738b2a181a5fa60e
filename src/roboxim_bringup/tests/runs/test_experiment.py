"""An experiment as a graph of runs: planted policies, resuming, refusals, the card."""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import pytest

from roboxim_bringup.runs import experiment
from roboxim_bringup.runs.experiment import ExperimentRunConfig, named_policies, run_experiment
from roboxim_bringup.runs.folder import RunFolder
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_core.config import parse_yaml
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments.card_checks import check_card
from roboxim_tasks.config import task_mix

TEXT = """
about: Do policies combine a skill and an object that they never saw together?
factors: {task: [pick_up, place_on], target: [cube, soda_can]}
unseen: [{task: pick_up, target: cube}, {task: place_on, target: soda_can}]
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 3}
  baseline: {cells: all, per_cell: 2}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
  blind: {checkpoint_of: leave_out, instruction: ""}
trainers:
  mine: {command: "sh -c 'mkdir -p {out} && echo {seed} {steps} > {out}/model; : {dataset}'", policy: bc, steps: 7}
  external: {}
evaluate: {per_cell: 10, cells: {blind: unseen}}
replicates: {count: 3}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
  - {first: leave_out, second: blind, where: unseen}
image_size: 64x64
"""
UNSEEN = ("pick_up target=cube", "place_on target=soda_can")


@lru_cache(maxsize=16)
def mix_of_text(text):
    return task_mix(parse_yaml(text))


@dataclass
class Fakes:
    """Stands in for the runs that need a simulator. Policies succeed as planted: by condition, held-out or not."""

    planted: dict
    calls: list
    fail_at: str = ""

    def generate(self, config, **_):
        self.calls.append(f"generate {config.episodes}")
        assert config.first_try
        results = [EpisodeResult(episode_id=str(i), index=i, outcome="success") for i in range(config.episodes)]
        return type("Result", (), {"results": results, "kept": results, "out": config.out})()

    def export_rlds(self, source, target, config, **_):
        (cells,) = config.where
        number = config.per_cell * (cells.count(",") + 1)
        self.calls.append(f"export {Path(target).name} {number}")
        assert config.val_fraction == 0.0
        return type("Report", (), {"splits": {"train": number}, "left_out": {}})()

    def evaluate(self, config, **_):
        name, replicate = config.policies.name, Path(config.out).name.split(".")[1]
        if self.fail_at == f"{name}.{replicate}":
            raise RoboximError("the machine was switched off")
        self.calls.append(f"evaluate {name}.{replicate} {config.policies.spec}")
        mix = mix_of_text(Path(config.task).read_text())
        with RunFolder(Path(config.out) / name).opened({"command": "evaluate"}) as folder:
            for index in range(config.episodes):
                drawn = mix.drawn(index)
                rate = self.planted[name, drawn["cell"] in UNSEEN]
                success = (int(drawn["cell_number"]) + int(replicate)) % 10 < 10 * rate
                outcome = "success" if success else "failure"
                folder.append(EpisodeResult(episode_id=f"{index}", index=index, attempt=0, outcome=outcome))
        return type("Result", (), {"require_measured": lambda self: None})()


@pytest.fixture
def fakes(monkeypatch):
    planted = {(name, unseen): 0.8 for name in ("leave_out", "baseline") for unseen in (True, False)}
    planted |= {("blind", True): 0.1, ("leave_out", True): 0.3}
    found = Fakes(planted=planted, calls=[])
    for name in ("generate", "export_rlds", "evaluate"):
        monkeypatch.setattr(experiment, name, getattr(found, name))
    return found


@pytest.fixture
def config(tmp_path):
    def made(text=TEXT, **options):
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        return ExperimentRunConfig(**{"experiment": str(file), "out": tmp_path / "out", **options})

    return made


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
    assert result.card.pairs["0"] == ((6, 0, 10, 4),) * 3
    before = list(fakes.calls)
    again = run_experiment(config())
    assert fakes.calls == before, "nothing runs twice"
    assert again.card.sha256 == result.card.sha256


def test_an_interrupted_experiment_continues_and_ends_with_the_same_card(fakes, config, tmp_path):
    whole = run_experiment(config(out=tmp_path / "whole")).card.sha256
    fakes.fail_at, fakes.calls = "baseline.1", []
    with pytest.raises(RoboximError, match="switched off"):
        run_experiment(config())
    before, fakes.fail_at, fakes.calls = list(fakes.calls), "", []
    result = run_experiment(config())
    assert not set(before) & set(fakes.calls)
    assert result.card.sha256 == whole


def test_a_changed_input_is_refused_by_name(fakes, config):
    run_experiment(config())
    with pytest.raises(ConfigError, match="stage 'train/leave_out.0' was finished with other inputs.*steps: 7 .*8"):
        run_experiment(config(TEXT.replace("steps: 7", "steps: 8")))
    with pytest.raises(ConfigError, match="stage 'generate/0' was finished with other inputs.*episodes: 10 .*12"):
        run_experiment(config(TEXT.replace("per_cell: 3", "per_cell: 4")))
    more = TEXT.replace("count: 3", "count: 4")
    assert run_experiment(config(more)).missing == (), "more replicates are no change of the others"


def test_policies_that_are_trained_elsewhere_are_named_before_anything_runs(fakes, config):
    with pytest.raises(ConfigError, match=r"leave_out.0 is trained elsewhere.*--policy leave_out.0=SPEC"):
        run_experiment(config(trainer="external"))
    assert fakes.calls == []
    half = run_experiment(config(trainer="external", only=("generate", "export")))
    assert len(half.missing) == 9
    assert half.card is None
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


def test_a_command_that_fails_ends_the_run(fakes, config, tmp_path):
    broken = TEXT.replace("mkdir -p {out} && echo {seed} {steps} > {out}/model; :", "exit 3; : {out} {seed}")
    with pytest.raises(RoboximError, match=r"ended with code 3.*leave_out.0.log"):
        run_experiment(config(broken))
    absent = TEXT.replace("sh -c 'mkdir", "no-such-program 'mkdir")
    with pytest.raises(ConfigError, match="cannot be started: no-such-program"):
        run_experiment(config(absent, out=tmp_path / "other"))


def test_the_trainer_roboxim_is_the_one_of_this_environment(tmp_path):
    with open(tmp_path / "log", "w") as log:
        assert experiment._started(["roboxim", "--help"], log).wait(300) == 0


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
