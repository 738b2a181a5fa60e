"""The planner sees drawers where the simulation has them."""

from __future__ import annotations

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import hold_action
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import PlanningScene
from roboxim_sim.world import World

LIBRARY = ModelLibrary()
DOWN = Rotation.from_euler("x", 180, degrees=True)


@pytest.fixture(scope="module")
def world():
    with World(LIBRARY) as made:
        yield made


@pytest.fixture(scope="module")
def planner():
    return Planner(LIBRARY.robot("panda"))


def cabinet(**joints):
    turned = Rotation.from_euler("z", 180, degrees=True)
    pose = Pose.from_arrays((0.72, 0.0, LIBRARY.object("cabinet").rest_height), turned)
    return SceneSpec(
        entities=(EntitySpec(name="cabinet", model="cabinet", pose=pose, joint_positions=joints, fixed=True),)
    )


@pytest.mark.parametrize(("drawer", "height_m"), [("top", 0.30), ("middle", 0.19)])
def test_a_drawer_blocks_the_arm_where_it_is_open(world, planner, drawer, height_m):
    in_front = Pose.from_arrays((0.525, 0.0, height_m), DOWN)
    for opening, blocked in ((0.0, False), (0.12, True)):
        scene = cabinet(**{drawer: opening})
        state = world.load(scene, "e")
        seen = PlanningScene.from_state(scene, state, LIBRARY)
        joints = planner.inverse_kinematics(in_front, LIBRARY.robot("panda").home)[0]
        finding = planner.check_state(seen, joints)
        touched = {contact.body_b for contact in finding.contacts} | {c.body_a for c in finding.contacts}
        assert ("cabinet" in touched) is blocked, finding


def test_the_planner_moves_with_a_drawer_that_moved_in_the_episode(world, planner):
    scene = cabinet()
    world.load(scene, "e")
    world.set_entity_state("cabinet", joint_positions={"top": 0.12})
    state = world.tick(1, hold_action(1.0))
    seen = PlanningScene.from_state(scene, state, LIBRARY)
    joints = planner.inverse_kinematics(Pose.from_arrays((0.525, 0.0, 0.30), DOWN), LIBRARY.robot("panda").home)[0]
    assert not planner.check_state(seen, joints).valid
    body = next(body for body in seen.bodies if body.name == "cabinet")
    front = min(float((body.pose @ shape.pose).position[0]) for shape in body.shapes)
    assert front == pytest.approx(0.72 - 0.1255 - 0.12, abs=5e-3)
