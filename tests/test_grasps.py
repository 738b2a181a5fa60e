"""A floating gripper executes every annotated grasp: it closes and lifts, and the object must come along."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_runs.assets.floating_hand import FloatingHand, try_grasp
from roboxim_sim import bodies
from roboxim_sim.bullet import BulletClient

LIBRARY = ModelLibrary()


@pytest.fixture(scope="module")
def client() -> Iterator[BulletClient]:
    made = BulletClient()
    yield made
    made.disconnect()


@pytest.mark.slow
@pytest.mark.parametrize("object_id", LIBRARY.known_objects)
def test_every_grasp_of_every_size_holds(object_id: str, client: BulletClient) -> None:
    sizes = LIBRARY.object_modifiers(object_id).get("size")
    failed = {}
    for size in sizes.factors if sizes else [""]:
        model = LIBRARY.object(object_id, {"size": size} if size else {})
        for number, grasp in enumerate(model.grasps):
            failed[size, grasp.name, number] = try_grasp(client, model, grasp)
    assert not {grasp: why for grasp, why in failed.items() if why}


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("part", ["top", "middle", "bottom"])
def test_a_handle_opens_and_closes_its_drawer(part: str, index: int, client: BulletClient) -> None:
    model = LIBRARY.object("cabinet")
    handle = next(handle for handle in model.handles if handle.name == part)
    grasp = handle.grasps[index]
    bodies.configure(client, 240.0)
    names = bodies.build_table(client, TableSpec())
    pose = Pose(position=(0.4, 0.0, model.rest_height))
    cabinet = bodies.ObjectBody(client, model, EntitySpec(name="it", model="cabinet", pose=pose, fixed=True))
    gripper = FloatingHand(client, pose @ object_link_poses(model, {})[grasp.link] @ grasp.pose, grasp.opening_m)
    table = next(body for body, what in names.items() if what == "table")
    assert not gripper.inside(cabinet.id)
    assert not gripper.inside(table)
    out = (pose.rotation * handle.pose.rotation).apply([0.13, 0.0, 0.0])
    gripper.run(0.4, 0.0)
    gripper.run(1.5, 0.0, tuple(out))
    others = [k for k, name in enumerate(cabinet.joint_names) if name != handle.joint]
    own = cabinet.joint_names.index(handle.joint)
    assert cabinet.read_joints()[0][own] > 0.11
    assert max(cabinet.read_joints()[0][k] for k in others) < 0.01
    gripper.run(1.5, 0.0, tuple(-out))
    assert cabinet.read_joints()[0][own] < 0.02
