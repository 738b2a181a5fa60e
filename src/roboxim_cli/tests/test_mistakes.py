"""A user's mistake on the command line gets one short message that says what to do."""

from __future__ import annotations

import signal
import sys

import pytest
from click.testing import CliRunner

from roboxim_cli.main import group, main
from roboxim_cli.options import parse_counts, parse_resources
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_runs.datasets.export import unfinished
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.training.run import TrainingResult


def mistake(*words) -> str:
    """Return a command's error message for a mistake."""
    with pytest.raises(RoboximError) as error:
        CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    said = str(error.value)
    assert len(said) < 500
    assert "\n" not in said
    return said


@pytest.fixture
def run(tmp_path):
    """Return a folder that looks like a run of two bags."""
    for number in range(2):
        bag = tmp_path / "run" / "episodes" / f"demo-0-0000{number}-0"
        bag.mkdir(parents=True)
        (bag / "metadata.yaml").touch()
        (bag / f"{bag.name}_0.mcap").write_bytes(b"\x89MCAP0\r\n")
    return tmp_path / "run"


def test_training_needs_a_dataset_not_a_run(run, tmp_path):
    assert f"roboxim export rlds {run} --out {run}-rlds" in mistake("train", "bc", run, "--out", tmp_path / "bc")
    assert "no such folder" in mistake("train", "bc", tmp_path / "nothere", "--out", tmp_path / "bc")
    assert not (tmp_path / "bc").exists()


def test_a_share_of_no_noise_is_refused(tmp_path):
    said = mistake("generate", "--noise-descents", 1, "--noise-mm", 0, "--noise-mrad", 0, "--out", tmp_path / "out")
    assert "noise_descents 1 is a share of noise_mm and noise_mrad, which are both 0; set one of them" in said
    assert not (tmp_path / "out").exists()


def test_resources_of_trainings_need_a_cluster(tmp_path):
    given = ("--scale", "smoke", "--out", tmp_path / "out", "--training-resources", "GPU=1")
    for words in (("experiment", "run", "skill_object"), ("benchmark", "transfer")):
        assert "--training-resources are for --executor ray" in mistake(*words, *given)


def test_training_refuses_a_file_as_its_folder_and_an_empty_configuration(run, tmp_path):
    (tmp_path / "file").touch()
    assert "it is a file; choose another output folder" in mistake("train", "bc", run, "--out", tmp_path / "file")
    assert "is empty" in mistake("train", "bc", run, "--config", tmp_path / "file")


def test_a_path_of_the_wrong_kind_is_not_called_a_damaged_bag(run, tmp_path):
    file = tmp_path / "my_policy.py"
    file.touch()
    for words in (("info", file), ("check", file), ("play", file), ("repair", file)):
        assert "my_policy.py is not a bag" in mistake("bag", *words)
    assert f"is a run, not one bag; name one, e.g. {run}/episodes/demo-0-00000-0" in mistake("bag", "play", run)
    assert "no such folder" in mistake("export", "rlds", tmp_path / "nothere", "--out", tmp_path / "rlds")


def test_an_export_says_that_its_run_is_not_finished(tmp_path):
    run = tmp_path / "run"
    assert unfinished(run) == ""
    with RunFolder(run).opened({"purpose": "demo", "episodes": 2}) as folder:
        folder.append(EpisodeResult(episode_id="e0", index=0, outcome="success"))
        assert unfinished(run) == "1 of 2 episodes are done; 'roboxim generate' is still running there"
    assert unfinished(run / "episodes") == "1 of 2 episodes are done; 'roboxim generate' was stopped there"
    for wanted in ({"episodes": 1}, {"episodes": 2, "shard": "1/2"}):
        with RunFolder(run).opened({"purpose": "demo", **wanted}):
            pass
        assert unfinished(run) == ""


def test_a_broken_task_is_named_and_hides_no_other(tmp_path, monkeypatch):
    (tmp_path / "tasks").mkdir()
    broken = tmp_path / "tasks" / "broken.yaml"
    broken.write_text("# Mine.\nskill: pick_upp\n")
    (tmp_path / "tasks" / "whole.yaml").write_text("# Pick up, e.g. a\n# cube. Nothing else.\nskill: pick_up\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    result = CliRunner().invoke(group, ["tasks", "list"])
    assert f"{broken} is not valid: skill (line 2)" in str(result.exception)
    assert "  Pick up, e.g. a cube.\n" in result.stdout
    assert f"{broken} is not valid: skill (line 2)" in mistake("tasks", "sample", "--task", broken)
    assert "pick_cube.yaml with the command line's options is not valid" in mistake(
        "tasks", "sample", "--colors", "puce"
    )


@pytest.mark.parametrize(
    "words",
    [
        ("generate", "--task", "x" * 300 + ".yaml"),
        ("generate", "--out", "x" * 300),
        ("train", "bc", "x" * 300),
        ("train", "bc", "somewhere", "--out", "x" * 300),
        ("export", "rlds", "somewhere", "--out", "x" * 300),
        ("up", "--id", "x" * 300),
    ],
    ids=lambda words: " ".join(words).replace("x" * 300, "LONG"),
)
def test_a_name_of_300_characters_is_an_error_by_name(words, monkeypatch, capsys, tmp_path, runtime):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "argv", ["roboxim", *words])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "xxxx" in said
    assert len(said) < 300
    assert list(here.iterdir()) == []


def test_a_value_of_the_wrong_kind_names_the_policy():
    assert "argument 'scale' of policy 'random'" in mistake("evaluate", "--policy", "random", "--option", "scale=much")


@pytest.mark.parametrize("text", ["train=1.5", "train", "=3", "train=-1", "train=1,train=2"])
def test_counts_that_are_none_are_refused_with_an_example(text):
    assert parse_counts("--split", "train=90, val=10") == {"train": 90, "val": 10}
    with pytest.raises(ConfigError, match=r"--split is NAME=COUNT,\.\.\. with COUNT from 0, e\.g\. train=90,val=10"):
        parse_counts("--split", text)


@pytest.mark.parametrize("text", ["cpu=-1", "gpu=nan", "gpu=inf", "cpu"])
def test_resources_that_are_none_are_refused_with_an_example(text):
    assert parse_resources("--resources", "cpu=2,Gpu=0.25,mine=1") == {"CPU": 2.0, "GPU": 0.25, "mine": 1.0}
    with pytest.raises(ConfigError, match=r"--resources is NAME=N,\.\.\. with N from 0"):
        parse_resources("--resources", text)


@pytest.mark.parametrize(
    "command", ["generate", "evaluate", "pretrain act", "train bc x", "replay x", "dataset audit x"]
)
def test_no_episodes_are_not_the_default_number(command):
    result = CliRunner().invoke(group, [*command.split(), "--episodes", "0"])
    assert result.exit_code == 2
    assert "Invalid value for '--episodes': 0 is not in the range x>=1" in result.output


def test_a_file_is_written_into_a_folder_that_is_made_and_never_over_a_folder(tmp_path, monkeypatch, capsys):
    for number, words in enumerate((("schema", "task"), ("policy", "new-server"))):
        file = tmp_path / f"new{number}" / "file.txt"
        CliRunner().invoke(group, [*words, "--out", str(file)], catch_exceptions=False)
        assert file.stat().st_size > 1000
    monkeypatch.setattr(sys, "argv", ["roboxim", "schema", "task", "--out", str(tmp_path)])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert f"error: {tmp_path} is a folder; expected the name of a file" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["file/schema.json", "file/new/schema.json", "/proc/new/schema.json"])
def test_a_place_below_which_nothing_can_be_is_an_error_in_one_line(place, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["roboxim", "schema", "task", "--out", place])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert "check the path" in said
    assert "free some space" not in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("policy", "serve", "random", "--port", "9"), "--port: for --wire alone"),
        (("policy", "serve", "random", "--wire", "openpi", "--size", "128x96"), "one number from 16 to 4096 px"),
        (("robot", "sheet", "--size", "as-configured"), "one number from 16 to 4096 px, got 'as-configured'"),
        (("evaluate", "--policy", "random", "--film-scenes", "1,2,x", "--episodes", "2"), "no scene 2, x to film"),
        (
            ("evaluate", "--policy", "random", "--film-scenes", "1", "--episodes", "4", "--shard", "1/2"),
            "no scene 1 to film: scenes are numbered from 0 to 2 in steps of 2",
        ),
        (("tasks", "sample", "--camera", "workspace="), "--camera is NAME or NAME=VALUE"),
        (("tasks", "sample", "--camera", "wrist", "--camera", "wrist"), "--camera names 'wrist' twice"),
        (("export", "rlds", "missing", "--camera", "workspace="), "--camera is NAME or NAME=VALUE"),
        (("export", "rlds", "missing", "--where", "steps<nan"), "compares numbers"),
        (("export", "rlds", "missing", "--val-fraction", "2"), "val_fraction must be in 0..1"),
        (("robot", "sheet", "--size", "5000"), "one number from 16 to 4096 px, got '5000'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_an_option_that_would_have_no_effect_is_refused_before_anything_runs(words, said, tmp_path):
    assert said in mistake(*words, *(("--out", tmp_path / "out") if words[0] != "policy" else ()))
    assert not (tmp_path / "out").exists()


def test_a_file_of_tasks_is_drawn_where_it_is_named(tmp_path):
    words = ["tasks", "sample", "--episodes", "1", "--renderer", "tiny", "--out", str(tmp_path / "tasks.png")]
    CliRunner().invoke(group, words, catch_exceptions=False)
    assert (tmp_path / "tasks.png").stat().st_size > 1000


def test_a_checkpoint_is_not_compared_with_itself(tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_runs.evaluation.sweeping.read_description", lambda path: {})
    monkeypatch.setattr("roboxim_runs.evaluation.sweeping.family_in", lambda description: "bc")
    (tmp_path / "checkpoint.npz").touch()
    assert "is named twice" in mistake("sweep", tmp_path, tmp_path / "checkpoint.npz", "--out", tmp_path / "out")


@pytest.mark.parametrize("given", [["--set", "seed=7"], ["--seed", "7"]])
def test_the_seed_of_a_pre_training_is_the_one_that_was_given(given, monkeypatch):
    seen = []

    def stop(config, **_):
        seen.append(config)
        raise ConfigError("enough")

    monkeypatch.setattr("roboxim_runs.training.pretraining.pretrain", stop)
    assert mistake("pretrain", "act", *given) == "enough"
    assert (seen[0].seed, seen[0].learning.seed) == (7, 7)


@pytest.mark.parametrize("command", [("train", "bc", "data"), ("pretrain", "bc")])
def test_a_field_of_a_training_has_one_value(command):
    assert "'steps' is given by --steps and by --set" in mistake(*command, "--steps", "2", "--set", "steps=5")
    assert "'chunk' was given twice" in mistake(*command, "--set", "chunk=4", "--set", "chunk=8")


def test_commands_that_are_named_can_be_pasted_also_where_a_path_has_a_space(run):
    spaced = run.rename(run.parent / "my run")
    assert f"roboxim export rlds '{spaced}' --out '{spaced}-rlds'" in mistake("train", "bc", spaced)


def test_fields_are_named_without_what_is_none(tmp_path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    said = mistake("train", "bc", tmp_path, "--config", tmp_path / "list.yaml")
    assert "expected a mapping with keys of steps, batch" in said
    assert "FAMILY" not in said


def test_the_name_of_a_subcommand_alone_is_found_in_its_group():
    assert "no command 'audit'; did you mean 'roboxim dataset audit'?" in CliRunner().invoke(group, ["audit"]).output
    assert "no command 'generat'; did you mean 'generate'?" in CliRunner().invoke(group, ["generat"]).output
    assert "did you mean 'roboxim correlate'?" in CliRunner().invoke(group, ["experiment", "correlate"]).output
    assert "expected one of: act, bc, rt1s" in CliRunner().invoke(group, ["train", "BC"]).output


def test_an_experiment_and_a_benchmark_are_not_taken_for_each_other():
    assert "it is a benchmark: roboxim benchmark transfer" in mistake("experiment", "plan", "transfer")
    said = CliRunner().invoke(group, ["benchmark", "skill_object", "--out", "out"]).output
    assert "'skill_object' is an experiment: roboxim experiment run skill_object" in said


def test_an_audit_of_a_benchmark_names_faults_and_ends_with_code_1(tmp_path):
    (tmp_path / "mine.py").write_text("def balance():\n    return lambda seen, words: int(seen[2] + seen[3] > 0)\n")
    words = ["audit-benchmark", "CartPole-v1", "--episodes", "2", "--solver", f"{tmp_path / 'mine.py'}:balance"]
    result = CliRunner().invoke(group, words)
    assert result.exit_code == 1
    assert "fault  says_success: no step states whether the task succeeded" in result.stdout
    assert result.stdout.endswith("CartPole-v1: 14 checks passed, 1 found faults\n")
    assert "no environment 'Nothing-v0'" in mistake("audit-benchmark", "Nothing-v0")
    assert "did you mean 'roboxim/PickCube-v0'?" in mistake("audit-benchmark", "PickCube-v0")
    assert CliRunner().invoke(group, ["audit-benchmark", "CartPole-v1", "--option", "size"]).exit_code == 2
    assert "--option size line 1: not valid YAML" in mistake("audit-benchmark", "CartPole-v1", "--option", "size=[")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("balance = lambda: 3", "must return a policy, a function of observation and instruction; got int"),
        (
            "def balance(): raise ValueError('no weights')",
            "does not return a policy: ValueError: no weights (raised at",
        ),
        ("def balance(): return lambda seen, words: seen['camera']", "the solver's policy failed: IndexError: "),
        ("other = 3", "no policy class 'balance' in '"),
    ],
)
def test_an_audit_says_what_is_wrong_with_a_solver(tmp_path, code, words):
    (tmp_path / "mine.py").write_text(f"{code}\n")
    given = ["audit-benchmark", "CartPole-v1", "--episodes", "1", "--solver", f"{tmp_path / 'mine.py'}:balance"]
    result = CliRunner().invoke(group, given)
    assert words in str(result.exception)
    assert isinstance(result.exception, ConfigError), "the exit code 1 says that the environment has a fault"
    assert "must be FILE.py:NAME" in CliRunner().invoke(group, [*given[:-1], "bc"]).output


@pytest.mark.parametrize(
    ("steps", "until", "words"),
    [
        (300, 30, "checkpoint.npz has 300 of 300 steps already; nothing to do"),
        (30, 30, "has 30 of 300 steps already, as --until 30 asks; nothing to do"),
        (120, None, "has 120 of 300 steps already, after which the held-out loss no longer fell; nothing to do"),
    ],
)
def test_a_training_without_new_steps_says_how_far_it_is(monkeypatch, tmp_path, steps, until, words):
    def trained(*_, **__):
        file = tmp_path / "checkpoint.npz"
        return TrainingResult(family="bc", checkpoint=file, steps=steps, chosen="", steps_now=0, wall_s=0.0)

    monkeypatch.setattr("roboxim_runs.training.run.train_policy", trained)
    more = ["--until", str(until)] if until else []
    result = CliRunner().invoke(group, ["train", "bc", "data", "--steps", "300", *more])
    assert words in result.output
