"""Models compared by the folders or cards of their experiments. Results are planted, not simulated."""

import itertools
import json
import shutil

import pytest
from click.testing import CliRunner
from planted_runs import PLANTED_EXPERIMENT, PLANTED_RATES, planted_folder

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError
from roboxim_runs.experiments.models import compared
from roboxim_runs.experiments.report import ExperimentFolder


def test_compare_says_what_the_cards_warn_of(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    for name in ("one", "two"):
        planted_folder(tmp_path / name, PLANTED_RATES, one)
    (tmp_path / "one/proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    words = ("experiment", "compare", str(tmp_path / "one"), str(tmp_path / "two"))
    (tmp_path / "one/report.html").write_text("")
    words += ("--out", str(tmp_path / "models.html"))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "The card of one warns: Delivery is not proved for 1 of 600 episodes: camera pose." in said
    page = (tmp_path / "models.html").read_text()
    assert 'href="one/report.html#episodes?' in page
    assert "two/report.html" not in page, "it is not there"


def test_models_are_compared_on_the_scenes_that_they_shared(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    planted_folder(tmp_path / "weak", {**PLANTED_RATES, "leave_out": 0.2}, one)
    planted_folder(tmp_path / "strong", {**PLANTED_RATES, "leave_out": 0.9}, one)
    models, cards = compared([tmp_path / "weak", tmp_path / "strong"])
    assert set(cards) == {"weak", "strong"}
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met"
    assert models.models["strong"].letters != models.models["weak"].letters
    text = one.replace("steps: 7}", 'steps: 8, until: "--until {until}"}') + "curve: {every: 4, per_checkpoint: 4}\n"
    planted_folder(tmp_path / "curved", {**PLANTED_RATES, "leave_out": 0.9}, text)
    models, _ = compared([tmp_path / "weak", tmp_path / "curved"])
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met", "a curve has scenes of its own"
    card = tmp_path / "card.json"
    card.write_text((tmp_path / "weak/card.json").read_text())
    models, _ = compared([card, tmp_path / "strong"])
    assert models.pairs[0].test == "these checkpoints, without pairing their scenes", "a card alone has no scenes"
    with pytest.raises(ConfigError, match="weak/card.json is named twice"):
        compared([tmp_path / "weak", tmp_path / "weak/card.json"])
    models, _ = compared([tmp_path / "weak/card.json", tmp_path / "strong/card.json"])
    assert models.models.keys() == {"weak", "strong"}, "a card is named by its folder"
    (tmp_path / "alone").mkdir()
    shutil.copy(tmp_path / "weak/card.json", tmp_path / "alone/card.json")
    with pytest.raises(ConfigError, match=r"its card can be read alone.*--from .*alone/card.json"):
        ExperimentFolder.of(tmp_path / "alone")
    models, _ = compared([tmp_path / "alone", tmp_path / "strong"])
    assert models.models.keys() == {"alone", "strong"}, "a published folder has the card alone"


def test_runs_called_alike_are_named_with_the_folders_above_them(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    for name, rate in (("a/run", 0.2), ("b/run", 0.9)):
        planted_folder(tmp_path / name, {**PLANTED_RATES, "leave_out": rate}, one)
        (tmp_path / name / "report.html").write_text("")
    page = tmp_path / "models.html"
    words = ("experiment", "compare", str(tmp_path / "a/run"), str(tmp_path / "b/run"), "--out", str(page))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    rates = {name: rest[1] for name, *rest in map(str.split, said.splitlines()) if "to" in rest[3:5]}
    assert list(rates) == ["b/run", "a/run"]  # the better first
    assert int(rates["a/run"]) < 50 < int(rates["b/run"])
    assert all(f'href="{name}/report.html#episodes?' in page.read_text() for name in rates)


@pytest.mark.thorough
def test_a_run_with_other_scenes_changes_nothing_between_the_others(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    names = ("weak", "strong", "elsewhere")
    for name, rate in zip(names, (0.2, 0.9, 0.5), strict=True):
        text = one.replace("count: 1", "count: 1, first_seed: 5") if name == "elsewhere" else one
        planted_folder(tmp_path / name, {**PLANTED_RATES, "leave_out": rate}, text)
    for order in itertools.permutations(names):
        models, _ = compared([tmp_path / name for name in order])
        found = {frozenset((pair.first, pair.second)): pair.test.partition(", ")[2] for pair in models.pairs}
        assert found == {
            frozenset(("weak", "strong")): "on 40 scenes that both met",
            frozenset(("weak", "elsewhere")): "on different scenes",
            frozenset(("strong", "elsewhere")): "on different scenes",
        }, order


def test_models_are_compared_by_the_condition_of_the_first_run(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    other = one.replace("first: leave_out, second: baseline", "first: baseline, second: leave_out")
    planted_folder(tmp_path / "weak", {**PLANTED_RATES, "leave_out": 0.2}, one)
    planted_folder(tmp_path / "strong", {**PLANTED_RATES, "leave_out": 0.9, "baseline": 0.0}, other)
    models, _ = compared([tmp_path / "weak", tmp_path / "strong"])
    assert models.condition == "leave_out"
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met"
    assert models.pairs[0].difference.value == pytest.approx(0.2 - 0.9), "not the baseline's scenes"


@pytest.mark.thorough
def test_runs_whose_rollouts_were_asked_different_things_are_not_compared(tmp_path):
    planted_folder(tmp_path / "plain", PLANTED_RATES)
    planted_folder(tmp_path / "crowded", PLANTED_RATES, PLANTED_EXPERIMENT.replace("maximum: 0", "maximum: 3"))
    planted_folder(tmp_path / "large", PLANTED_RATES, PLANTED_EXPERIMENT.replace("64x64", "128x128"))
    words = ("experiment", "compare", str(tmp_path / "plain"), str(tmp_path / "crowded"))
    with pytest.raises(ConfigError, match="set.distractors.maximum: 0 in plain, 3 in crowded"):
        CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
    words = (*words[:3], str(tmp_path / "large"))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "The runs differ in image size, too: 64x64 (plain); 128x128 (large)." in said
