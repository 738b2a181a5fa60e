import numpy as np
import pytest
import trimesh

from roboxim_core.errors import ConfigError
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, RobotSpec, SceneSpec
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.roles import task_distractors
from roboxim_tasks.sampling.placement import Room, centre, footprint, grown, nearest_distance, overlap
from roboxim_tasks.skills.place_relation import aligning_yaws, half_extent
from roboxim_tasks.skills.placing import upright

QUAT = (0.18257418583505536, 0.3651483716701107, 0.5477225575051661, 0.7302967433402214)


def surface(library, entity):
    """Points on what an object collides with."""
    points = []
    for link in library.entity_model(entity).links:
        for shape in link.collision:
            if shape.kind == "box":
                mesh = trimesh.creation.box(shape.size)
            elif shape.kind == "sphere":
                mesh = trimesh.creation.icosphere(4, shape.size[0])
            else:
                make = trimesh.creation.cylinder if shape.kind == "cylinder" else trimesh.creation.capsule
                mesh = make(radius=shape.size[0], height=shape.size[1])
            found, _ = trimesh.sample.sample_surface(mesh, 4000, seed=1)
            points.append((entity.pose @ shape.pose).apply(found))
    return np.concatenate(points)


@pytest.mark.parametrize("model", ["cube", "apple", "soda_can", "cucumber", "banana", "mug"])
def test_the_nearest_distance_is_that_to_the_surface(library, model):
    entity = EntitySpec(name="thing", model=model, pose=Pose(position=(0.4, 0.1, 0.05), quat_xyzw=QUAT))
    points = surface(library, entity)
    for point in np.array([(0.5, 0.2, 0.1), (0.4, -0.1, 0.02), (0.1, 0.1, 0.3)]):
        brute = np.linalg.norm(points - point, axis=1).min()
        assert nearest_distance(entity, point, library) == pytest.approx(brute, abs=3e-3)
    assert nearest_distance(entity, points[0], library) == pytest.approx(0.0, abs=1e-3)


def test_a_footprint_grows_by_the_same_on_every_side(library):
    entity = EntitySpec(name="thing", model="sponge", pose=Pose(quat_xyzw=(0.0, 0.0, np.sin(0.3), np.cos(0.3))))
    corners = footprint(entity, library)
    larger = grown(corners, 0.04)
    for i in range(4):
        side, more = corners[i] - corners[i - 1], larger[i] - larger[i - 1]
        assert np.linalg.norm(more) == pytest.approx(np.linalg.norm(side) + 0.08)
        assert side[0] * more[1] == pytest.approx(side[1] * more[0])
    assert larger.mean(axis=0) == pytest.approx(corners.mean(axis=0))


NEAR = "reset: {distractors: {area: {lower: [0.3, -0.3], upper: [0.74, 0.3]}, near: {share: %g}}}\n"
THREE = "distractors: {minimum: 3, maximum: 3, models: {values: [cube, apple, soda_can, lemon]}}\n"


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_exactly_the_share_of_the_episodes_has_a_distractor_near_the_target(draw, library, share):
    config = parse_task_config(THREE + NEAR % share)
    near = []
    for index in range(20):
        drawn = draw(index, config)
        target = drawn.scene.entity("target")
        middle = centre(target, library)
        things = [drawn.scene.entity(thing.entity) for thing in task_distractors(drawn.task)]
        near.append(min(nearest_distance(thing, middle, library) for thing in things) <= 0.10)
        corners = footprint(target, library)
        assert not any(overlap(grown(footprint(thing, library), 0.0299), corners) for thing in things)
    assert sum(near) == 20 * share
    assert near != [True] * 10 + [False] * 10
    again = [draw(index, config, attempt=1) for index in range(3)]
    assert [near_target(d, library) for d in again] == near[:3]


def near_target(drawn, library):
    middle = centre(drawn.scene.entity("target"), library)
    things = [drawn.scene.entity(thing.entity) for thing in task_distractors(drawn.task)]
    return min(nearest_distance(thing, middle, library) for thing in things) <= 0.10


@pytest.mark.parametrize("model", ["bowl", "tray"])
def test_what_is_near_a_wide_target_is_near_its_edge(draw, library, model):
    wide = f"skill: pick_up\nobjects: {{target: {{models: {{values: [{model}]}}}}}}\n" + THREE + NEAR % 0.5
    config = parse_task_config(wide)
    near = []
    for index in range(20):
        drawn = draw(index, config)
        target = drawn.scene.entity("target")
        things = [drawn.scene.entity(thing.entity) for thing in task_distractors(drawn.task)]
        near.append(min(nearest_distance(target, centre(thing, library), library) for thing in things) <= 0.10)
        corners = footprint(target, library)
        assert not any(overlap(grown(footprint(thing, library), 0.0299), corners) for thing in things)
    assert sum(near) == 10


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (-1.0, 0.0)])
def test_a_wide_object_is_put_down_where_it_needs_least_room(library, yaw, direction):
    lying = Pose(quat_xyzw=(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))
    tray, along = library.object("tray"), np.array(direction)
    turns = aligning_yaws(tray, lying, along)
    reach = [half_extent(tray, upright(lying, (0.0, 0.0, 0.0), turn).rotation, along) for turn in turns]
    assert reach == pytest.approx([0.10, 0.14])
    assert max(map(abs, turns)) <= np.pi / 2 + 1e-9
    assert not aligning_yaws(library.object("cucumber"), lying, along)


def test_distractors_leave_the_room_that_the_skill_needs(draw, generator):
    config = parse_task_config("skill: rotate\nobjects: {target: {models: {values: [knife]}}}\n" + THREE + NEAR % 1.0)
    for index in range(8):
        draw(index, config)
        assert "free_to_turn" not in generator.last_reset.rejections
        assert generator.last_reset.draws <= 8


def test_near_is_checked_when_it_is_read():
    for near in ("{share: 2}", "{distance_m: 0}", "{gap_m: -1}"):
        with pytest.raises(ConfigError, match="near needs"):
            parse_task_config(f"reset: {{distractors: {{near: {near}}}}}")


@pytest.mark.parametrize("name", ["pick_up", "place_on", "rotate", "place_behind", "push_button"])
def test_the_shipped_tasks_ask_for_half_the_episodes_over_a_large_area(name):
    config = load_task_config(name)
    area = config.reset["objects"].area
    assert config.reset["distractors"].near.share == 0.5
    assert np.all(np.subtract(area.upper, area.lower) >= (0.3999, 0.4999))


def test_objects_stay_off_the_stand_of_an_arm(library):
    moved = Pose(position=(0.1, 0.2, 0.0))
    cube = EntitySpec(name="thing", model="cube", pose=Pose(position=(0.3, 0.2, 0.0225)))
    beside = EntitySpec(name="thing", model="cube", pose=Pose(position=(0.45, 0.2, 0.0225)))
    for robot, expected in (("widowx_ai", "overlaps"), ("panda", "")):
        scene = SceneSpec(robot=RobotSpec(model=robot, pose=moved))
        room = Room.of(scene, library, 0.04)
        assert room.refusal(cube) == expected, "the stand covers x from 0.24 to 0.36"
        assert room.refusal(beside) == ""
