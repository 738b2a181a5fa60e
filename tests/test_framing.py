"""The default camera and those of the rooms crop neither the hand nor an object at the start of any skill."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # of the benchmarks

from benchmarks.render.framing import SEEDS, SIDE, TASKS, Framing, room_views

from roboxim_core.vision.cameras import load_camera


@pytest.fixture(scope="module")
def framing():
    with Framing() as made:
        yield made


def crops(framing, task, index, cameras=()):
    scene, state = framing.start(task, index)
    default = [camera for camera in scene.cameras if camera.parent == "world"]
    return framing.cropped(scene, state, [*default, *cameras])


@pytest.mark.parametrize("task", ["pick_cube", "open_drawer"])
def test_the_hand_and_all_objects_are_in_the_picture(framing, task):
    assert crops(framing, task, 0) == []


def test_what_is_cropped_is_found(framing):
    near = replace(load_camera("workspace"), name="near")
    assert {(crop.thing, crop.edge) for crop in crops(framing, "pick_cube", 0, [near])} == {("hand", "top")}


@pytest.mark.thorough
@pytest.mark.parametrize("task", TASKS)
def test_no_scene_of_any_skill_is_cropped(framing, task):
    rooms = [] if task in SIDE else room_views("varied")
    assert {index: found for index in range(SEEDS) if (found := crops(framing, task, index, rooms))} == {}
