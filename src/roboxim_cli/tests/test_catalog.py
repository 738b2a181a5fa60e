"""Completion and quick refusals of the command line, without importing the rooms."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from roboxim_cli import catalog
from roboxim_cli.main import group
from roboxim_cli.named import Named
from roboxim_core.errors import ConfigError
from roboxim_ros.testing import PATIENCE_S
from roboxim_runs.experiments.calibration.rates import rates_file

HEAVY = ("rclpy", "numpy", "scipy", "pinocchio", "trimesh", "jax", "cattrs", "ruamel.yaml")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Return a cache folder with a fresh catalog, without experiments."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        for part in ("tasks", "policies", "conventions"):
            catalog.catalog(part)
        yield folder


def complete(*words: str) -> set[str]:
    """Complete the last word in a new process, which must not import a heavy module."""
    code = f"""
import sys
from roboxim_cli.main import group
from roboxim_cli.named import Named
try:
    group.main(prog_name="roboxim")
finally:
    heavy = [name for name in {HEAVY!r} if name in sys.modules]
    assert not heavy, heavy
"""
    environment = {
        **os.environ, "_ROBOXIM_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(("roboxim", *words)),
        "COMP_CWORD": str(len(words)),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    return {line.split(",", 1)[1] for line in done.stdout.splitlines()}


def test_values_are_completed_without_a_heavy_import(cache):
    assert {"pick_up", "place_on", "stack"} <= complete("generate", "--skill", "")
    assert complete("generate", "--object", "target=apple,cu") == {"target=apple,cube", "target=apple,cucumber"}
    assert "pick_cube" in complete("generate", "--task", "pick")
    assert {"bc", "expert", "random", "zero"} <= complete("evaluate", "--policy", "")
    assert complete("generate", "--renderer", "ra") == {"raster"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["generate", "--skill", "pick_upp"], r"unknown skill 'pick_upp'; did you mean 'pick_up'\? \(1\d names"),
        (["generate", "--object", "cube,appel"], "unknown object 'appel'; did you mean 'apple'"),
        (["generate", "--task", "pick_cub"], "unknown task 'pick_cub'; did you mean 'pick_cube'"),
        (["evaluate", "--policy", "randm"], "unknown policy 'randm'; .*did you mean 'random'"),
    ],
)
def test_an_unknown_name_is_refused_at_the_door(cache, words, message):
    with pytest.raises(ConfigError, match=message):
        CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)


def test_tasks_are_listed_from_the_kept_catalog_until_something_changes(cache, tmp_path, monkeypatch):
    assert catalog.fresh_catalog("tasks") is not None
    own = tmp_path / "tasks"
    own.mkdir()
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    assert catalog.fresh_catalog("tasks") is None, "another configuration path has a catalog of its own"
    (own / "mine.yaml").write_text("# Lift a cube.\nskill: pick_up\n")
    listed = json.loads(CliRunner().invoke(group, ["tasks", "list", "--json"]).stdout)
    assert listed["tasks"]["mine"] == {"about": "Lift a cube.", "skills": ["pick_up"], "episodes": None}
    assert catalog.fresh_catalog("tasks") is not None
    (own / "mine.yaml").write_text("# Lift an apple.\nskill: pick_up\n")
    assert catalog.fresh_catalog("tasks") is None
    listed = json.loads(CliRunner().invoke(group, ["tasks", "list", "--json"]).stdout)
    assert listed["tasks"]["mine"]["about"] == "Lift an apple."


@pytest.mark.thorough
def test_lists_are_read_from_the_kept_catalog_without_a_heavy_import(cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    catalog.catalog("experiments")
    code = f"""
import sys
from roboxim_cli.main import group
group.main(sys.argv[1:], prog_name="roboxim", standalone_mode=False)
heavy = [name for name in {HEAVY!r} if name in sys.modules]
assert not heavy, heavy
"""
    for words, line in {
        ("policy", "conventions"): "libero ",
        ("policy", "describe", "libero"): "0.05 m",
        ("experiment", "list"): "skill_object",
        ("tasks", "list"): "pick_cube",
    }.items():
        done = subprocess.run(
            [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True, timeout=PATIENCE_S
        )
        assert line in done.stdout


def test_experiments_are_listed_anew_when_rates_were_measured(cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    made = catalog.catalog("experiments")
    assert made["experiments"]["skill_object"]["scales"]["smoke"] == ""
    monkeypatch.setattr("roboxim_cli.catalog_maker.make_catalog", lambda part: {"measured": True})
    assert catalog.catalog("experiments") == made, "nothing has changed"
    rates = rates_file("128x128", "skill_object")
    rates.parent.mkdir(exist_ok=True)
    rates.write_text("{}")
    assert catalog.catalog("experiments") == {"measured": True}
    rates.unlink()


def test_a_damaged_cache_is_made_again(cache, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "roboxim").mkdir()
    catalog._file("tasks").write_text("{")
    assert "pick_up" in catalog.catalog("tasks")["skills"]
    assert catalog.fresh_catalog("tasks") is not None


@pytest.mark.parametrize("kind", ["skill", "task", "object", "camera", "policy", "convention"])
def test_a_fresh_catalog_refuses_the_unknown_names_of_a_kind_alone(cache, monkeypatch, kind):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    known = catalog.names_of(kind)
    assert known
    option = Named(kind)
    assert [option.convert(name, None, None) for name in known] == known
    with pytest.raises(ConfigError, match=f"unknown {kind}"):
        option.convert("no_such_name", None, None)
    assert option.convert("folder/file.py:Class", None, None) == "folder/file.py:Class"
