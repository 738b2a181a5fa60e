"""Rerendering: unchanged settings keep every bit, requested changes apply, interrupted runs continue."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from roboxim_bringup.core_graph import CoreGraph
from roboxim_cli.commands.stages.rerender import command
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError, RecorderError, SimError
from roboxim_policies.builtin import RandomPolicy
from roboxim_recorder.bag import BagReader
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.episodes.rerendering import RerenderConfig, rerender
from roboxim_runs.events import Event, StageFinished, StageProgress, StageStarted

TASK = """
reset:
  cameras: {names: [workspace, wrist], views: {wrist: {values: [wrist_realistic]}}}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two short episodes; the wrist camera is slow, noisy and distorting."""
    out = tmp_path_factory.mktemp("recorded")
    config = RunConfig(
        purpose="test", keep="all", output_dir=str(out), task_config=TASK, image_width=64, image_height=48,
        max_steps=4, settle_ticks=1, segmentation=True,
    )  # fmt: skip
    try:
        graph = CoreGraph(out, policy=RandomPolicy())
    except SimError as error:
        pytest.skip(str(error))
    with graph:
        runner = EpisodeRunner(graph.ports, config)
        for index in range(2):
            runner.run_index(index)
    return out


def messages(bag: Path) -> list[tuple[str, int, str]]:
    """Return all messages but the episode's info, in a comparable form."""
    found = []
    for topic, stamp, message in BagReader(bag).messages():
        if topic != "/episode/info":
            found.append((topic, stamp, repr({k: np.asarray(v).tolist() for k, v in vars(message).items()})))
    return found


@pytest.mark.thorough
def test_unchanged_settings_give_the_same_bags(recorded: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    report = rerender(list_bags(recorded), tmp_path / "out", RerenderConfig(), workers=2, on_event=events.append)
    assert (report.made, report.there) == (2, 0)
    assert events[0] == StageStarted(title="rendering", total=12, unit="ticks")
    assert [event.done for event in events if isinstance(event, StageProgress)] == list(range(13))
    assert events[-1] == StageFinished()
    for bag in list_bags(recorded):
        again = tmp_path / "out" / "episodes" / bag.name
        assert check_bag(again).ok
        assert messages(again) == messages(bag)
        info, was = BagReader(again).info, BagReader(bag).info
        assert replace(info, config_json=was.config_json, rerendered_from="") == was
        assert info.rerendered_from == was.episode_id


def test_cameras_lights_and_size_change_and_nothing_else(recorded: Path, tmp_path: Path) -> None:
    bag = list_bags(recorded)[0]
    arguments = [
        str(bag), "--out", str(tmp_path / "out"), "--camera", "workspace=workspace_left", "--camera", "pose_1",
        "--size", "40x30", "--light", "evening", "--light", "{kind: lamp, shadow: false}",
        "--texture", "table=marble", "--background", "plain", "--depth", "--no-segmentation",
    ]  # fmt: skip
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert "1 episode rendered" in done.output
    assert (tmp_path / "out" / "first_episode.png").exists()
    old, new = BagReader(bag), BagReader(tmp_path / "out" / "episodes" / bag.name)
    assert check_bag(new.path).ok
    scene, was = new.info.scene, old.info.scene
    assert [(c.name, c.width, c.height, c.depth) for c in scene.cameras] == [
        ("workspace", 40, 30, True), ("pose_1", 40, 30, True),
    ]  # fmt: skip
    assert replace(scene, cameras=was.cameras, look=was.look) == was
    assert [light.kind for light in scene.look.lights] == ["sun", "lamp"]
    assert (scene.look.table.texture, scene.look.background) == ("marble", "plain")
    assert json.loads(new.info.recorded["cameras"]).keys() == {"workspace", "pose_1"}
    for a, b in zip(old.ticks(), new.ticks(), strict=True):
        assert (a.state, a.step) == (b.state, b.step)
        assert {name: image.shape for name, image in b.images.items()} == {
            "workspace": (30, 40, 3), "pose_1": (30, 40, 3),
        }  # fmt: skip
        assert b.depth.keys() == {"workspace", "pose_1"}
        assert not b.segmentation
    fixed, moving = (
        {transform.child_frame_id for transform in next(iter(new.messages([topic])))[2].transforms}
        for topic in ("/tf_static", "/tf")
    )
    assert {"panda_base", "workspace_optical", "pose_1_optical"} <= fixed
    assert "panda_hand" in moving
    assert not {"wrist_optical", "pose_1_optical"} & moving
    assert new.counts["/tf_static"] == new.counts["/robot_description"] == 1
    assert new.result == old.result


def test_an_interrupted_run_goes_on_and_another_is_refused(recorded: Path, tmp_path: Path) -> None:
    bags, config = list_bags(recorded), RerenderConfig(cameras={"workspace": ""})
    assert rerender(bags[:1], tmp_path / "out", config).made == 1
    whole = (tmp_path / "out" / "episodes" / bags[0].name / f"{bags[0].name}_0.mcap").stat().st_mtime_ns
    (tmp_path / "out" / ".partial" / bags[1].name).mkdir(parents=True)  # as a killed worker leaves it
    report = rerender(bags, tmp_path / "out", config)
    assert (report.made, report.there) == (1, 1)
    assert (tmp_path / "out" / "episodes" / bags[0].name / f"{bags[0].name}_0.mcap").stat().st_mtime_ns == whole
    assert len((tmp_path / "out" / "results.jsonl").read_text().splitlines()) == 2
    with pytest.raises(ConfigError, match="another configuration"):
        rerender(bags, tmp_path / "out", RerenderConfig(width=32, height=32))
    rerender(bags, tmp_path / "other", RerenderConfig(width=32, height=32))
    with pytest.raises(ConfigError, match=rf"out/episodes/{bags[0].name} is not the rendering of .*other/episodes"):
        rerender(list_bags(tmp_path / "other"), tmp_path / "out", config)


def test_impossible_requests_are_refused_before_rendering(recorded: Path, tmp_path: Path) -> None:
    bags = list_bags(recorded)
    with pytest.raises(ConfigError, match="workspace_left"):
        rerender(bags, tmp_path / "a", RerenderConfig(cameras={"workspace_lft": ""}))
    with pytest.raises(ConfigError, match="both recordings of episode"):
        rerender([bags[0], bags[0]], tmp_path / "a", RerenderConfig())
    with pytest.raises(ConfigError, match="marble"):
        RerenderConfig(textures={"table": "marbel"})
    with pytest.raises(ConfigError, match="no surface 'ceiling'"):
        RerenderConfig(textures={"ceiling": "wood"})
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_a_workers_error_ends_the_run_with_its_message(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="raster"):
        rerender(list_bags(recorded), tmp_path / "out", RerenderConfig(renderer="rastr"), workers=2)
    broken = tmp_path / "bag"
    broken.mkdir()
    with pytest.raises(RecorderError):
        rerender([broken], tmp_path / "b", RerenderConfig())
