"""`roboxim planner`: requests without a graph."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from roboxim_cli.commands.planner import command
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.dumps import Dump, answered, write_dump
from roboxim_planner.pipeline import Planner
from roboxim_planner.queries import PoseQuery

HOME = (0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785)
REQUEST = """
service: plan_to_pose
request:
  start_state: {position: [0, -0.2, 0, -2.2, 0, 2.0, 0.785]}
  scene: {objects: [{name: mug, model: mug, pose: {position: {x: 0.6, y: 0.3, z: 0.05}, orientation: {w: 1.0}}}]}
target: {pose: {position: {x: 0.5, y: 0.2, z: 0.2}, orientation: {x: 1.0, w: 0.0}}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the dump of an unreachable goal."""
    library = ModelLibrary()
    planner = Planner(library.robot("panda"))
    query = PoseQuery(robot="panda", start=HOME, targets=(Pose(position=(1.5, 0.0, 0.2)),))
    outcome, _ = answered(query, planner)
    dump = Dump(query=query, outcome=outcome, config=planner.config, robot_digest=library.digest("panda"))
    write_dump(dump, tmp_path / "dumps", "unreachable", kept=5)
    return tmp_path / "dumps"


def test_dumps_are_listed_replayed_and_shown(folder: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke
    listed = run(command, ["dumps", "--folder", str(folder)], catch_exceptions=False)
    assert "GOAL_UNREACHABLE: goal unreachable" in listed.output
    replayed = run(command, ["replay", "latest", "--folder", str(folder)], catch_exceptions=False)
    assert "the same answer" in replayed.output
    shown = ["show", "unreachable-0.dump.json", "--folder", str(folder), "--out", str(tmp_path / "out")]
    assert "mm" in run(command, shown, catch_exceptions=False).output
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["unreachable-0_scene.png"]


def test_a_request_in_a_file_is_planned_and_shown(tmp_path: Path) -> None:
    file = tmp_path / "request.yaml"
    file.write_text(REQUEST)
    asked = ["show", str(file), "--out", str(tmp_path / "out")]
    CliRunner().invoke(command, asked, catch_exceptions=False)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["request_profiles.png", "request_scene.png"]
    file.write_text(REQUEST.replace("plan_to_pose", "plan_to_pos"))
    with pytest.raises(ConfigError, match="did you mean 'plan_to_pose'"):
        CliRunner().invoke(command, asked, catch_exceptions=False)
    file.write_text(REQUEST.replace("scene: {", "scene: {episode_id: latest, "))
    with pytest.raises(InvalidRequestError, match="running graph"):
        CliRunner().invoke(command, asked, catch_exceptions=False)
