"""Every gripper fits every arm."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from roboxim_core.config_folders import config_names, named_config
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_runs.robots import derivation
from roboxim_runs.robots.check import prove
from roboxim_runs.robots.collision_pairs import srdf_text
from roboxim_runs.robots.derivation import derive
from roboxim_runs.robots.gripper_derivation import GripperRecipe, derive_gripper
from roboxim_runs.robots.grippers import gripper
from roboxim_runs.robots.recipe import RobotRecipe

GRIPPERS = config_names("grippers")
JAW = """<robot name="jaw" xmlns:r="x">
  <link name="flange"/><link name="palm"><collision><geometry><box size="0.06 0.1 0.04"/></geometry></collision></link>
  <joint name="m" type="fixed"><parent link="flange"/><child link="palm"/></joint>{fingers}<r:note/>
</robot>"""
FINGER = """<link name="{s}_arm"/><link name="{s}_tip"><collision><geometry><box size="0.02 0.01 0.04"/></geometry>
  </collision><inertial><mass value="0.01"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="{s}_turn" type="revolute"><parent link="palm"/><child link="{s}_arm"/><origin xyz="0 {y} 0.05"/>
    <axis xyz="{x} 0 0"/><limit lower="0" upper="1" velocity="2" effort="5"/></joint>
  <joint name="{s}_level" type="revolute"><parent link="{s}_arm"/><child link="{s}_tip"/><origin xyz="0 0 0.06"/>
    <axis xyz="{x} 0 0"/><limit lower="-1" upper="0" velocity="2" effort="5"/>{mimic}</joint>"""
NOT_PROVEN = {
    ("iiwa14", "xarm_gripper"): "a rocked cube slips by 8.8 mm",
    ("widowx_ai", "franka_hand"): "the hand is too large for the arm: free of self-collision in 22 % of the states",
}
"""Arms and grippers that `robot check` refuses, as docs/how-to/robots.md says."""
MIMIC = '<mimic joint="left_turn" multiplier="-1"/>'


def jaw(folder: Path, mimic: str = MIMIC, **changes: Any) -> GripperRecipe:
    fingers = "".join(
        FINGER.format(s=s, y=y, x=x, mimic=mimic) for s, y, x in (("left", 0.04, 1), ("right", -0.04, -1))
    )
    (folder / "jaw.urdf").write_text(JAW.format(fingers=fingers))
    values = {
        "name": "jaw", "urdf": "jaw.urdf", "root": "palm", "joints": ("left_turn", "right_turn"),
        "tips": ("left_tip", "right_tip"), "force_n": 20.0, "speed_m_s": 0.1,
    }  # fmt: skip
    return GripperRecipe(**values | changes)


def test_the_opening_of_turning_fingers_is_measured(tmp_path: Path) -> None:
    file = derive_gripper(jaw(tmp_path), tmp_path / "grippers", folder=tmp_path, report=lambda line: None)
    tool = gripper(str(file)).gripper
    assert tool.max_opening_m == pytest.approx(0.07, abs=1e-4), "8 cm between the joints, each tip 1 cm thick"
    assert [(row.name, row.leader, row.ratio) for row in tool.followers] == [
        ("gripper_left_level", "gripper_left_turn", -1.0), ("gripper_right_level", "gripper_right_turn", -1.0),
    ]  # fmt: skip
    assert tool.opening_map[0] == pytest.approx((0.0, 0.6226), abs=1e-3), "asin(35 mm / 60 mm)"
    assert tool.links[:3] == ("hand", "gripper_left_tip", "gripper_right_tip")


def test_a_new_derivation_keeps_what_was_written_by_hand(tmp_path: Path) -> None:
    out = tmp_path / "grippers"
    file = derive_gripper(jaw(tmp_path), out, folder=tmp_path, report=lambda line: None)
    (out / "jaw" / "LICENSE").write_text("theirs")
    (out / "jaw" / "visual" / "old.glb").touch()
    first = file.read_text()
    with pytest.raises(ConfigError, match="neither driven nor follows"):
        derive_gripper(jaw(tmp_path, mimic=""), out, folder=tmp_path, report=lambda line: None)
    assert (out / "jaw" / "visual" / "old.glb").exists(), "a derivation that fails changes nothing"
    derive_gripper(jaw(tmp_path), out, folder=tmp_path, report=lambda line: None)
    assert (file.read_text(), (out / "jaw" / "LICENSE").read_text()) == (first, "theirs")
    assert not (out / "jaw" / "visual" / "old.glb").exists()
    assert sorted(path.name for path in out.iterdir()) == ["jaw", "jaw.yaml"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"root": "plam"}, "root: none is called 'plam'; there are flange, palm|root: none is called 'plam'"),
        ({"tips": ("left_tip", "tip")}, "tips: none is called 'tip'"),
        ({"mimic": ""}, "neither driven nor follows"),
    ],
)
def test_what_a_gripper_lacks_is_named(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        derive_gripper(jaw(tmp_path, **changes), tmp_path / "grippers", folder=tmp_path, report=lambda line: None)
    assert not (tmp_path / "grippers" / "jaw.yaml").exists()


@pytest.mark.parametrize("name", GRIPPERS)
def test_every_gripper_names_what_its_urdf_has(name: str) -> None:
    tool = gripper(name)
    text = tool.urdf.read_text()
    names = (*tool.gripper.joint_names, *tool.gripper.links, tool.tcp, *(f.name for f in tool.gripper.followers))
    assert [part for part in names if f'name="{part}"' not in text] == []
    assert (named_config("grippers", name).parent / name / "LICENSE").is_file() or "config/robots" in str(tool.urdf)


def test_an_arm_of_the_library_keeps_its_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="acceleration: with arm they are those of 'panda'"):
        RobotRecipe(name="mine", arm="panda", acceleration=(5.0,))
    with pytest.raises(ConfigError, match="either urdf, .* or arm"):
        RobotRecipe(name="mine")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "name"),
    [
        pytest.param(
            arm, name, marks=[pytest.mark.xfail(reason=reason)] if (reason := NOT_PROVEN.get((arm, name))) else []
        )
        for arm in ModelLibrary().robot_ids
        for name in GRIPPERS
        if arm != "panda_2f85" and "so101" not in arm + name  # which were not tried apart
    ],
)
def test_every_gripper_fits_every_arm(arm: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derivation, "srdf_text", partial(srdf_text, samples=300))
    derive(RobotRecipe(name="mine", arm=arm, gripper=name), tmp_path / "robots", report=lambda line: None)
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    found = {}
    for proof in prove("mine"):
        found[proof.name] = proof
        if proof.name == "holds a cube":
            break
    assert [proof for proof in found.values() if not proof.holds] == []
