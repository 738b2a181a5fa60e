"""Commands refuse an output folder that holds a dataset, bags or another command's results, and leave it as it is."""

import json

import pytest
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_runs.storage.occupied import OWN_FILES, require_own

HELD = {
    "rlds/roboxim/1.0.0/dataset_info.json": "is a dataset (rlds), not",
    "lerobot/meta/info.json": "is a dataset (lerobot), not",
    "hdf5/demos.hdf5": "is a dataset (hdf5), not",
    "episodes/demo-0/demo-0_0.mcap": "is a folder of bags, not",
    "copied/episodes/demo-0/demo-0_0.mcap": "is a folder of bags, not",
    "bag/demo-0_0.mcap": "is a bag, not",
    "bc/checkpoint.npz": "is the folder of 'roboxim train', not",
    "ev/evaluation.json": "is the folder of 'roboxim evaluate', not",
    "mined/rollouts.jsonl": "is the folder of 'roboxim mine', not",
    "so/experiment.json": "is the folder of 'roboxim experiment run', not",
    "suite/benchmark.json": "is the folder of 'roboxim benchmark', not",
}
"""A file, and what is said of the first folder above it."""
WRITING = {
    "train": ("train", "bc", "nothere"),
    "pretrain": ("pretrain", "bc"),
    "mine": ("mine", "zero", "--size", "32"),
    "evaluate": ("evaluate", "--policy", "zero"),
    "generate": ("generate", "--episodes", "1"),
    "experiment rotate": ("experiment", "rotate", "skill_object", "--sets", "6", "--held-out", "3"),
    "experiment attest": ("experiment", "attest"),
    "experiment run": ("experiment", "run", "skill_object", "--scale", "smoke"),
    "benchmark": ("benchmark", "transfer", "--scale", "smoke"),
}
CONTINUED = {"experiment attest": ("experiment run", "benchmark")}
"""Command to the others whose folder it continues in."""


def refusal(*words):
    with pytest.raises(RoboximError) as error:
        CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    return str(error.value)


def content(folder):
    return {str(path.relative_to(folder)): path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.mark.parametrize("command", WRITING)
def test_what_a_folder_holds_is_said_before_anything_is_written(command, tmp_path):
    for name, held in HELD.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True)
        file.write_text("{}")
        out, before = tmp_path / name.partition("/")[0], content(tmp_path)
        if any(f"'roboxim {own}'" in held for own in (command, *CONTINUED.get(command, ()))):
            continue
        said = refusal(*WRITING[command], "--out", out)
        assert f"{out} {held}" in said
        assert "choose a new or empty output folder (--out or out=), e.g. " in said
        assert content(tmp_path) == before


@pytest.mark.parametrize("form", ["rlds", "lerobot", "hdf5"])
def test_an_export_is_written_beside_nothing_but_datasets_of_its_format(form, tmp_path):
    for name, held in {**HELD, "run/run.json": "is the folder of 'roboxim generate', not"}.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True)
        file.write_text("{}")
        out, before = tmp_path / name.partition("/")[0], content(tmp_path)
        said = refusal("export", form, tmp_path / "nothere", "--out", out)
        if f"({form})" in held:
            assert "no such folder" in said
        else:
            assert f"{out} {held} " in said
            assert f"e.g. {out}-{form}" in said
        assert content(tmp_path) == before


@pytest.mark.parametrize("there", ["roboxim/1.0.0", "roboxim/.partial-1.0.0"])
def test_an_export_that_is_there_or_was_begun_is_continued(there, tmp_path):
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / there).mkdir(parents=True)
    assert "no such folder" in refusal("export", "rlds", tmp_path / "nothere", "--out", tmp_path)
    assert "is the folder of" in refusal("export", "rlds", tmp_path / "nothere", "--out", tmp_path, "--name", "mine")


def test_the_command_of_a_run_is_named_and_folders_of_folders_are_free(tmp_path):
    (tmp_path / "runs" / "demos").mkdir(parents=True)
    (tmp_path / "runs" / "demos" / "run.json").write_text(json.dumps({"purpose": "eval"}))
    (tmp_path / "runs" / "data" / "roboxim" / "1.0.0").mkdir(parents=True)
    (tmp_path / "runs" / "data" / "roboxim" / "1.0.0" / "dataset_info.json").touch()
    (tmp_path / "runs" / "notes.txt").touch()
    with pytest.raises(ConfigError, match="demos is the folder of 'roboxim evaluate', not of 'roboxim train'"):
        require_own(tmp_path / "runs" / "demos", "train")
    for free in ("runs", "new"):
        require_own(tmp_path / free, "train")
    with pytest.raises(ConfigError, match="runs has files and is not the folder of 'roboxim evaluate'"):
        require_own(tmp_path / "runs", "evaluate", empty=True)


def test_a_command_is_known_by_the_files_that_it_writes():
    from roboxim_policies.learning.train import CHECKPOINT
    from roboxim_runs.answers.mining import ROLLOUTS
    from roboxim_runs.evaluation.report import RECORD_FILE
    from roboxim_runs.evaluation.sweeping import RESULT
    from roboxim_runs.experiments import benchmark, card, report
    from roboxim_runs.experiments.scenes.fresh import SEED_FILE
    from roboxim_runs.training.run import TRAINED_ON

    known = {
        "train": (CHECKPOINT, TRAINED_ON), "sweep": (RESULT,), "mine": (ROLLOUTS,), "evaluate": (RECORD_FILE,),
        "benchmark": (benchmark.STATE_FILE,), "experiment run": (report.STATE_FILE, card.STAGES_FILE),
        "experiment attest": (SEED_FILE,),
    }  # fmt: skip
    assert {command: OWN_FILES[command] for command in known} == known


def test_a_rotated_design_is_written_whole_or_not_at_all(tmp_path):
    words = ("experiment", "rotate", "skill_object", "--scale", "laptop", "--sets", "6", "--held-out", "3")
    taken = tmp_path / "benchmark" / "skill_object_rotated.yaml"
    taken.parent.mkdir()
    taken.write_text("about: mine\n")
    assert f"{taken} exists; choose another file" in refusal(*words, "--out", tmp_path)
    assert content(tmp_path) == {"benchmark": False, "benchmark/skill_object_rotated.yaml": b"about: mine\n"}
