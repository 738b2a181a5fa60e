"""Reset components of what a scene looks like: cameras, lights, surfaces, background."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from roboxim_core.errors import ConfigError
from roboxim_core.vision.cameras import load_camera
from roboxim_core.vision.textures import pixels
from roboxim_tasks.config import load_task_config, parse_task_config

VIEWS = """
reset:
  cameras:
    names: [workspace, wrist]
    views: {workspace: {values: [workspace_left, workspace_front, workspace_right], order: in_order}}
"""
NOISY = """
reset:
  cameras:
    names: [workspace]
    views: {workspace: {values: [wrist_realistic]}}
    exposure_ev: {workspace: {lower: -0.5, upper: 0.5}}
"""


def test_a_camera_is_drawn_from_named_views_under_one_name(draw) -> None:
    config = parse_task_config(VIEWS)
    for index, view in enumerate(["workspace_left", "workspace_front", "workspace_right", "workspace_left"]):
        camera = draw(index, config).scene.cameras[0]
        assert camera == replace(load_camera(view), name="workspace")
    assert draw(1, config).scene.entities == draw(1, parse_task_config("")).scene.entities


def test_noise_is_seeded_by_the_episode_and_exposure_varies(draw) -> None:
    config = parse_task_config(NOISY)
    cameras = [draw(index, config).scene.cameras[0] for index in range(4)]
    assert len({camera.noise.seed for camera in cameras}) == 4
    assert all(-0.5 <= camera.noise.exposure_ev <= 0.5 for camera in cameras)
    assert len({camera.noise.exposure_ev for camera in cameras}) == 4
    assert cameras[2] == draw(2, config).scene.cameras[0]


def test_everything_that_a_picture_shows_varies_and_is_in_the_scene(draw) -> None:
    config = load_task_config("pick_cube_randomised")
    looks = [draw(index, config).scene.look for index in range(30)]
    assert {len(look.lights) for look in looks} == {1, 2, 3}
    assert {look.background for look in looks} == {"room", "plain"}
    assert len({look.table.texture for look in looks}) > 3
    assert len({look.backdrop for look in looks}) == 30
    for key in ("direction", "color", "intensity", "radius"):
        assert len({getattr(look.lights[0], key) for look in looks}) == 30
    lamps = [light for look in looks for light in look.lights[1:]]
    assert {lamp.kind for lamp in lamps} == {"lamp"}
    assert not any(lamp.shadow for lamp in lamps)
    assert np.ptp([lamp.position for lamp in lamps], axis=0).min() > 0.5


def test_more_lamps_leave_the_main_light_as_it_was(draw) -> None:
    text = "reset: {lights: {intensity: {lower: 1, upper: 3}, lamps: {number: {values: [%d]}}}}"
    one, many = (draw(3, parse_task_config(text % number)).scene.look.lights for number in (1, 3))
    assert one[0] == many[0]
    assert one[1] == many[1]
    assert len(many) == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reset: {background: {kind: {values: [beach]}}}", "no background 'beach'"),
        ("reset: {lights: {lamps: {number: {values: [9]}}}}", "lamps.number.*must be 0..3"),
        ("reset: {cameras: {views: {workspace: {values: [workspace_lft]}}}}", "workspace_left"),
        ("reset: {cameras: {views: {top: {values: [wrist]}}}}", "'top', which is not used"),
        ("reset: {cameras: {names: [workspac]}}", "workspace"),
    ],
)
def test_a_wrong_look_is_refused_before_anything_runs(text, message) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_task_config(text)


def test_ordered_lists_go_by_the_number_in_the_cell_in_every_component(draw) -> None:
    mix = parse_task_config(
        """
cells:
  - {tasks: [pick_up, rotate], episodes: 4}
set:
  distractors: {minimum: 0, maximum: 0}
  reset:
    lights: {intensity: {values: [1.0, 2.0], order: in_order}}
    background: {kind: {values: [room, plain], order: in_order}}
    surfaces: {table: {roughness: {values: [0.1, 0.9], order: in_order}}}
    physics: {table_friction: {values: [0.5, 0.8], order: in_order}}
    cameras: {views: {workspace: {values: [workspace_left, workspace_right], order: in_order}}}
    objects: {yaw_rad: {values: [0.0, 1.0], order: in_order}}
"""
    )
    of = {"pick_up": [], "rotate": []}
    for index in range(8):
        scene = draw(index, mix).scene
        (view,) = (camera.pose for camera in scene.cameras if camera.name == "workspace")
        yaw = 2 * math.asin(scene.entity("target").pose.quat_xyzw[2])
        look = (scene.look.lights[0].intensity, scene.look.background, scene.look.table.roughness)
        of[mix.at(index)[0].skill].append((*look, scene.table.friction, view, round(yaw, 6)))
    for drawn in of.values():
        assert drawn[:2] == drawn[2:]
        assert all(first != second for first, second in zip(*drawn[:2], strict=True))


def test_a_camera_that_the_task_varies_keeps_its_place_under_a_look(draw) -> None:
    """Looks place it elsewhere; a drawn shift that is not applied would be a false value to group by."""
    shift = "{workspace: {lower: [0.05, 0.05, 0.05], upper: [0.1, 0.1, 0.1]}}"
    cameras = f"cameras: {{names: [workspace], shift_m: {shift}, exposure_ev: {{workspace: {{lower: 1, upper: 2}}}}}}"
    alone, under = (
        draw(0, parse_task_config(f"reset: {{{looks}{cameras}}}")) for looks in ("", "look: {set: varied}, ")
    )
    assert under.task.drawn["look"]
    assert under.scene.cameras == alone.scene.cameras
    assert under.scene.cameras[0].noise.exposure_ev == pytest.approx(
        float(under.task.drawn["camera.workspace.exposure_ev"]), abs=0.01
    )


def test_images_of_textures_are_relative_to_the_file_that_names_them(draw, tmp_path, monkeypatch) -> None:
    own = tmp_path / "config #2"
    for name in ("tasks", "scenes", "looks", "objects"):
        (own / name).mkdir(parents=True)
        Image.new("RGB", (2, 2), (0, 200, 0)).save(own / name / "green.png")
    (own / "scenes" / "green.yaml").write_text("look: {table: {texture: ./green.png}}\n")
    (own / "looks" / "green.yaml").write_text("looks: {only: {table: {texture: green.png}}}\n")
    surface = "reset: {surfaces: {table: {texture: {values: [../tasks/green.png]}}}}\n"
    for name, text in (("own", surface), ("by_look", "reset: {look: {set: green}}\n"), ("by_scene", "scene: green\n")):
        (own / "tasks" / f"{name}.yaml").write_text(f"skill: pick_up\n{text}")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(own))
    monkeypatch.chdir(tmp_path)
    for name, folder in (("own", "tasks"), ("by_look", "looks"), ("by_scene", "scenes")):
        texture = draw(0, load_task_config(name)).scene.look.table.texture
        assert texture == f"config://{folder}/green.png", "the same wherever the folder lies"
        assert pixels(texture)[0, 0].tolist() == [0, 194, 0]
    loose = tmp_path / "loose.yaml"
    far = surface.replace("../tasks/green.png", "'./config #2/tasks/green.png'")
    loose.write_text(far)
    assert draw(0, load_task_config(str(loose))).scene.look.table.texture == "config://tasks/green.png"
    monkeypatch.delenv("ROBOXIM_CONFIG_PATH")
    assert draw(0, load_task_config(str(loose))).scene.look.table.texture == str(own / "tasks" / "green.png")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(own))
    (own / "tasks" / "own.yaml").write_text(f"skill: pick_up\n{surface.replace('green', 'red')}")
    with pytest.raises(ConfigError, match=r"texture: no such file: .*/tasks/red.png"):
        load_task_config("own")
