"""Models: loading, modifiers, meshes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from roboxim_core.config import config_dir, from_plain, named_config
from roboxim_core.errors import ConfigError
from roboxim_core.models.description import Visual
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.visuals import (
    ScenePoses,
    box_mesh,
    object_link_poses,
    render_world,
    robot_parts,
    visual_generators,
    visual_parts,
)
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_core.state import EntityState, RobotState, StateRecord

LIBRARY = ModelLibrary()
DRAWER = """
name: box with a drawer
links:
  - {name: body, mass: 2.0, collision: [{kind: box, size: [0.2, 0.2, 0.1]}]}
  - {name: drawer, mass: 0.3, collision: [{kind: box, size: [0.1, 0.1, 0.05], pose: {position: [0.1, 0.0, 0.0]}}]}
joints:
  - {name: slide, kind: prismatic, parent: body, child: drawer, upper: 0.15,
     pose: {position: [0.1, 0.0, 0.02]}, axis: [1.0, 0.0, 0.0]}
size: [0.2, 0.2, 0.1]
rest_height: 0.05
modifiers: {scale: {default: 1.0, lower: 0.5, upper: 2.0}}
"""


@pytest.fixture
def own_library(tmp_path: Path) -> ModelLibrary:
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "drawer_box.yaml").write_text(DRAWER)
    return ModelLibrary(tmp_path)


@pytest.mark.parametrize("object_id", LIBRARY.object_ids)
def test_every_object_loads_with_all_its_modifiers(object_id: str) -> None:
    plain = LIBRARY.object(object_id)
    assert plain.links
    assert plain.rest_height > 0
    for kind, modifier in LIBRARY.object_modifiers(object_id).items():
        values = (modifier.lower, modifier.upper) if kind == "scale" else modifier.words(kind)
        for value in values:
            assert LIBRARY.object(object_id, {kind: value}).id == object_id
    for link in plain.links:
        for visual in link.visual:
            assert all(len(part.mesh.faces) for part in visual_parts(visual))


def test_color_tints_and_scale_scales() -> None:
    cube = LIBRARY.object("cube", {"color": "blue", "scale": 1.2})
    (link,) = cube.links
    assert link.visual[0].material.color == PALETTE["blue"]
    assert link.collision[0].size == pytest.approx([0.054] * 3)
    assert link.mass == pytest.approx(0.08 * 1.2**3)
    assert cube.rest_height == pytest.approx(0.027)
    assert cube.grasps[0].width_m == pytest.approx(0.054)
    assert LIBRARY.object("cube", {"scale": 1.2, "color": "blue"}) is cube


@pytest.mark.parametrize(
    ("object_id", "modifiers", "message"),
    [
        ("cub", {}, "did you mean 'cube'"),
        ("cube", {"colour": "red"}, "did you mean 'color'"),
        ("cube", {"color": "rde"}, "did you mean 'red'"),
        ("cube", {"scale": 9.0}, "from 0.6 to 1.4"),
        ("cube", {"scale": True}, "must be a number"),
    ],
)
def test_wrong_object_or_modifier_is_refused(object_id: str, modifiers: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        LIBRARY.object(object_id, modifiers)


def test_every_object_takes_factors_on_mass_and_friction() -> None:
    usual, changed = LIBRARY.object("cabinet"), LIBRARY.object("cabinet", {"mass": 2.0, "friction": 0.5})
    assert [link.mass for link in changed.links] == pytest.approx([2 * link.mass for link in usual.links])
    assert changed.friction.lateral == pytest.approx(usual.friction.lateral / 2)
    with pytest.raises(ConfigError, match=r"mass must be a number from 0\.2 to 5"):
        LIBRARY.object("cube", {"mass": 0.0})


def test_unknown_robot_and_joint_are_refused(own_library: ModelLibrary) -> None:
    with pytest.raises(ConfigError, match="did you mean 'panda'"):
        LIBRARY.robot("pandda")
    with pytest.raises(ConfigError, match="did you mean 'slide'"):
        own_library.entity_model(EntitySpec(name="a", model="drawer_box", joint_positions={"slid": 0.1}))
    with pytest.raises(ConfigError, match="from 0 to 0.15"):
        own_library.entity_model(EntitySpec(name="a", model="drawer_box", joint_positions={"slide": 0.2}))


def test_object_file_with_a_loose_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "bad.yaml").write_text(DRAWER.replace("child: drawer", "child: lid"))
    with pytest.raises(ConfigError, match=r"bad\.yaml.*needs exactly one joint"):
        ModelLibrary(tmp_path).object("bad")


def test_digest_names_the_content(own_library: ModelLibrary) -> None:
    before = own_library.digest("drawer_box")
    path = own_library.search_path[0] / "objects" / "drawer_box.yaml"
    path.write_text(path.read_text().replace("0.3", "0.4"))
    assert own_library.digest("drawer_box") != before
    assert LIBRARY.digest("panda") == ModelLibrary().digest("panda") != LIBRARY.digest("cube")


def test_drawer_moves_with_its_joint_and_scale(own_library: ModelLibrary) -> None:
    model = own_library.object("drawer_box", {"scale": 2.0})
    poses = object_link_poses(model, {"slide": 0.1})
    assert poses["drawer"].position == pytest.approx((0.3, 0.0, 0.04))
    assert model.joints[0].upper == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("box", (0.04, 0.05, 0.06), 0.04 * 0.05 * 0.06),
        ("sphere", (0.03,), 4 / 3 * np.pi * 0.03**3),
        ("cylinder", (0.03, 0.1), np.pi * 0.03**2 * 0.1),
        ("capsule", (0.02, 0.1), np.pi * 0.02**2 * 0.1 + 4 / 3 * np.pi * 0.02**3),
        (
            "slotted_board",
            (0.2, 0.008, 0.035, 0.075, 0.014, 0.004),
            0.008 * (0.2 * 0.035 - 0.061 * 0.014 - np.pi * 0.007**2),
        ),
    ],
)
def test_primitive_meshes_are_closed_and_face_outwards(kind: str, size: tuple[float, ...], volume: float) -> None:
    mesh = visual_generators[kind](size)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    solid.merge_vertices(merge_norm=True, merge_tex=True, digits_vertex=6)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(volume, rel=0.03)
    assert solid.bounds.mean(axis=0) == pytest.approx([0, 0, 0], abs=1e-6)
    facing = (
        mesh.normals[mesh.faces].mean(axis=1) * trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals
    ).sum(1)
    assert facing.min() > 0.4


def test_box_texture_covers_each_face_once() -> None:
    mesh = box_mesh((0.1, 0.1, 0.1))
    assert mesh.uv is not None
    top = mesh.normals[:, 2] > 0.99
    flat = top & (np.abs(mesh.vertices[:, 2] - 0.05) < 1e-6)
    assert mesh.uv[flat].min() == 0.0
    assert mesh.uv[flat].max() == 1.0


def _record(scene: SceneSpec) -> StateRecord:
    robot = LIBRARY.robot("panda")
    state = RobotState(
        joint_names=robot.joint_names,
        joint_positions=robot.home,
        joint_velocities=(0.0,) * 7,
        joint_commands=robot.home,
        pose_tcp_measured=Pose(),
        pose_tcp_commanded=Pose(),
        gripper_opening=1.0,
        gripper_command=1.0,
        finger_positions=(0.04, 0.04),
    )
    entities = tuple(EntityState(name=e.name, pose=e.pose) for e in scene.entities)
    return StateRecord(episode_id="", seq=0, stamp_ns=0, robot=state, entities=entities)


def test_a_mesh_file_is_shaded_with_its_own_normals(tmp_path: Path) -> None:
    bent = np.tile(np.array([0.6, 0.0, 0.8]), (3, 1))
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2]], vertex_normals=bent, process=False)
    mesh.export(tmp_path / "bent.glb", include_normals=True)

    (part,) = visual_parts(Visual(kind="mesh", mesh=str(tmp_path / "bent.glb")))

    assert part.mesh.normals == pytest.approx(bent, abs=1e-5)


def test_one_sees_through_a_board_where_its_slot_is() -> None:
    mesh = visual_generators["slotted_board"]((0.2, 0.008, 0.035, 0.075, 0.014, 0.004))
    front = mesh.vertices[mesh.faces[(mesh.normals[mesh.faces][..., 1] > 0.9).all(axis=1)]][..., [0, 2]]

    def covered(x: float, z: float) -> bool:
        to = front - [x, z]
        then = np.roll(to, -1, axis=1)
        turns = to[..., 0] * then[..., 1] - to[..., 1] * then[..., 0]
        return bool(((turns > 0).all(axis=1) | (turns < 0).all(axis=1)).any())

    assert not covered(0.001, 0.004)
    assert not covered(0.036, 0.0041)
    assert covered(0.001, 0.012)
    assert covered(0.037, 0.010)
    with pytest.raises(ValueError, match="slot must be longer than high"):
        visual_generators["slotted_board"]((0.2, 0.008, 0.035, 0.075, 0.014, 0.015))


def test_a_rounded_box_stretches_no_texture() -> None:
    mesh = visual_generators["rounded_box"]((0.2, 0.1, 0.04, 0.005))
    assert mesh.uv is not None
    flat = np.abs(mesh.normals[mesh.faces]).max(axis=2).min(axis=1) > 0.999
    corners, uv = mesh.vertices[mesh.faces[flat]], mesh.uv[mesh.faces[flat]]
    lengths = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2)

    assert 0.2 * np.linalg.norm(uv[:, 1:] - uv[:, :1], axis=2) == pytest.approx(lengths, rel=1e-3)


def test_render_world_and_poses_have_the_same_moving_bodies() -> None:
    cube = EntitySpec(name="target", model="cube", pose=Pose(position=(0.5, 0.1, 0.0225)))
    scene = SceneSpec(entities=(cube,))
    world = render_world(scene, LIBRARY)
    poses = ScenePoses(scene, LIBRARY).body_poses(_record(scene))
    still = {"table", "pedestal", "floor", "wall"}
    assert set(poses) | still == {body.key for body in world.bodies}
    assert world.entity_names == ("table", "floor", "wall", "robot", "target")
    assert poses["target"] == cube.pose
    fingers = poses["robot/panda_leftfinger"], poses["robot/panda_rightfinger"]
    assert np.linalg.norm(np.subtract(fingers[0].position, fingers[1].position)) == pytest.approx(0.08)


def test_camera_on_the_hand_moves_with_it_and_an_unknown_parent_is_refused() -> None:
    camera = CameraSpec(name="wrist", parent="panda_hand", pose=Pose(position=(0.0, 0.0, 0.1034)))
    scene = SceneSpec(cameras=(camera,))
    poses = ScenePoses(scene, LIBRARY)
    state = _record(scene).robot
    raised = replace(state, joint_positions=LIBRARY.robot("panda").named_states["ready"])
    for robot in (state, raised):
        tcp = poses.link_poses(robot)["panda_hand_tcp"]
        assert poses.camera_poses(robot)["wrist"].position == pytest.approx(tcp.position, abs=1e-9)
        anywhere = (replace(camera, parent="gripper"),)
        assert poses.camera_poses(robot, anywhere) == poses.camera_poses(robot)
    with pytest.raises(ConfigError, match="panda_hand"):
        ScenePoses(SceneSpec(cameras=(replace(camera, parent="panda_hnd"),)), LIBRARY)


@pytest.mark.parametrize("robot_id", LIBRARY.robot_ids)
def test_no_model_file_holds_an_absolute_path(robot_id: str) -> None:
    robot = LIBRARY.robot(robot_id)
    for line in robot.urdf.read_text().splitlines():
        if "filename" in line:
            assert 'filename="package://' in line


def test_the_default_robot_has_few_enough_triangles_for_a_renderer_without_a_gpu() -> None:
    robot = LIBRARY.robot("panda")
    parts = robot_parts(robot.urdf, robot.mesh_colors)
    assert sum(len(part.mesh.faces) for link in parts.values() for part in link) <= 11_500
    assert len(parts) == 11


def test_own_folders_are_searched_before_the_built_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "mine.yaml").write_text("name: mine\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    assert named_config("cameras", "mine") == tmp_path / "cameras" / "mine.yaml"
    assert named_config("cameras", "wrist").parent.parent == config_dir()
    with pytest.raises(ConfigError, match="did you mean 'mine'"):
        named_config("cameras", "mien")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match="which is not a folder"):
        ModelLibrary()


def test_a_pose_may_be_given_in_degrees() -> None:
    pose = from_plain({"position": [1, 2, 3], "rpy_deg": [180, 0, 90]}, Pose)
    assert pose.rotation.apply([1.0, 0.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])
    assert pose.rotation.apply([0.0, 0.0, 1.0]) == pytest.approx([0.0, 0.0, -1.0])
    with pytest.raises(ConfigError, match="not both"):
        from_plain({"rpy_deg": [0, 0, 0], "quat_xyzw": [0, 0, 0, 1]}, Pose)
    with pytest.raises(ConfigError, match="roll, pitch and yaw in degrees"):
        from_plain({"rpy_deg": [0, 0]}, Pose)


def test_materials_and_sizes_change_look_mass_and_grasps() -> None:
    usual, metal = LIBRARY.object("cube"), LIBRARY.object("cube", {"material": "metal"})
    assert metal.links[0].mass == pytest.approx(2 * usual.links[0].mass)
    assert metal.links[0].visual[0].material.metallic == 1.0
    assert (
        LIBRARY.object("cube", {"material": "metal", "color": "blue"}).links[0].visual[0].material.color
        == PALETTE["blue"]
    )
    large = LIBRARY.object("bowl", {"size": "large"})
    assert large.size == pytest.approx([1.15 * value for value in LIBRARY.object("bowl").size])
    assert large.regions[0].size == pytest.approx([1.15 * value for value in LIBRARY.object("bowl").regions[0].size])
    with pytest.raises(ConfigError, match="did you mean 'large'"):
        LIBRARY.object("cube", {"size": "lrage"})
    with pytest.raises(ConfigError, match="unknown material 'ceramic'"):
        LIBRARY.object("cube", {"material": "ceramic"})


@pytest.mark.parametrize("count", [0, 65])
def test_an_arm_of_no_or_too_many_joints_is_refused_when_it_is_read(count: int) -> None:
    with pytest.raises(ConfigError, match=f"joint_names: expected 1 to 64 joints of an arm, got {count}"):
        replace(LIBRARY.robot("panda"), joint_names=("a",) * count)
