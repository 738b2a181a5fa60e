"""``roboxim evaluate``: no figure is stale, duplicate or meaningless, and mistakes are found before work starts."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, EvaluationError
from roboxim_policies.learning.checkpoint_file import FORMAT, STATE_NAMES
from roboxim_runs.episodes import run as episodes
from roboxim_runs.evaluation import run as evaluation
from roboxim_runs.evaluation.results import PolicyResult
from roboxim_runs.evaluation.shown import _scenes
from roboxim_runs.executors import Done
from roboxim_runs.policies.specs import PolicySpec, choose_policies

MINE = """
from roboxim_policies import BasePolicy


class Mine(BasePolicy):
    def __init__(self, checkpoint="", gain=1.0):
        pass

    def act(self, window):
        return [0.0] * 7
"""


class Pool:
    """An executor without workers; every episode ends with ``outcome``."""

    outcome, reason = "success", ""
    asked: list[tuple[str, list[int]]]
    during = staticmethod(lambda: None)

    def __init__(self, *_, **__):
        pass

    def run(self, work, jobs, **_):
        json.dumps(work.settings)  # plain data, whatever runs it
        policies = work.settings["graph"]["policies"]
        indices = [job.data for job in jobs]
        Pool.asked.append((policies[0]["spec"] if policies else "expert", indices))
        for job in jobs:
            index = job.data
            result = EpisodeResult(episode_id=f"e{index}", index=index, outcome=Pool.outcome, reason=Pool.reason)
            yield Done(key=job.key, value=to_plain(result))
        Pool.during()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(episodes, "LocalExecutor", Pool)
    monkeypatch.setattr(evaluation, "run_environment", lambda *_: contextlib.nullcontext({}))
    for name, value in (("asked", []), ("outcome", "success"), ("reason", ""), ("during", staticmethod(lambda: None))):
        monkeypatch.setattr(Pool, name, value, raising=False)
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "looks.py").write_text(
        MINE.replace("Mine", "Looks").replace("):\n    def", "):\n    cameras = 'front'\n    def", 1)
    )
    write_checkpoint(tmp_path / "bc", robot="panda")
    write_checkpoint(tmp_path / "odd", robot="panda", camera_sizes={"fisheye": [96, 96]})
    return tmp_path


def write_checkpoint(path, **said):
    path.mkdir(exist_ok=True)
    np.savez(
        path / "checkpoint.npz", said=np.array(json.dumps({"format": FORMAT, "state_layout": STATE_NAMES, **said}))
    )


def evaluate(*words, episodes=2):
    out = () if "--out" in words else ("--out", "out")
    words = ("evaluate", *out, "--episodes", str(episodes), *map(str, words))
    return CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout


def test_the_same_policy_is_not_run_again_and_the_output_says_so(folder):
    assert "were there" not in evaluate("--policy", "mine.py:Mine")
    said = evaluate("--policy", "mine.py:Mine")
    assert "Mine: 2 of 2 episodes were done already, from 20" in said
    assert "nothing is run" in said
    said = evaluate("--policy", "mine.py:Mine", episodes=3)
    assert "Mine: 2 of 3 episodes were done already" in said
    assert Pool.asked == [("mine.py:Mine", [0, 1]), ("mine.py:Mine", [2])]


def test_results_of_an_earlier_state_of_a_policy_are_refused(folder):
    evaluate("--policy", "mine.py:Mine")
    (folder / "mine.py").write_text(MINE.replace("0.0", "0.1"))
    with pytest.raises(ConfigError, match=r"out/Mine holds 2 episodes of an earlier .*: mine.py has changed; .*--out"):
        evaluate("--policy", "zero", "--policy", "mine.py:Mine")
    assert len(Pool.asked) == 1, "nothing may run before every folder is checked"
    (folder / "mine.py").write_text(MINE)
    evaluate("--policy", "mine.py:Mine")


def test_results_of_another_training_are_refused(folder):
    evaluate("--policy", "bc", "--checkpoint", "bc")
    write_checkpoint(folder / "bc", robot="panda", step=4)
    with pytest.raises(ConfigError, match="bc/checkpoint.npz has changed"):
        evaluate("--policy", "bc", "--checkpoint", "bc")


def test_a_checkpoint_is_the_same_however_its_path_is_written(folder, monkeypatch):
    for path in ("bc", "bc/checkpoint.npz", folder / "bc", "../bc"):
        policy = PolicySpec(spec="bc", options={"checkpoint": path})
        evaluation.evaluate(evaluation.EvaluationConfig(policies=[policy], out=folder / "out", episodes=2, page=False))
        monkeypatch.chdir(folder if path == "bc" else folder / "odd")
    assert [asked for _, asked in Pool.asked] == [[0, 1]], "the others were done already"


def test_a_folder_of_an_older_version_is_refused_only_for_policies_with_files(folder):
    evaluate("--policy", "mine.py:Mine", "--policy", "zero")
    for name in ("Mine", "zero"):
        path = folder / "out" / name / "run.json"
        said = json.loads(path.read_text())
        assert ("policy_files" in said) == (name == "Mine")
        said.pop("policy_files", None)
        path.write_text(json.dumps(said))
    assert "nothing is run" in evaluate("--policy", "zero")
    with pytest.raises(ConfigError, match="older version.*state of mine.py; choose another output folder"):
        evaluate("--policy", "mine.py:Mine")


def test_a_policy_that_changes_meanwhile_gives_no_figure(folder, monkeypatch):
    monkeypatch.setattr(Pool, "during", staticmethod(lambda: (folder / "mine.py").write_text(MINE + "\n# better\n")))
    with pytest.raises(EvaluationError, match="changed while it was evaluated"):
        evaluate("--policy", "mine.py:Mine")
    assert not (folder / "out" / "report.html").exists()


def test_two_checkpoints_in_one_report(folder):
    write_checkpoint(folder / "bc2", robot="panda", step=9)
    said = evaluate("--policy", "old=bc", "--policy", "new=bc", "--checkpoint", "old=bc", "--checkpoint", "new=bc2")
    assert "Cannot tell whether this checkpoint of old differs from this one of new" in said
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert set(summary["policies"]) == {"old", "new"}
    assert "bc2/checkpoint.npz" in summary["facts"]["policy new"]
    assert [spec for spec, _ in Pool.asked] == ["bc", "bc"]


def test_equal_names_are_refused_before_anything(folder):
    (folder / "other.py").write_text(MINE)
    with pytest.raises(ConfigError, match="two policies are called 'Mine'.*'Mine-2=other.py:Mine'"):
        evaluate("--policy", "mine.py:Mine", "--policy", "other.py:Mine")
    assert not (folder / "out").exists()


def test_most_episodes_in_errors_are_no_figure(folder, monkeypatch):
    monkeypatch.setattr(Pool, "outcome", "error")
    monkeypatch.setattr(Pool, "reason", "policy_fault")
    words = ("evaluate", "--out", "out", "--episodes", "2", "--policy", "mine.py:Mine")
    result = CliRunner().invoke(group, words, standalone_mode=False)
    assert isinstance(result.exception, EvaluationError)
    assert "Mine: 2 of 2 episodes ended in errors (policy_fault x2); the policy is not measured" in result.stdout
    assert "%" not in result.stdout
    assert json.loads((folder / "out" / "summary.json").read_text())["policies"]["Mine"]["rate"] is None


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--policy", "bcc"], "unknown policy 'bcc'; did you mean 'bc'"),
        (["--policy", "absent.py:Mine"], "no such file: absent.py"),
        (["--policy", "mine.py:Mien"], "no policy class 'Mien'.*did you mean 'Mine'"),
        (["--policy", "mine.py"], "unknown policy 'mine.py'.*mine.py:CLASS"),
        (["--policy", "random", "--option", "scael=1"], "does not take these arguments.*scale"),
        (["--policy", "random", "--option", "scale=2"], "scale is the fraction of the action limits"),
        (["--policy", "replay", "--option", "source=absent.npz"], "no such.*absent.npz"),
        (["--policy", "random", "--option", "other.scale=1"], "no policy 'other'"),
        (["--policy", "bc"], "needs a checkpoint.*--checkpoint bc=PATH"),
        (["--policy", "bc", "--checkpoint", "absent"], "no checkpoint at absent"),
        (["--policy", "bc", "--checkpoint", "mine.py"], "mine.py is not a readable checkpoint"),
        (["--policy", "random", "--checkpoint", "bc"], r"none of the policies takes it \(random\)"),
        (["--policy", "bc", "--policy", "mine.py:Mine", "--checkpoint", "bc"], "bc and Mine take one; .*bc=bc"),
        (["--policy", "bc", "--checkpoint", "b=bc"], "no policy 'b'; .*did you mean 'bc'"),
        (["--policy", "bc", "--checkpoint", "bc", "--checkpoint", "mine.py"], "say which policy each is for"),
        (
            ["--policy", "looks.py:Looks"],
            "policy 'Looks' needs camera 'front'.*expected one of: workspace, wrist",
        ),
        (["--policy", "bc", "--checkpoint", "odd"], "camera 'fisheye'"),
        (["--policy", "p" * 300 + "=zero"], "has 300 characters, at most 100"),
        (["--policy", "f" * 300 + ".py:Mine"], "'ffff.*' is not a path"),
        (["--policy", "bc", "--checkpoint", "c" * 300], "the checkpoint 'cccc.*' is not a path"),
        (["--policy", "zero", "--out", "o" * 300], "'oooo.*is not a valid folder"),
        (["--policy", "zero", "--out", "bc"], "bc is the folder of 'roboxim train', not of .*evaluate'; choose a new"),
        (["--policy", "zero", "--renderer", "foo"], "unknown renderer 'foo'; expected one of: photo, raster, tiny"),
        (
            ["--policy", "bc", "--checkpoint", "bc", "--task", "pick_cube_ur5"],
            "'bc' was trained with the robot 'panda', the task has ur5.*--other-robot",
        ),
    ],
)
def test_mistakes_are_found_before_anything_starts(folder, words, complaint):
    with pytest.raises(ConfigError, match=complaint):
        evaluate(*words)
    assert Pool.asked == []
    assert not os.path.exists("out")


def test_another_robot_may_be_asked_for(folder):
    evaluate("--policy", "bc", "--checkpoint", "bc", "--task", "pick_cube_ur5", "--other-robot")
    assert Pool.asked == [("bc", [0, 1])]


def test_options_and_checkpoints_reach_the_policy_that_they_are_for(folder):
    first, bc, second = choose_policies(
        ["a=random", "bc", "mine.py:Mine"], ["bc", "Mine=mine.py"], ["scale=0.1", "Mine.gain=2", "bc.execute=2"]
    )
    assert first.options == {"scale": 0.1}
    assert bc.options == {"execute": 2, "checkpoint": str(folder / "bc" / "checkpoint.npz")}
    assert second.options == {"gain": 2, "checkpoint": str(folder / "mine.py")}
    both = choose_policies(["a=bc", "b=bc"], ["bc"], ["b.execute=2"])
    assert [policy.options["checkpoint"] for policy in both] == [str(folder / "bc" / "checkpoint.npz")] * 2
    assert choose_policies(["expert"])[0].launch is None


def test_a_checkpoint_that_sees_from_another_place_is_warned_of_once_and_in_the_report(folder):
    write_checkpoint(folder / "bc", robot="panda", camera_views={"workspace": ["workspace"], "wrist": ["wrist"]})
    said = evaluate("--policy", "bc", "--checkpoint", "bc", "--task", "pick_cube")
    warning = (
        "bc was trained with camera 'workspace' in the place of 'workspace', and sees from that of 'whole' here, so "
        "its rate may be lower (as trained: --camera workspace --camera wrist)."
    )
    assert said.count(warning) == 1
    assert "so its rate may be lower" in (folder / "out" / "report.html").read_text()
    as_trained = ("--camera", "workspace", "--camera", "wrist", "--out", "other")
    assert "was trained" not in evaluate("--policy", "bc", "--checkpoint", "bc", "--task", "pick_cube", *as_trained)
    write_checkpoint(folder / "old", robot="panda")
    assert "was trained" not in evaluate("--policy", "bc", "--checkpoint", "old", "--out", "third")


def test_episodes_of_one_scene_are_compared_one_by_one():
    """A task that draws nothing: each episode of a run meets the same scene, and the k-th ones are compared."""
    results = [EpisodeResult(episode_id=f"e{i}", index=i, outcome="success") for i in range(3)]
    found = {name: PolicyResult(name=name, results=tuple(results), folder=Path(name)) for name in ("a", "b")}
    facts = {name: {f"e{i}": SimpleNamespace(scene="5ce3e" if i < 2 else "0ther") for i in range(3)} for name in found}
    names = _scenes(found, facts, by_scene=True)
    assert names["a"] == names["b"] == {"e0": "0", "e1": "1", "e2": "2"}
