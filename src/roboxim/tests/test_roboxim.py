"""``import roboxim`` is quick and starts nothing, and the README's example runs unchanged."""

from __future__ import annotations

import ast
import inspect
import json
import re
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import pytest

import roboxim
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_runs.executors import Done

READMES = [Path(__file__).parents[3] / "README.md", Path(__file__).parents[1] / "README.md"]


def script_of(readme: Path) -> str:
    """Return the lines of a README that import roboxim."""
    return next(
        code for code in re.findall(r"```python[^\n]*\n(.*?)```", readme.read_text(), re.DOTALL) if "roboxim." in code
    )


class Executor:
    """An executor without workers; every second episode succeeds."""

    def run(self, work, jobs, *, cancellation=None, **_):
        for job in jobs:
            if cancellation is not None and cancellation.is_set():
                raise roboxim.CancelledError("cancelled")
            outcome = "success" if job.data % 2 == 0 else "failure"
            result = EpisodeResult(episode_id=f"e{job.data}", index=job.data, outcome=outcome, reason="not_lifted")
            yield Done(key=job.key, value=to_plain(result))


def test_importing_loads_and_starts_nothing():
    ours = ["roboxim_bringup", "roboxim_cli", "roboxim_core", "roboxim_runs"]
    heavy = ["numpy", "rclpy", "jax", "scipy", "click", *ours]
    script = f"import sys, roboxim; sys.exit(' '.join(name for name in {heavy} if name in sys.modules) or None)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_every_name_is_there():
    for name in roboxim.__all__:
        assert getattr(roboxim, name) is not None, name
    assert sorted(roboxim.__all__) == roboxim.__all__ == dir(roboxim)
    with pytest.raises(AttributeError, match="'generat'; it has .*generate"):
        roboxim.generat  # noqa: B018


@pytest.mark.parametrize("readme", READMES, ids=["root", "package"])
def test_the_readme_calls_functions_that_exist_with_arguments_that_they_take(readme):
    code = script_of(readme)
    assert len([line for line in code.splitlines() if line and not line.startswith("import")]) <= 7
    calls = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)]
    named = {node.func.attr: node for node in calls if isinstance(node.func, ast.Attribute)}
    steps = ("generate", "export_rlds", "train_bc", "evaluate")
    assert set(steps) <= set(named) <= {*steps, "to_frame", "film"}
    for name, node in ((step, named[step]) for step in steps):
        keywords = {keyword.arg: None for keyword in node.keywords}
        inspect.signature(getattr(roboxim, name)).bind(*[None] * len(node.args), **keywords)


def test_every_format_has_a_function_with_the_fields_of_its_configuration():
    for name, field in (("rlds", "shard_mib"), ("lerobot", "version"), ("hdf5", "compression")):
        assert field in inspect.signature(getattr(roboxim, f"export_{name}")).parameters
    with pytest.raises(roboxim.ConfigError, match="LeRobotConfig has no field 'verson'.*did you mean 'version'"):
        roboxim.export_lerobot("runs/none", "runs/out", verson="2.1")


def test_an_evaluation_is_a_value(tmp_path, monkeypatch):
    events = []
    found = roboxim.evaluate(
        policies=["zero", roboxim.PolicySpec(spec="random", name="wild", options={"scale": 0.5})],
        out=tmp_path / "out", episodes=5, executor=Executor(), on_event=events.append,
    )  # fmt: skip
    assert found.success_rate == 0.6
    low, high = found.interval
    assert 0 < low < 0.6 < high < 1
    assert [result.outcome for result in found["wild"].results] == ["success", "failure"] * 2 + ["success"]
    assert found.report.read_text().startswith("<!doctype html>")
    command = json.loads((tmp_path / "out" / "summary.json").read_text())["command"]
    assert command.startswith(f"roboxim.evaluate(out='{tmp_path}/out', episodes=5, policies=['zero', PolicySpec(spec=")
    kinds = [type(event).__name__ for event in events]
    assert kinds[:3] == ["StageStarted", "StageProgress", "StageProgress"]
    assert kinds.count("EpisodeFinished") == 10
    assert kinds.count("PolicyMeasured") == 2
    with pytest.raises(roboxim.ConfigError, match="no policy 'wld'.*did you mean 'wild'"):
        found["wld"]
    pandas = ModuleType("pandas")
    pandas.DataFrame = list
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    rows = found.to_frame()
    assert [row["success"] for row in rows if row["policy"] == "wild"] == [True, False, True, False, True]
    assert "<th>wild</th>" in found._repr_html_()
    assert "report.html" in found._repr_html_()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(roboxim.ConfigError, match="pip install pandas"):
        found.to_frame()


def test_a_cancelled_run_continues(tmp_path):
    stop, events = threading.Event(), []

    def cancel(event):
        events.append(event)
        if isinstance(event, roboxim.events.EpisodeFinished) and event.result.index == 1:
            stop.set()

    def generate(**more):
        return roboxim.generate(out=tmp_path / "demos", episodes=4, executor=Executor(), **more)

    with pytest.raises(roboxim.CancelledError):
        generate(on_event=cancel, cancellation=stop)
    assert events[-1].text.startswith("2 episodes are done")
    assert len(generate().results) == 4
    assert len(generate().kept) == 2


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"episode": 3}, "no field 'episode'.*did you mean 'episodes'"),
        ({"episodes": -1}, "episodes must be >= 0, got -1"),
        ({"episodes": "3"}, "episodes must be a whole number, got '3'"),
        ({"size": 5}, "size must be 16 to 4096 px"),
        ({"size": "128"}, "size must be a whole number or two"),
        ({"out": "o" * 300}, "not a valid folder"),
        ({"skill": "pick_upp"}, "unknown skill 'pick_upp'"),
    ],
)
def test_a_wrong_argument_is_named_before_anything_starts(tmp_path, monkeypatch, fields, complaint):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(roboxim.ConfigError, match=complaint):
        roboxim.generate(**fields)
    assert list(tmp_path.iterdir()) == []


def test_the_callers_environment_stays(tmp_path, monkeypatch):
    import os

    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    before = dict(os.environ)
    roboxim.generate(out=tmp_path / "demos", episodes=1, executor=Executor())
    assert dict(os.environ) == before


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_readmes_lines_are_a_script(tmp_path):
    code = script_of(READMES[0])
    code = code.replace("episodes=100", "episodes=2").replace("size=128", "size=64")
    code = code.replace('out="runs/bc"', 'out="runs/bc", steps=4, hidden=16, channels=12').replace(
        'out="runs/evaluation"', 'out="runs/evaluation", episodes=1, max_steps=8'
    )
    (tmp_path / "script.py").write_text(code + "\nprint(evaluation['bc'].results[0].episode_id)\n")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    numbers, episode = done.stdout.strip().splitlines()
    assert re.fullmatch(r"[01].0 \(0.\d+, \d.\d+\) runs/evaluation/report.html", numbers)
    assert episode.startswith("eval-0-00000")
    assert (tmp_path / "runs" / "evaluation" / "report.html").exists()
