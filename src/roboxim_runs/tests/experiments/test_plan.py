"""Plans of experiments, the rates that they are from, and the command that prints them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from planted_cards import RATES, planted_card

from roboxim_cli.commands.stages.experiment import command, duration_s
from roboxim_core.config import named_config
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import SideBySide, design_of
from roboxim_runs.experiments.calibration import measuring as calibration
from roboxim_runs.experiments.calibration.rates import rates_file, store_rates, stored_rates
from roboxim_runs.experiments.files import (
    benchmark_experiments,
    load_benchmark,
    load_experiment,
)
from roboxim_runs.experiments.plan import plan_data, plan_lines


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_a_plan_says_counts_time_disk_and_power():
    design = design_of(load_experiment("skill_object", "laptop"))
    text = "\n".join(plan_lines("skill_object", "laptop", design, RATES))
    assert "432; datasets: leave_out 324, baseline 324" in text
    assert "[-/18]" in text
    assert "warning         No scene has distractors" in text
    assert "1,440 of 9 policies" in text
    assert "3.0 h: 11 min demonstrations, 1.2 h trainings, 1.7 h rollouts" in text
    assert "a drop from 80 to 48 % with a chance of 80 % (3 trainings, 120 rollouts each)" in text
    unknown = "\n".join(plan_lines("skill_object", "laptop", design, None))
    assert "roboxim experiment calibrate" in unknown
    assert "GB" not in unknown
    two = design_of(load_experiment("breadth", "laptop"))
    assert "if the other comparison is not found (Holm's" in "\n".join(plan_lines("breadth", "laptop", two, None))
    smoke = design_of(load_experiment("skill_object", "smoke"))
    assert "compare checkpoints, not ways to train" in "\n".join(plan_lines("skill_object", "smoke", smoke, RATES))


OWN = replace(RATES, experiment="skill_object")
"""Rates of a machine on which that experiment was measured."""


def test_the_command_plans_and_lists():
    store_rates(OWN)
    run = CliRunner()
    planned = run.invoke(command, ["plan", "skill_object", "--scale", "laptop", "--json"], catch_exceptions=False)
    data = json.loads(planned.stdout)[0]
    assert (data["demonstrations"]["pick_up target=cube"], data["trainings"], data["rollouts"]) == (18, 6, 1440)
    assert data["hours"] == pytest.approx(3.035, abs=0.01)
    assert data["detectable_drop"] < data["detectable_drop_if_none_of_the_others_is_found"] < 0.8
    fitted = run.invoke(
        command, ["plan", "skill_object", "--scale", "laptop", "--budget", "8h"], catch_exceptions=False
    )
    assert int(re.search(r"\((\d+) trainings", fitted.stdout)[1]) >= 5
    assert float(re.search(r"time +([\d.]+) h", fitted.stdout)[1]) <= 8
    night = run.invoke(
        command, ["plan", "--benchmark", "transfer", "--scale", "night", "--no-probe"], catch_exceptions=False
    )
    assert night.stdout.count("scale night") == 3
    assert "in all: " in night.stdout
    with pytest.raises(ConfigError, match="did you mean 'skill_object'"):
        run.invoke(command, ["plan", "skill_objec"], catch_exceptions=False)
    with pytest.raises(ConfigError, match="one experiment"):
        run.invoke(command, ["plan"], catch_exceptions=False)


TWO = SideBySide(trainings=2, steps_per_s=4.2, start_s=14.0, measured="2026-01-02", source="probe of 40 steps")


def test_a_plan_of_trainings_side_by_side_says_how_their_rate_was_measured():
    design = design_of(load_experiment("skill_object", "laptop"))
    text = "\n".join(plan_lines("skill_object", "laptop", design, RATES.learned(TWO), 2))
    assert "6, 24,000 steps in all, 2 at a time" in text
    assert "48 min trainings" in text, "3 x (4,000 / 4.2 + 14) s"
    assert "2 trainings at a time: 4.2 steps a second each, 5.7 alone; of 2026-01-02: probe of 40 steps" in text
    unknown = "\n".join(plan_lines("skill_object", "laptop", design, RATES, 2))
    assert "the rate of 2 trainings at a time was not measured; 'roboxim experiment calibrate --trainings 2'" in unknown
    elsewhere = design_of(load_experiment("skill_object", "laptop"), "external")
    text = "\n".join(plan_lines("skill_object", "laptop", elsewhere, RATES, 2))
    assert "trainings elsewhere" in text
    assert "without what the policies that are trained elsewhere take to answer" in text
    given = "\n".join(plan_lines("zero_shot", "full", design_of(load_experiment("zero_shot")), RATES))
    assert "training" not in given.partition("  rates ")[0], "it has none"
    assert "without what the policies that exist already take to answer" in given


def test_the_command_measures_trainings_side_by_side_once(monkeypatch):
    store_rates(OWN)
    probed = []

    def probe(config, **_):
        probed.append(config.trainings)
        return TWO

    monkeypatch.setattr(calibration, "calibrate_trainings", probe)
    words = ["plan", "skill_object", "--scale", "laptop", "--trainings", "2"]
    run = CliRunner()
    unknown = run.invoke(command, [*words, "--no-probe", "--json"], catch_exceptions=False)
    assert json.loads(unknown.stdout)[0]["hours"] is None
    for _ in range(2):
        planned = run.invoke(command, [*words, "--json"], catch_exceptions=False)
        data = json.loads(planned.stdout)[0]
        assert (data["trainings"], data["trainings_at_a_time"]) == (6, 2)
        assert data["hours"] < 2.7, "3.0 h with one at a time"
    assert probed == [2]
    assert stored_rates("128x128", "skill_object") == OWN.learned(TWO)
    run.invoke(command, ["plan", "skill_object", "--scale", "laptop"], catch_exceptions=False)
    assert probed == [2], "one at a time was measured before"


def test_files_of_one_name_in_two_folders_have_rates_of_their_own(monkeypatch, tmp_path):
    files = [tmp_path / name / "experiment.yaml" for name in ("one", "other")]
    for file in files:
        file.parent.mkdir()
        file.write_text(named_config("experiments", "skill_object").read_text())
    store_rates(replace(OWN, experiment="one"))
    measured = []

    def measure(config, **_):
        measured.append(config.mix.stem)
        return replace(OWN, experiment=config.mix.stem)

    monkeypatch.setattr(calibration, "calibrate", measure)
    for file in files:
        CliRunner().invoke(command, ["plan", str(file), "--scale", "laptop"], catch_exceptions=False)
    assert measured == ["other"]
    words = ["calibrate", "--experiment", str(files[0])]
    said = CliRunner().invoke(command, words, catch_exceptions=False).output
    assert said.endswith(f"stored in {rates_file('128x128', 'one')}\n")
    assert measured == ["other", "one"]


def test_the_benchmark_has_the_three_experiments_and_fits_a_night():
    configs = benchmark_experiments(load_benchmark("transfer"), "night")
    assert list(configs) == ["skill_object", "camera_object", "camera_skill"]
    designs = [design_of(config) for config in configs.values()]
    assert sum(len(design.trainings) for design in designs) == 18
    assert all(set(e.counts) <= {c.key for c in d.cells if c.unseen} for d in designs for e in d.evaluations)


def test_rates_are_stored_for_this_machine():
    assert stored_rates("128x128", "test") is None
    assert store_rates(RATES) == rates_file("128x128", "test")
    assert stored_rates("128x128", "test") == RATES
    assert stored_rates("256x256", "test") is None, "rates hold for one image size"
    rates_file("128x128", "test").write_text("{}")
    assert stored_rates("128x128", "test") is None, "those of another version are measured again"


def test_an_experiment_has_rates_of_its_own_and_the_trainings_of_all():
    store_rates(replace(RATES, experiment="area", measured="2026-01-03").learned(TWO))
    store_rates(replace(RATES, experiment="faults", measured="2026-01-02", success_s=1.0))
    mine, unknown = stored_rates("128x128", "faults"), stored_rates("128x128", "triple")
    assert (mine.experiment, mine.success_s) == ("faults", 1.0)
    assert mine.side_by_side == (TWO,), "a training does not depend on who measured it"
    assert unknown.experiment == "area", "the last one that was measured"


@pytest.mark.thorough
def test_a_plan_measures_an_experiment_that_was_never_run_once(monkeypatch):
    store_rates(OWN.learned(TWO))
    probed = []

    def probe(settings, **_):
        probed.append((settings.mix.stem, settings.trainings))
        return replace(RATES, experiment=settings.mix.stem, failure_s=16.0)

    monkeypatch.setattr(calibration, "calibrate", probe)
    run = CliRunner()
    for _ in range(2):
        words = ["plan", "robustness", "--scale", "laptop", "--trainings", "2"]
        text = run.invoke(command, words, catch_exceptions=False).stdout
    assert probed == [("robustness", 1)], "two trainings at a time were measured with another experiment"
    assert "if 80 % of the rollouts succeed, an assumption; " in text
    assert stored_rates("128x128", "skill_object").failure_s == OWN.failure_s
    listed = run.invoke(command, ["list"], catch_exceptions=False).stdout
    assert "about " in next(line for line in listed.splitlines() if "laptop" in line), "area has no rates of its own"
    transfer = listed.splitlines()[-3:]
    assert "transfer" in transfer[0]
    assert re.search(r"night about \d+\.\d h", transfer[2])


def test_the_size_that_a_budget_buys_can_be_run(tmp_path):
    store_rates(OWN)
    words = ["plan", "skill_object", "--scale", "laptop", "--budget", "8h", "--out", str(tmp_path / "mine.yaml")]
    text = CliRunner().invoke(command, words, catch_exceptions=False).stdout
    written = load_experiment(str(tmp_path / "mine.yaml"))
    replicates, rollouts = (int(number) for number in re.search(r"\((\d+) trainings, (\d+) rollouts", text).groups())
    assert (written.replicates.count, written.image_size) == (replicates, "128x128")
    assert design_of(written).compared_scenes == rollouts
    assert written.replicates.count > load_experiment("skill_object", "laptop").replicates.count
    with pytest.raises(ConfigError, match="exists; choose another file"):
        CliRunner().invoke(command, words, catch_exceptions=False)


def test_datasets_that_differ_in_their_faults_share_a_table():
    text = "\n".join(plan_lines("faults", "night", design_of(load_experiment("faults", "night")), None))
    assert re.search(r"blue +green +red +yellow\n.* 50 +50 +50 +50", text)


def test_a_plan_says_which_share_of_the_rollouts_it_takes_as_successful():
    ran = replace(OWN, succeeded=0.5)
    design = design_of(load_experiment("skill_object", "laptop"))
    text = "\n".join(plan_lines("skill_object", "laptop", design, ran))
    assert "if 50 % of the rollouts succeed, as in the last run of skill_object; 4.6 h if none does" in text
    assert plan_data("skill_object", "laptop", design, ran)["rollouts_taken_as_successful"] == 0.5
    smoke = design_of(load_experiment("skill_object", "smoke"))
    assert "as if no rollout succeeded" in "\n".join(plan_lines("skill_object", "smoke", smoke, ran))


def test_durations():
    assert [duration_s(text) for text in ("8h", "90min", "1.5 h", "2d")] == [28800, 5400, 5400, 172800]
    with pytest.raises(ConfigError, match="8h"):
        duration_s("soon")


def test_an_earlier_card_decides_what_a_budget_buys():
    store_rates(OWN)
    card = Path(__file__).parents[4] / "docs/results/skill_object-night/card.json"
    words = ["plan", "skill_object", "--scale", "laptop", "--budget", "3.05h", "--from", str(card)]
    planned = CliRunner().invoke(command, words, catch_exceptions=False)
    chosen, before = (
        int(re.search(rf"{word} .*\+-(\d+) points", planned.stdout)[1]) for word in ("chosen", "as it stands")
    )
    assert chosen < before
    assert "3 trainings x 6 cells x 20 rollouts" in planned.stdout
    with pytest.raises(ConfigError, match="give --budget"):
        CliRunner().invoke(command, [*words[:4], *words[6:]], catch_exceptions=False)


def test_a_card_without_any_spread_decides_no_budget(tmp_path):
    store_rates(OWN)
    design = design_of(load_experiment("skill_object", "laptop"))
    path = tmp_path / "card.json"
    path.write_text(json.dumps(planted_card(design, lambda *_: 1.0).plain))
    words = ["plan", "skill_object", "--scale", "laptop", "--budget", "8h", "--from", str(path), "--no-probe"]
    with pytest.raises(ConfigError, match="card.json: all rollouts of a cell ended alike"):
        CliRunner().invoke(command, words, catch_exceptions=False)


def test_a_report_is_printed_as_json():
    card = Path(__file__).parents[4] / "docs/results/skill_object-night/card.json"
    printed = CliRunner().invoke(command, ["report", "--from", str(card), "--json"], catch_exceptions=False)
    gap = json.loads(printed.stdout)["variance_components"][-1]
    assert gap["name"] == "leave_out - baseline"
    assert gap["sd"]["cell"] == pytest.approx(0.193, abs=0.001)
    text = CliRunner().invoke(command, ["report", "--from", str(card)], catch_exceptions=False).stdout
    assert "SD 5.4 points between trainings" in text


@pytest.mark.thorough
def test_a_rotated_design_is_written_as_a_benchmark_and_planned(tmp_path, monkeypatch):
    words = ["rotate", "skill_object", "--scale", "laptop", "--sets", "3", "--held-out", "6", "--out", str(tmp_path)]
    written = CliRunner().invoke(command, words, catch_exceptions=False)
    assert "benchmark/skill_object_rotated.yaml --out OUT" in written.stdout
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    plan = ["plan", "--benchmark", "skill_object_rotated", "--no-probe", "--json"]
    parts = json.loads(CliRunner().invoke(command, plan, catch_exceptions=False).stdout)
    held = [key for part in parts for key, group in part["cells"].items() if group == "unseen"]
    assert len(held) == len(set(held)) == 18, "each cell once"
    assert {part["trainings"] for part in parts} == {2}
    cards = []
    for number, part in enumerate(parts):
        card = planted_card(design_of(load_experiment(part["experiment"])), lambda c, _: RATE[c], seed=number)
        cards.append(tmp_path / f"{number}.json")
        write_experiment_card(card, cards[-1])
    joined = CliRunner().invoke(command, ["join", *map(str, cards), "--json"], catch_exceptions=False)
    data = json.loads(joined.stdout)
    assert data["gap_cells_random"][1] < 0.3 < data["gap_cells_random"][2]
    text = CliRunner().invoke(command, ["join", *map(str, cards)], catch_exceptions=False).stdout
    assert "3 held-out sets of 6 cells, 1 training of each condition a set" in text


RATE = {"leave_out": 0.5, "baseline": 0.8, "blind": 0.05}


def write_experiment_card(card, path):
    path.write_text(json.dumps(card.plain))
