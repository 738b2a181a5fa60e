from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, ErrorCode, TaskError
from roboxim_core.models.visuals import drawn_entities
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.visible import Visibility


class FakeSegmentation:
    """A renderer that shows every object whole, except for the target in the first `hidden` scenes."""

    def __init__(self, hidden=0, of_target=0):
        self.hidden, self.of_target, self.scenes = hidden, of_target, []

    def segment(self, scene, state):
        self.scenes.append(scene)
        names = drawn_entities(scene)
        images = {}
        for camera in scene.cameras:
            image = np.zeros((camera.height, camera.width), np.uint16)
            for row, name in enumerate(names):
                short = name == "target" and len(self.scenes) <= self.hidden
                image[row, : self.of_target if short else 100] = row + 1
            images[camera.name] = image
        return images


def generator(library, segmentation):
    return EpisodeGenerator(library, visibility=Visibility(segmentation))


@pytest.mark.parametrize(("seen", "config"), [(49, "{}"), (79, "{share: 0.8}"), (69, "{share: 0, pixels: 70}")])
def test_a_scene_that_hides_the_target_is_drawn_again(library, seed_path, seen, config):
    task = parse_task_config(f"visible: {config}")
    made = generator(library, FakeSegmentation(2, seen))
    drawn = made.draw(seed_path(1), task)
    assert made.last_reset.rejections["target_visible"] == 2
    assert generator(library, FakeSegmentation(2, seen + 1)).draw(seed_path(1), task) != drawn


def test_a_target_that_is_never_seen_makes_the_reset_infeasible(library, seed_path):
    few = replace(load_task_config("pick_cube"), max_draws=3)
    with pytest.raises(TaskError, match="in 3 draws: constraint target_visible refused most") as error:
        generator(library, FakeSegmentation(3)).draw(seed_path(1), few)
    assert error.value.code == ErrorCode.RESET_INFEASIBLE


def test_only_cameras_that_are_fixed_in_the_world_must_see(library, seed_path):
    for text in (
        "reset: {cameras: {names: [wrist]}}", "reset: {cameras: {names: []}}", "visible: {cameras: []}",
    ):  # fmt: skip
        segmentation = FakeSegmentation(100)
        assert generator(library, segmentation).draw(seed_path(1), parse_task_config(text)).task.instruction
        assert not segmentation.scenes
    two = FakeSegmentation()
    text = "reset: {cameras: {names: [workspace, wrist, workspace_left]}}\n"
    generator(library, two).draw(seed_path(1), parse_task_config(text))
    assert [camera.name for camera in two.scenes[0].cameras][:2] == ["workspace", "workspace_left"]
    generator(library, two).draw(seed_path(1), parse_task_config(text + "visible: {cameras: [workspace_left]}"))
    assert [camera.name for camera in two.scenes[1].cameras][:1] == ["workspace_left"]
    with pytest.raises(ConfigError, match="'wrist'.*workspace"):
        generator(library, two).draw(seed_path(1), parse_task_config(text + "visible: {cameras: [wrist]}"))
    with pytest.raises(ConfigError, match="share"):
        parse_task_config("visible: {share: 1.5}")


def test_every_object_of_the_instruction_is_looked_for_and_the_picture_stays_small(library, seed_path):
    segmentation = FakeSegmentation()
    generator(library, segmentation).draw(seed_path(1), load_task_config("place_on"))
    (scene,) = segmentation.scenes
    view, *alone = scene.cameras
    assert {"target alone", "support alone"} <= {entity.name for entity in scene.entities}
    assert len(alone) == 2
    assert max(view.width, view.height) == 128
    assert view.matrix[0] == alone[0].matrix[0]
    assert not view.depth
    assert not scene.look.lights
