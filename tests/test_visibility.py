"""Visibility of the objects that an instruction names, with real renderers, in scenes with known visibility."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_bringup.cores import CoreSegmentation
from roboxim_core.errors import RoboximError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import drawn_entities, render_world
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraSpec, EntitySpec, LookSpec, PhysicalObject, SceneSpec, TaskSpec
from roboxim_tasks.config import load_task_config
from roboxim_tasks.demonstration.solvable import state_at_rest
from roboxim_tasks.ports import SegmentationClient
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.visible import Visibility
from roboxim_tasks.task_config import VisibleConfig

DOWN = Pose(position=(0.5, 0.0, 1.0), quat_xyzw=(0.7071067811865476, -0.7071067811865476, 0.0, 0.0))
"""From one metre above the table, looking down; the image's right is the world's -y."""
ABOVE = CameraSpec(name="above", width=256, height=256, fov_y_rad=0.6, pose=DOWN)
FOLDED = (0.0, -1.5, 0.0, -2.9, 0.0, 1.6, 0.785)
"""The arm retracted, outside every image."""


@pytest.fixture(scope="module")
def library():
    return ModelLibrary()


@pytest.fixture(scope="module")
def segmentation(library):
    made = CoreSegmentation(library)
    yield made
    made.close()


@pytest.fixture(scope="module")
def look(library, segmentation):
    arm = ArmKinematics(library.robot("panda"))

    def through(camera, *entities, joints=FOLDED, renderer=segmentation):
        robot = replace(SceneSpec().robot, joint_positions=joints)
        scene = SceneSpec(entities=entities, cameras=(camera,), robot=robot)
        task = TaskSpec(
            skill="pick_up", instruction="", objects={"target": PhysicalObject(entity="target", model="", name="")}
        )
        (sight,) = Visibility(renderer).look(task, scene, state_at_rest(scene, arm))
        return sight

    return through


def at(x, y, z=0.0225, name="target", model="cube"):
    return EntitySpec(name=name, model=model, pose=Pose(position=(x, y, z)))


def test_a_cube_seen_from_above_has_the_pixels_of_its_top(look):
    sight = look(ABOVE, at(0.5, 0.0))
    side_px = 0.045 * 128 / 2 / np.tan(0.3) / (1.0 - 0.045)
    assert sight.pixels == sight.whole == pytest.approx(side_px**2, rel=0.15)


def test_an_occluder_reduces_the_visible_silhouette(look):
    roof = at(0.5, 0.0225, z=0.2, name="roof", model="tray")
    beside = replace(roof, pose=Pose(position=(0.5 + 0.14, 0.0, 0.2)))
    assert look(ABOVE, at(0.5, 0.0), roof).pixels == 0
    half = look(ABOVE, at(0.5, 0.0), beside)
    assert 0.3 < half.share < 0.75
    assert half.whole == look(ABOVE, at(0.5, 0.0)).whole


def test_parts_outside_the_image_reduce_the_visible_silhouette(look):
    edge = np.tan(0.3) * (1.0 - 0.0225)
    assert look(ABOVE, at(0.5, 0.0)).share == 1.0
    assert look(ABOVE, at(0.5, edge)).share == pytest.approx(0.5, abs=0.2)
    assert look(ABOVE, at(0.5, edge + 0.05)).pixels == 0


def test_the_arm_hides_what_is_behind_it(look, library):
    home = library.robot("panda").home
    x, y, _ = ArmKinematics(library.robot("panda")).fk(home).position
    assert look(replace(ABOVE, fov_y_rad=0.9), at(x, y), joints=home).share < 0.5
    assert look(replace(ABOVE, fov_y_rad=0.9), at(x, y), joints=FOLDED).share == 1.0


@pytest.mark.parametrize(("model", "height"), [("knife", 0.01), ("mug", 0.045), ("spoon", 0.007), ("button", 0.03)])
def test_another_renderer_sees_the_same(look, library, model, height):
    camera = replace(ABOVE, fov_y_rad=0.5)
    thing, tiny = at(0.5, 0.02, height, model=model), CoreSegmentation(library, "tiny")
    ours, theirs = look(camera, thing), look(camera, thing, renderer=tiny)
    tiny.close()
    assert ours.pixels == pytest.approx(theirs.pixels, rel=0.12)
    assert ours.whole == pytest.approx(theirs.whole, rel=0.12)


def test_the_ids_of_the_segmentation_are_those_of_the_renderers_world(library):
    entities = (at(0.5, 0.0), at(0.6, 0.1, 0.18, name="other", model="cabinet"))
    for background in ("room", "plain"):
        scene = SceneSpec(entities=entities, look=LookSpec(background=background))
        assert drawn_entities(scene) == render_world(scene, library).entity_names


def test_a_scene_drawn_with_a_visibility_check_shows_its_objects(library, segmentation):
    config = load_task_config("place_on")
    seeing, blind = EpisodeGenerator(library, visibility=Visibility(segmentation)), EpisodeGenerator(library)
    arm = ArmKinematics(library.robot("panda"))
    refused = 0
    for index in range(60):
        seed = SeedPath(run_seed=5, purpose="test", index=index)
        drawn, least = seeing.draw(seed, config), VisibleConfig()
        sights = Visibility(segmentation).look(drawn.task, drawn.scene, state_at_rest(drawn.scene, arm))
        assert {(sight.camera, sight.entity) for sight in sights} == {("workspace", "target"), ("workspace", "support")}
        assert all(sight.share >= least.share and sight.pixels >= least.pixels for sight in sights)
        names = {name for name in seeing.last_reset.rejections if name.endswith("_visible")}
        assert names <= {"target_visible", "support_visible"}
        refused += bool(names)
        assert bool(names) <= (blind.draw(seed, config).scene != drawn.scene)
        if index > 8 and refused:
            break
    assert refused, "none of the scenes had to be drawn again: the test shows nothing"


@pytest.mark.ros
def test_the_sim_nodes_service_agrees_with_the_cores(graph, library, segmentation):
    arm = ArmKinematics(library.robot("panda"))
    things = (at(0.5, 0.1), at(0.45, -0.1, 0.045, "mug", "mug"))
    robot = replace(SceneSpec().robot, joint_positions=FOLDED)
    scene = SceneSpec(entities=things, cameras=(replace(ABOVE, segmentation=True),), robot=robot)
    state = state_at_rest(scene, arm)
    with graph.clients() as clients:
        answer = SegmentationClient(clients, "raster", 60.0).segment(scene, state)
        with pytest.raises(RoboximError, match="unknown renderer 'rastr'"):
            SegmentationClient(clients, "rastr", 60.0).segment(scene, state)
    assert np.array_equal(answer["above"], segmentation.segment(scene, state)["above"])
    assert {5, 6} <= set(np.unique(answer["above"]).tolist())
