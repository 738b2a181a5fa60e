"""The worked example of docs/how-to/own_skill.md, run from the text of the document itself."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_policies.builtin import ZeroPolicy
from roboxim_recorder.bag import BagReader
from roboxim_runs.assets.check import check
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks import measures
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.script import Script
from roboxim_tasks.skills import SKILLS, from_file

DOCUMENT = Path(__file__).parents[1] / "docs" / "how-to" / "own_skill.md"
FILES = dict(re.findall(r"^```\w+\n# (kitchen/\S+)\n(.*?)^```$", DOCUMENT.read_text(), re.DOTALL | re.MULTILINE))


@pytest.fixture
def kitchen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Write the example's files and install it as an editable install does: on the path, with its entry points."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    folder = tmp_path / "kitchen"
    project = tomllib.loads(FILES["kitchen/pyproject.toml"])["project"]
    installed = folder / "kitchen-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1.0\n")
    (installed / "entry_points.txt").write_text(
        "\n".join(
            f"[{group}]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())
            for group, entries in project["entry-points"].items()
        )
    )
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(folder / "config"))
    for registry in (SKILLS, COMPONENTS):
        monkeypatch.setattr(registry, "_items", dict(registry._items))
        monkeypatch.setattr(registry, "_entry_points_loaded", False)
    yield folder
    sys.modules.pop("kitchen", None)


def test_the_example_is_short() -> None:
    assert len(FILES) == 4
    assert sum(len(text.splitlines()) + 1 for text in FILES.values()) < 100


@pytest.mark.thorough
def test_the_expert_solves_the_new_skill_and_doing_nothing_does_not(kitchen: Path, tmp_path: Path) -> None:
    assert check("pepper_mill", ModelLibrary()) == []
    data = yaml.safe_load(task_text(skill="shake"))
    data["reset"]["cameras"] = {"names": []}
    config = RunConfig(output_dir=str(tmp_path), purpose="test", run_seed=0, task_config=yaml.safe_dump(data))
    with CoreGraph(tmp_path, renderer="tiny") as cores:
        solved = EpisodeRunner(cores.ports, config).run_index(0)
        idle = replace(cores.ports, actor=CoreActor(ZeroPolicy()))
        nothing = EpisodeRunner(idle, replace(config, max_steps=10, settle_ticks=5)).run_index(1)
    assert (solved.outcome, solved.recovered, solved.reason) == ("success", False, ""), solved
    assert not nothing.success_ever
    assert nothing.reason == "not_grasped"
    infos = [BagReader(tmp_path / result.bag).info for result in (solved, nothing)]
    assert [info.task.instruction for info in infos] == ["Shake the pepper mill"] * 2
    assert all(info.scene.entity("target").model == "pepper_mill" for info in infos)
    depths_m = [info.scene.table.size[0] for info in infos]
    assert all(0.8 <= depth_m <= 0.9 for depth_m in depths_m)
    assert depths_m[0] != depths_m[1]


def test_it_leaves_nothing_behind() -> None:
    assert "shake" not in SKILLS
    assert "table_depth" not in COMPONENTS


def test_a_plug_in_may_import_the_placement_first() -> None:
    subprocess.run([sys.executable, "-c", "import roboxim_tasks.sampling.placement"], check=True)


@pytest.mark.thorough
def test_a_skill_alone_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (text,) = re.findall(r"^```python\n# my_skill.py\n(.*?)^```$", DOCUMENT.read_text(), re.DOTALL | re.MULTILINE)
    (tmp_path / "my_skill.py").write_text(text)
    monkeypatch.setattr(SKILLS, "_items", dict(SKILLS._items))
    monkeypatch.setattr(from_file, "_loaded", {})
    task = task_text(skill=f"{tmp_path / 'my_skill.py'}:Touch", cameras=["workspace"])
    config = RunConfig(output_dir=str(tmp_path), purpose="test", run_seed=0, task_config=task)
    with CoreGraph(tmp_path, renderer="tiny") as cores:
        solved = EpisodeRunner(cores.ports, config).run_index(0)
    assert solved.outcome == "success", solved
    assert "whole" in task_text(skill=f"{tmp_path / 'my_skill.py'}:Touch"), "the camera cuts the hand"


def test_every_measure_and_every_move_is_in_the_tables() -> None:
    text = DOCUMENT.read_text().partition("### Measures and moves")[2].partition("\n## ")[0]
    helpers = {"above", "joint_value", "offset", "robot_forces", "seconds_between", "set_entity", "with_last"}
    public = [
        name
        for owner in (measures, Script)
        for name, made in vars(owner).items()
        if inspect.isfunction(made) and made.__module__.startswith("roboxim_tasks.") and not name.startswith("_")
    ]
    assert {name for name in public if f"`{name}(" not in text} == helpers


def test_the_example_of_an_own_camera_and_light_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = DOCUMENT.with_name("cameras.md").read_text()
    for name, content in re.findall(r"^```yaml\n# (mine/\S+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path / "mine"))
    config = parse_task_config(task_text("push_at_night"))
    scene = EpisodeGenerator(ModelLibrary()).draw(SeedPath(run_seed=0, purpose="demo", index=0), config).scene
    assert [camera.name for camera in scene.cameras] == ["workspace", "top", "wrist"]
    assert [light.kind for light in scene.look.lights] == ["lamp", "lamp"]
