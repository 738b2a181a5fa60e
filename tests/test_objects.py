"""Contract of every object: its file agrees with physics, rendering and the gripper."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pybullet
import pytest

from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.check import check_object
from roboxim_core.models.description import ObjectModel, Visual
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import visual_parts
from roboxim_core.poses import Array, Pose, distance
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_core.vision.textures import TEXTURES
from roboxim_sim.bodies import ObjectBody, build_table, configure
from roboxim_sim.bullet import BulletClient
from roboxim_sim.rendering import textures  # registers the room's

LIBRARY = ModelLibrary()
SHAPES, TOOLS = LIBRARY.object_sets["shapes"], LIBRARY.object_sets["tools"]
MAX_TRIANGLES = 1500
VISUAL_TOLERANCE_M = 0.015
"""A stem or a leaf may protrude from the collision shapes."""
BY_HAND_M, IMPORTED_M = (2e-3, 1e-3), (3.5e-3, 2e-3)
"""How far a visual may reach below its collision shapes, and an object move from its stated rest pose within a second:
of an object made by hand, and of an imported one, whose few convex parts are not exact [m]."""

each_object = pytest.mark.parametrize(
    "object_id",
    [
        *LIBRARY.object_ids,
        *TOOLS,
        *(
            pytest.param(name, marks=pytest.mark.slow if number % 10 else pytest.mark.thorough)
            for number, name in enumerate(SHAPES)
        ),
    ],
)


@pytest.fixture(scope="module")
def client() -> Iterator[BulletClient]:
    made = BulletClient()
    yield made
    made.disconnect()


def tolerances(object_id: str) -> tuple[float, float]:
    """Return how far the visual may reach below the collision shapes, and the object move [m]."""
    return IMPORTED_M if object_id in SHAPES else BY_HAND_M


def collision_points(model: ObjectModel) -> Array:
    links = object_link_poses(model, {})
    points = []
    for link in model.links:
        for shape in link.collision:
            seen = Visual(kind=shape.kind, size=shape.size, mesh=shape.mesh, scale=(shape.scale,) * 3, pose=shape.pose)
            points += [links[link.name].apply(part.mesh.vertices) for part in visual_parts(seen)]
    return np.concatenate(points)


def test_the_objects_that_tasks_speak_of_are_there() -> None:
    assert {"cube", "apple", "soda_can", "onion", "cucumber", "knife", "plate", "button", "cabinet", "bowl"} <= set(
        LIBRARY.object_ids
    )
    assert len(LIBRARY.object_ids) >= 16
    named = (*LIBRARY.object_ids, *TOOLS)
    assert len({LIBRARY.object(i).name for i in named}) == len(named)


@each_object
def test_size_and_rest_height_are_those_of_the_collision_shapes(object_id: str) -> None:
    model = LIBRARY.object(object_id)
    points = collision_points(model)
    assert -points[:, 2].min() == pytest.approx(model.rest_height, abs=5e-4)
    assert np.ptp(points[:, 2]) == pytest.approx(model.size[2], abs=1e-3)
    assert 2 * np.abs(points[:, :2]).max(axis=0) == pytest.approx(model.size[:2], abs=1e-3)


@each_object
def test_visual_and_collision_shapes_agree(object_id: str) -> None:
    model = LIBRARY.object(object_id)
    links = object_link_poses(model, {})
    parts = [(link.name, part) for link in model.links for visual in link.visual for part in visual_parts(visual)]
    seen = np.concatenate([links[name].apply(part.mesh.vertices) for name, part in parts])
    solid = collision_points(model)
    assert seen.min(axis=0) == pytest.approx(solid.min(axis=0), abs=VISUAL_TOLERANCE_M)
    assert seen.max(axis=0) == pytest.approx(solid.max(axis=0), abs=VISUAL_TOLERANCE_M)
    assert seen[:, 2].min() == pytest.approx(solid[:, 2].min(), abs=tolerances(object_id)[0]), "it would float or sink"
    assert sum(len(part.mesh.faces) for _, part in parts) <= MAX_TRIANGLES
    assert {part.material.texture for _, part in parts} - {""} <= set(textures.TEXTURES)
    for _, part in parts:
        assert np.linalg.norm(part.mesh.normals, axis=1) == pytest.approx(1.0, abs=1e-3)


@each_object
def test_faces_and_normals_agree(object_id: str) -> None:
    """The renderers leave out faces that are seen from behind."""
    for link in LIBRARY.object(object_id).links:
        for part in (part for visual in link.visual for part in visual_parts(visual)):
            corners = part.mesh.vertices[part.mesh.faces].astype(float)
            facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            smooth = part.mesh.normals[part.mesh.faces].mean(axis=1)
            assert (np.einsum("ij,ij->i", facing, smooth) > 0).mean() > 0.98


@each_object
def test_an_object_rests_at_its_rest_height(object_id: str, client: BulletClient) -> None:
    model = LIBRARY.object(object_id)
    assert all(link.mass > 0 for link in model.links)
    for start in (Pose(position=(0.0, 0.0, model.rest_height)), *model.toppled):
        pose = Pose(position=(0.5, 0.0, start.position[2]), quat_xyzw=start.quat_xyzw)
        configure(client, 240.0)
        build_table(client, TableSpec())
        body = ObjectBody(client, model, EntitySpec(name="it", model=object_id, pose=pose))
        if pose.quat_xyzw == Pose().quat_xyzw:
            boxes = [client.getAABB(body.id, link) for link in range(-1, len(model.joints))]
            extents = np.ptp(np.array(boxes).reshape(-1, 3) - pose.position, axis=0)
            assert np.all(extents > np.ptp(collision_points(model), axis=0) - 4e-3), "PyBullet has left shapes out"
        for _ in range(240):
            client.stepSimulation()
        joints = body.read_joints()[0]
        state, _ = body.read(joints, joints)
        moved, turned = distance(pose, state.pose)
        assert moved < tolerances(object_id)[1]
        assert turned < math.radians(2.0)
        assert np.linalg.norm(state.angular_velocity) < (0.05 if object_id in SHAPES else 0.01)
        assert joints == pytest.approx([0.0] * len(joints), abs=1e-3)


@pytest.mark.parametrize("object_id", TOOLS)
def test_a_tool_is_held_off_its_middle_by_its_handle(object_id: str) -> None:
    """Turning the hand alone would move a tool too far: `rotate` allows 5 cm, so the tool must move on an arc."""
    model = LIBRARY.object(object_id)
    assert [grasp.name for grasp in model.grasps] == ["top", "front", "back"]
    assert all(-grasp.pose.position[0] > 0.05 / math.sqrt(2) for grasp in model.grasps)
    assert -model.grasps[0].pose.position[0] <= 0.08
    assert 0.18 <= model.size[0] <= 0.28


@pytest.mark.thorough
@each_object
def test_the_check_of_users_objects_finds_nothing_wrong(object_id: str) -> None:
    found, model = check_object(LIBRARY.path("objects", object_id), LIBRARY.robot("panda").gripper.max_opening_m)
    assert [finding.message for finding in found] == []
    assert model is not None
    sizes = LIBRARY.object_modifiers(object_id)
    scaled = [LIBRARY.object(object_id, {"size": word}) for word in sizes["size"].factors] if "size" in sizes else []
    for grasp in (grasp for variant in (model, *scaled) for grasp in variant.grasps):
        assert grasp.width_m <= LIBRARY.robot("panda").gripper.max_opening_m - 0.006, "fingers need room on both sides"


@each_object
def test_regions_handles_and_press_points_are_on_the_object(object_id: str) -> None:
    model = LIBRARY.object(object_id)
    links = object_link_poses(model, {})
    solid = collision_points(model)
    low, high = solid.min(axis=0) - 1e-3, solid.max(axis=0) + 1e-3
    spots = [(region.link, region.pose) for region in model.regions]
    spots += [(handle.link, handle.pose) for handle in model.handles]
    spots += [(point.link, point.pose) for point in model.press_points]
    for link, pose in spots:
        spot = (links[link or model.links[0].name] @ pose).position
        assert np.all(low <= spot)
        assert np.all(np.asarray(spot) <= high)
    surfaces = [region for region in model.regions if region.kind == "surface"]
    interiors = [region for region in model.regions if region.kind == "interior"]
    assert ("support" in model.affordances) == bool(surfaces)
    assert ("container" in model.affordances) == bool(interiors)


@pytest.mark.parametrize("object_id", ["bowl", "mug", "tray", "cabinet"])
def test_a_small_ball_falls_into_a_container(object_id: str, client: BulletClient) -> None:
    model = LIBRARY.object(object_id)
    region = next(region for region in model.regions if region.kind == "interior")
    joints = {joint.name: joint.upper for joint in model.joints}
    base = Pose(position=(0.5, 0.0, model.rest_height))
    link = region.link or model.links[0].name
    floor = base @ object_link_poses(model, joints)[link] @ region.pose
    configure(client, 240.0)
    build_table(client, TableSpec())
    ObjectBody(
        client, model, EntitySpec(name="it", model=object_id, pose=base, joint_positions=joints, fixed=bool(joints))
    )
    ball = client.createMultiBody(
        0.02,
        client.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.01),
        basePosition=np.add(floor.position, (0.0, 0.0, region.size[2] + 0.02)),
    )
    for _ in range(360):
        client.stepSimulation()
    height = client.getBasePositionAndOrientation(ball)[0][2] - floor.position[2]
    assert height == pytest.approx(0.01, abs=0.003), "a hull has closed the cavity"


def test_a_button_gives_way_and_comes_back(client: BulletClient) -> None:
    model = LIBRARY.object("button")
    point, joint = model.press_points[0], model.joints[0]
    configure(client, 240.0)
    build_table(client, TableSpec())
    body = ObjectBody(
        client, model, EntitySpec(name="it", model="button", pose=Pose(position=(0.5, 0.0, model.rest_height)))
    )
    highest = 0.0
    for step in range(300):
        if step < 120:
            client.applyExternalForce(body.id, 0, [0, 0, -6.0], [0, 0, 0], pybullet.LINK_FRAME)
        client.stepSimulation()
        highest = max(highest, body.read_joints()[0][0])
    assert point.pressed_at < highest < joint.upper + 5e-3  # a limit of PyBullet gives way a little
    assert body.read_joints()[0][0] < 1e-3


@each_object
def test_the_hash_is_stable(object_id: str) -> None:
    assert LIBRARY.digest(object_id) == ModelLibrary().digest(object_id)
    assert LIBRARY.object(object_id) == ModelLibrary().object(object_id)


def test_textures_are_the_same_in_every_process() -> None:
    for name in ("apple_skin", "milk_print"):
        first, again = TEXTURES[name](), TEXTURES[name]()
        assert np.array_equal(first, again)
        assert 0.0 <= first.min() <= first.max() <= 1.0
