"""A robot from a small URDF: the parts are there, the engines agree, and wrong input is explained."""

import math
import shutil
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
import yaml

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.vision.srgb import to_linear
from roboxim_runs.robots import derivation
from roboxim_runs.robots.check import prove
from roboxim_runs.robots.collision_pairs import srdf_text
from roboxim_runs.robots.derivation import Arm, derive
from roboxim_runs.robots.grippers import gripper
from roboxim_runs.robots.link_meshes import coloured
from roboxim_runs.robots.recipe import RobotRecipe
from roboxim_runs.robots.urdf_files import expanded

JOINTS = (("0 0 0.15", "0 0 1"), ("0 0 0.15", "0 1 0"), ("0 0 0.35", "0 1 0"),
          ("0 0 0.2", "0 0 1"), ("0 0 0.15", "0 1 0"), ("0 0 0.1", "0 0 1"))  # fmt: skip
"""Origin and axis of each joint of an arm like a UR's, without its offsets."""


LIMIT = '<limit lower="-3" upper="3" velocity="2" effort="60"/>'


def small_arm(folder: Path, **changes: str) -> Path:
    """Write a six-joint arm of boxes and one mesh, and return its URDF."""
    trimesh.creation.cylinder(0.05, 0.1).export(folder / "base.stl")
    box = '<geometry><box size="0.06 0.06 0.06"/></geometry>'
    mesh = '<geometry><mesh filename="package://somebody/base.stl"/></geometry>'
    inertial = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    inertial += "</inertial>"
    kind = changes.get("type", "revolute")
    limit = changes.get("limit", LIMIT)
    links = [f'<link name="world"/><link name="base"><visual>{mesh}</visual><collision>{mesh}</collision></link>']
    joints = ['<joint name="fix" type="fixed"><parent link="world"/><child link="base"/></joint>']
    for k, (xyz, axis) in enumerate(JOINTS, start=1):
        inertial = (
            '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        links.append(f'<link name="l{k}"><visual>{box}</visual><collision>{box}</collision>{inertial}</link>')
        joints.append(
            f'<joint name="j{k}" type="{kind}"><parent link="{"base" if k == 1 else f"l{k - 1}"}"/>'
            f'<child link="l{k}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>{limit}</joint>'
        )
    (folder / "package.xml").write_text("<package><name>somebody</name></package>")
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(links)}{"".join(joints)}</robot>')
    return path


def test_the_colour_of_a_glb_file_is_srgb_in_the_robots_own(tmp_path):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    looks = trimesh.visual.material.PBRMaterial(baseColorFactor=[*to_linear([0.8, 0.2, 0.1]), 1.0])
    box.visual = trimesh.visual.TextureVisuals(material=looks)
    box.export(tmp_path / "box.glb")
    shape = ElementTree.fromstring('<visual><geometry><mesh filename="box.glb" scale="1 -1 1"/></geometry></visual>')
    ((color, mesh),) = coloured(shape, tmp_path / "it.urdf", {})
    assert color == pytest.approx((204, 51, 26), abs=2)
    assert mesh.volume == pytest.approx(0.001)


def recipe(urdf: Path, **changes: Any) -> RobotRecipe:
    return RobotRecipe(
        **{"name": "mine", "urdf": str(urdf), "acceleration": (5.0,), "mount_xyz": (0.0, 0.0, 0.03), **changes}
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    derive(recipe(small_arm(folder)), folder / "config" / "robots", report=lambda line: None)
    return folder / "config"


@pytest.mark.thorough
def test_the_arm_is_cut_out_named_and_fitted_with_a_hand(made: Path) -> None:
    robot = ModelLibrary(made).robot("mine")
    assert robot.base_link == "mine_base"
    assert robot.joint_names == tuple(f"mine_j{k}" for k in range(1, 7))
    assert robot.gripper.links == ("mine_hand", "mine_leftfinger", "mine_rightfinger")
    assert robot.limits.acceleration == (5.0,) * 6
    assert robot.limits.jerk == (100.0,) * 6
    assert 'link1="mine_base" link2="mine_l1" reason="Adjacent"' in robot.srdf.read_text()
    covered = trimesh.load_mesh(made / "robots" / "mine" / "collision" / "base_1_1.stl")
    np.testing.assert_allclose(covered.extents, (0.1, 0.1, 0.1), atol=2e-3)


@pytest.mark.thorough
def test_the_proofs_of_geometry_hold(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(made))
    found = {}
    for proof in prove("mine"):
        found[proof.name] = proof
        if proof.name == "reach":
            break  # picking up is a slow test's
    assert [name for name, proof in found.items() if not proof.holds] == [], found


@pytest.mark.parametrize(
    ("changes", "given", "said"),
    [
        ({}, {"flange": "l9"}, "no link 'l9' for the flange; its links are world, base, l1"),
        ({}, {"base": "l3", "flange": "l2"}, "'l2' is not below 'l3'"),
        ({}, {"gripper": "claw"}, "no 'claw' in config.grippers"),
        ({}, {"acceleration": (1.0, 2.0)}, "acceleration: expected 1 or 6 numbers, one for each joint"),
        ({}, {"name": "My Arm"}, "expected lower-case letters"),
        ({"type": "prismatic"}, {}, "an arm has revolute joints"),
        ({"limit": '<limit lower="-3" upper="3" effort="60"/>'}, {}, "no velocity limit; give --velocity"),
        ({"limit": '<limit lower="-3" upper="3" velocity="2"/>'}, {}, "no effort limit; give --effort"),
        ({"limit": '<limit velocity="2" effort="60"/>'}, {}, "joint 'j1' has no range, got 0 to 0 rad"),
        (
            {"limit": '<limit lower="-3" upper="3,1" velocity="2" effort="60"/>'},
            {},
            "upper must be a number, with a po",
        ),
        ({"limit": f'{LIMIT}<mimic joint="j2"/>'}, {}, r"joint 'j1' follows another one \(<mimic>\)"),
        ({}, {"home": (10.0,)}, "home: joint 'j1' is at 10 rad, beyond its limits -3 to 3 rad"),
        ({}, {"without": ("l9", "l2")}, "without l9, l2: expected links beside the chain"),
    ],
)
def test_what_is_missing_or_wrong_is_named(
    tmp_path: Path, changes: dict[str, str], given: dict[str, Any], said: str
) -> None:
    urdf = small_arm(tmp_path, **changes)
    with pytest.raises(ConfigError, match=said):
        derive(recipe(urdf, **given), tmp_path / "robots", report=lambda line: None)
    assert not list((tmp_path / "robots").glob("*.yaml")), "nothing is half-written"


@pytest.mark.parametrize(
    ("lower", "upper", "kept"),
    [
        (-3.0, 3.0, (-3.0, 3.0)),
        (-6.5, 6.5, (-math.pi, math.pi)),
        (-0.5, 6.5, (-0.5, -0.5 + 2 * math.pi)),
        (-6.5, 0.2, (0.2 - 2 * math.pi, 0.2)),
        (0.0, 1.5, (0.0, 1.5)),
    ],
)
def test_a_range_is_never_wider_than_the_urdfs(
    lower: float, upper: float, kept: tuple[float, float], tmp_path: Path
) -> None:
    least = f'lower="{lower}"' if lower else ""  # which a URDF may leave out
    stated = f'<limit {least} upper="{upper}" velocity="2" effort="60"/>'
    urdf = small_arm(tmp_path, limit=stated)
    limits = Arm(expanded(urdf), urdf, recipe(urdf)).values(gripper("franka_hand"))["limits"]
    assert limits["lower"] == pytest.approx([kept[0]] * 6)
    assert limits["upper"] == pytest.approx([kept[1]] * 6)


def test_torques_can_be_given(tmp_path: Path) -> None:
    urdf = small_arm(tmp_path, limit='<limit lower="-3" upper="3" velocity="2"/>')
    made = Arm(expanded(urdf), urdf, recipe(urdf, effort=(40.0,))).values(gripper("franka_hand"))
    assert made["limits"]["effort"] == [40.0] * 6


@pytest.mark.parametrize(
    ("without", "kept"), [((), ["palm", "tip", "frame", "guard"]), (("palm",), ["frame", "guard"])]
)
def test_links_fixed_beside_the_chain_are_kept_and_named_unless_left_out(
    tmp_path: Path, without: tuple[str, ...], kept: list[str]
) -> None:
    urdf = small_arm(tmp_path)
    shape = '<geometry><box size="0.02 0.02 0.02"/></geometry>'
    boxes = {kind: f"<{kind}>{shape}</{kind}>" for kind in ("visual", "collision")} | {"none": ""}
    parts = {"palm": ("l5", "visual"), "tip": ("palm", "visual"), "frame": ("l2", "none"), "bare": ("l2", "none"),
             "guard": ("frame", "collision")}  # fmt: skip
    more = "".join(
        f'<link name="{name}">{boxes[kind]}</link>'
        f'<joint name="{name}_fix" type="fixed"><parent link="{parent}"/><child link="{name}"/></joint>'
        for name, (parent, kind) in parts.items()
    )
    urdf.write_text(urdf.read_text().replace("</robot>", f"{more}</robot>"))
    arm = Arm(expanded(urdf), urdf, recipe(urdf, flange="l6", without=without))
    assert arm.beside == kept
    for folder in ("visual", "collision"):
        (tmp_path / folder).mkdir()
    made = list(arm.elements(tmp_path, lambda line: None))
    links = {one.get("name") for one in made if one.tag == "link"}
    assert {one.find("parent").get("link") for one in made if one.tag == "joint"} <= links


@pytest.mark.thorough
def test_an_arm_slower_than_the_commands_still_gets_to_the_cube(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path / "config"))
    shutil.copytree(made, tmp_path / "config")
    file = tmp_path / "config" / "robots" / "mine.yaml"
    stated = yaml.safe_load(file.read_text())
    stated["limits"]["velocity"] = [0.4] * 6
    file.write_text(yaml.safe_dump(stated))
    held = next(proof for proof in prove("mine") if proof.name == "holds a cube")
    assert held.holds, held.detail


@pytest.mark.parametrize("cover", [False, True])
def test_what_collision_shapes_leave_uncovered_is_said_and_can_be_covered(tmp_path: Path, cover: bool) -> None:
    urdf = small_arm(tmp_path)
    file = tmp_path / "arm.urdf"
    far = '<link name="l3"><visual><geometry><box size="0.06 0.06 0.30"/></geometry></visual>'
    near = '<link name="l3"><visual><geometry><box size="0.06 0.06 0.06"/></geometry></visual>'
    file.write_text(urdf.read_text().replace(near, far))
    for kind in ("visual", "collision"):
        (tmp_path / "out" / kind).mkdir(parents=True)
    said: list[str] = []
    made = list(Arm(expanded(file), file, recipe(file, cover=cover)).elements(tmp_path / "out", said.append))
    assert any("l3 (120 mm)" in line and "--cover" in line for line in said) != cover, said
    part = trimesh.load_mesh(tmp_path / "out" / "collision" / "l3_1_1.stl")
    assert part.extents[2] == pytest.approx(0.30 if cover else 0.06, abs=3e-3)
    assert len([element for element in made if element.tag == "link"]) == 7


@pytest.mark.parametrize("name", ["mount_xyz", "mount_rpy", "base_xyz"])
def test_a_place_of_two_numbers_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: expected 3 numbers, got 2"):
        recipe(tmp_path / "arm.urdf", **{name: (0.0, 0.0)})


def test_accelerations_are_asked_for() -> None:
    with pytest.raises(ConfigError, match="give them from the maker's data sheet"):
        RobotRecipe(name="mine", urdf="arm.urdf")


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    urdf = small_arm(tmp_path)
    (tmp_path / "base.stl").unlink()
    with pytest.raises(ConfigError, match=r"cannot read the mesh .*base\.stl"):
        derive(recipe(urdf), tmp_path / "robots", report=lambda line: None)


@pytest.mark.thorough
def test_a_gripper_is_mounted_on_an_arm_from_a_urdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derivation, "srdf_text", partial(srdf_text, samples=300))
    derive(recipe(small_arm(tmp_path), gripper="robotiq_2f85"), tmp_path / "robots", report=lambda line: None)
    robot = ModelLibrary(tmp_path).robot("mine")
    assert robot.gripper.links[:2] == ("mine_hand", "mine_gripper_left_inner_finger_pad")
    assert robot.gripper.opening_map == gripper("robotiq_2f85").gripper.opening_map


@pytest.mark.thorough
def test_a_small_arm_stands_on_a_pillar_where_it_reaches(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(derivation, "srdf_text", partial(srdf_text, samples=300))
    derive(recipe(small_arm(tmp_path), base_xyz=(0.2, 0.0, 0.25)), tmp_path / "robots", report=lambda line: None)
    robot, beside = ModelLibrary(tmp_path).robot("mine"), ModelLibrary(made).robot("mine")
    there, here = (ArmKinematics(model).fk(beside.home) for model in (robot, beside))
    np.testing.assert_allclose(np.subtract(there.position, here.position), (0.2, 0.0, 0.25), atol=1e-9)
    assert robot.stand == pytest.approx((0.14, -0.06, 0.26, 0.06))
    pillar = trimesh.load_mesh(tmp_path / "robots" / "mine" / "collision" / "mine_stand_1_1.stl")
    np.testing.assert_allclose(pillar.bounds, [(0.14, -0.06, 0.0), (0.26, 0.06, 0.25)], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ModelLibrary().robot_ids)
def test_every_shipped_arm_is_proven(robot: str) -> None:
    assert [proof for proof in prove(robot) if not proof.holds] == []


def test_a_urdf_with_a_comment_of_xacro_is_read(tmp_path: Path) -> None:
    (tmp_path / "made.urdf").write_text('<robot name="made"><!-- <xacro:left_out/> \n --><link name="base"/></robot>')
    assert expanded(tmp_path / "made.urdf").get("name") == "made"
