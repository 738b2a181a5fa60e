"""Joints of objects, cavities, and factors on mass and friction, in physics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pybullet
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import hold_action
from roboxim_core.config import from_json, to_json
from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import JointModel, LinkModel, ObjectModel, Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, Scalar, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_sim.bodies import ObjectBody
from roboxim_sim.bullet import BulletClient
from roboxim_sim.snapshots import Snapshot
from roboxim_sim.world import World

LIBRARY = ModelLibrary()


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with World(LIBRARY) as made:
        yield made


def cabinet(**joints: float) -> EntitySpec:
    turned = Rotation.from_euler("z", 180, degrees=True)
    pose = Pose.from_arrays((0.75, 0.0, LIBRARY.object("cabinet").rest_height), turned)
    return EntitySpec(name="cabinet", model="cabinet", pose=pose, joint_positions=joints, fixed=True)


def standing(name: str, model: str, x: float, y: float, **modifiers: Scalar) -> EntitySpec:
    height = LIBRARY.object(model, modifiers).rest_height
    return EntitySpec(name=name, model=model, modifiers=modifiers, pose=Pose(position=(x, y, height)))


def hold(world: World, ticks: int) -> StateRecord:
    for _ in range(ticks):
        record = world.tick(world.record.seq + 1, hold_action(1.0))
    return record


def push(world: World, entity: str, link: int, force: tuple[float, float, float], steps: int) -> None:
    """Push a link with a force in the world for some physics steps."""
    body = next(body for body in world.physics.objects if body.name == entity)
    for _ in range(steps):
        at = world.physics.client.getLinkState(body.id, link)[0]
        world.physics.client.applyExternalForce(body.id, link, force, at, pybullet.WORLD_FRAME)
        world.physics.advance(1, world.record.robot.joint_commands)


def test_a_drawer_stays_where_it_is_and_reports_its_joint(world: World) -> None:
    record = world.load(SceneSpec(entities=(cabinet(top=0.12, bottom=0.05),)), "e")
    entity = record.entity("cabinet")
    assert entity.joint_names == ("top", "middle", "bottom")
    assert entity.joint_positions == pytest.approx((0.12, 0.0, 0.05), abs=1e-3)
    entity = hold(world, 10).entity("cabinet")
    assert entity.joint_positions == pytest.approx((0.12, 0.0, 0.05), abs=1e-3)
    for lowest, now, highest in zip(entity.joint_lowest, entity.joint_positions, entity.joint_highest, strict=True):
        assert lowest <= now <= highest
    assert world.body_poses()["cabinet/top_drawer"].position == pytest.approx((0.63, 0.0, 0.292), abs=2e-3)


@pytest.mark.parametrize(("force_n", "opens"), [(2.5, False), (8.0, True)])
def test_a_drawer_gives_way_to_more_than_its_resistance_and_no_other_moves(
    world: World, force_n: float, opens: bool
) -> None:
    world.load(SceneSpec(entities=(cabinet(),)), "e")
    push(world, "cabinet", 0, (-force_n, 0.0, 0.0), 120)
    record = hold(world, 1)
    positions = record.entity("cabinet").joint_positions
    assert (positions[0] > 0.05) is opens
    assert positions[1:] == pytest.approx((0.0, 0.0), abs=1e-3)
    after = hold(world, 10).entity("cabinet").joint_positions
    assert after[0] == pytest.approx(positions[0], abs=2e-3)


def test_a_drawer_stops_at_its_ends(world: World) -> None:
    world.load(SceneSpec(entities=(cabinet(middle=0.1),)), "e")
    push(world, "cabinet", 1, (-30.0, 0.0, 0.0), 120)
    assert hold(world, 1).entity("cabinet").joint_positions[1] == pytest.approx(0.15, abs=2e-3)
    push(world, "cabinet", 1, (30.0, 0.0, 0.0), 180)
    assert hold(world, 1).entity("cabinet").joint_positions[1] == pytest.approx(0.0, abs=2e-3)


def test_a_button_springs_back_and_the_record_keeps_the_press(world: World) -> None:
    button = replace(standing("button", "button", 0.5, 0.0), fixed=True)
    world.load(SceneSpec(entities=(button,)), "e")
    assert world.record.entity("button").joint_positions[0] == pytest.approx(0.0, abs=5e-4)
    push(world, "button", 0, (0.0, 0.0, -2.0), 60)
    assert hold(world, 1).entity("button").joint_highest[0] < 0.003
    world.set_entity_state("button", joint_positions={"press": 0.011})
    pressed = hold(world, 1).entity("button")
    assert pressed.joint_highest[0] > 0.009
    after = hold(world, 3).entity("button")
    assert after.joint_positions[0] == pytest.approx(0.0, abs=5e-4)
    assert after.joint_highest[0] < 0.001


@pytest.mark.parametrize("container", ["bowl", "mug"])
def test_objects_that_fall_into_a_cavity_stay_inside(world: World, container: str) -> None:
    model = LIBRARY.object(container)
    interior = next(region for region in model.regions if region.kind == "interior")
    ball = standing("ball", "cube", 0.5, 0.0, scale=0.6)
    above = Pose(position=(0.5, 0.0, model.rest_height + interior.pose.position[2] + interior.size[2] + 0.03))
    scene = SceneSpec(entities=(standing("container", container, 0.5, 0.0), replace(ball, pose=above)))
    world.load(scene, "e")
    record = hold(world, 15)
    inside = record.entity("container").pose.inverse() @ record.entity("ball").pose
    assert np.hypot(*inside.position[:2]) < interior.size[0] / 2
    assert inside.position[2] < interior.pose.position[2] + interior.size[2]
    assert not record.contacts_between("ball", "table")


def test_mass_and_friction_take_effect(world: World) -> None:
    heavy = standing("heavy", "cube", 0.4, -0.2, mass=3.0)
    slippery = standing("slippery", "cube", 0.4, 0.0, friction=0.25)
    usual = standing("usual", "cube", 0.4, 0.2)
    record = world.load(SceneSpec(entities=(heavy, slippery, usual)), "e")
    weights = {name: record.contacts_between(name, "table")[0].force_last for name in ("heavy", "usual")}
    assert weights["heavy"] == pytest.approx(3 * weights["usual"], rel=0.03)
    for name in ("slippery", "usual"):
        world.set_entity_state(name, record.entity(name).pose, linear_velocity=(0.4, 0.0, 0.0))
    slid = hold(world, 10)
    way = {
        name: slid.entity(name).pose.position[0] - record.entity(name).pose.position[0]
        for name in ("slippery", "usual")
    }
    assert way["slippery"] > 2.5 * way["usual"] > 0.0


def test_round_objects_roll_to_a_stop(world: World) -> None:
    world.load(SceneSpec(entities=(standing("cucumber", "cucumber", 0.5, 0.0),)), "e")
    world.set_entity_state("cucumber", linear_velocity=(0.0, 0.08, 0.0), pose=world.record.entity("cucumber").pose)
    record = hold(world, 25)
    assert np.linalg.norm(record.entity("cucumber").linear_velocity) < 0.01
    assert abs(record.entity("cucumber").pose.position[1]) < 0.25


def test_an_approximate_restore_keeps_drawers_open(world: World) -> None:
    world.load(SceneSpec(entities=(cabinet(),)), "e")
    world.set_entity_state("cabinet", joint_positions={"bottom": 0.1})
    snapshot = from_json(to_json(world.snapshot()), Snapshot)
    restored = world.restore(snapshot, approximate=True)
    assert restored.entity("cabinet").joint_positions[2] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_an_axis_of_any_length_moves_a_part_alike_in_physics_and_pictures(kind: str) -> None:
    box = (Shape(kind="box", size=(0.1, 0.1, 0.1)),)
    joint = JointModel(name="j", kind=kind, parent="a", child="b", axis=(1.0, 2.0, -3.0), lower=-1.0, upper=1.0)
    links = (LinkModel(name="a", mass=1.0, collision=box), LinkModel(name="b", mass=1.0, collision=box))
    model = ObjectModel(id="o", name="o", links=links, joints=(joint,), size=(0.1, 0.1, 0.1), rest_height=0.05)
    client = BulletClient()
    try:
        body = ObjectBody(client, model, EntitySpec(name="o", model="o", pose=Pose(), joint_positions={"j": 0.3}))
        place, quat = client.getLinkState(body.id, 0, computeForwardKinematics=True)[4:6]
    finally:
        client.disconnect()
    drawn = object_link_poses(model, {"j": 0.3})["b"]
    assert place == pytest.approx(drawn.position, abs=1e-6)
    assert abs(np.dot(quat, drawn.quat_xyzw)) == pytest.approx(1.0, abs=1e-6)


def test_an_axis_without_direction_is_refused() -> None:
    with pytest.raises(ConfigError, match="joint 'j': axis has no direction, got 0 0 0"):
        JointModel(name="j", kind="prismatic", parent="a", child="b", axis=(0.0, 0.0, 0.0))
