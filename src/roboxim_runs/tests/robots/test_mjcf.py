"""An MJCF becomes the URDF of the same robot; what a URDF cannot say is refused by name."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from roboxim_core.errors import ConfigError
from roboxim_runs.robots.urdf_files import expanded

ARM = """<mujoco model="small">
  <compiler angle="{angle}" meshdir="meshes"/>
  <default><geom contype="0" conaffinity="0" group="1"/>
    <default class="touch"><geom type="box" contype="1" conaffinity="1" group="{shown}"/></default>
    <default class="lift"><joint axis="0 1 0" range="{range}"/></default>
  </default>
  <asset><material name="red" rgba="1 0 0 1"/><mesh name="plate" file="plate.stl" scale="0.001 0.001 0.001"/></asset>
  <worldbody><body name="base" pos="0 0 0.1">
    <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
    <geom type="mesh" mesh="plate" material="red"/><geom class="touch" size="0.1 0.1 0.05"/>
    <body name="first" pos="0.1 0 0.2" euler="{turn} 0 0" childclass="lift">
      <inertial pos="0 0 0.1" quat="0.70710678 0 0 0.70710678" mass="2" diaginertia="0.2 0.3 0.4"/>
      <joint name="shoulder" type="hinge"/>
      <geom type="capsule" size="0.03 0.1"/>
      <body name="left_finger" pos="0 0.05 0.3">
        <inertial pos="0 0 0" mass="0.1" fullinertia="0.02 0.02 0.03 0.001 0.002 0.003"/>
        <joint name="left" type="slide" axis="0 1 0" range="0 0.04"/>
      </body>
      <body name="right_finger" pos="0 -0.05 0.3">
        <inertial pos="0 0 0" mass="0.1" diaginertia="0.01 0.01 0.01"/>
        <joint name="right" type="slide" axis="0 -1 0" range="0 0.04"/>
      </body>
      {more}
    </body>
  </body></worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0"/></equality>
  <actuator><position joint="shoulder" forcerange="-27 27"/></actuator>
</mujoco>"""
RADIANS = {"angle": "radian", "turn": "0.5", "range": "-1.5 1.5", "shown": "3"}


def written(folder: Path, *, more: str = "", **values: str) -> Path:
    (folder / "meshes").mkdir(exist_ok=True)
    trimesh.creation.box((200, 100, 50)).export(folder / "meshes" / "plate.stl")
    path = folder / "small.xml"
    path.write_text(ARM.format(more=more, **(RADIANS | values)))
    return path


def model(urdf: ElementTree.Element) -> pin.Model:
    return pin.buildModelFromXML(ElementTree.tostring(urdf, encoding="unicode"))


def joint(urdf: ElementTree.Element, name: str) -> ElementTree.Element:
    (found,) = (joint for joint in urdf.findall("joint") if joint.get("name") == name)
    return found


def test_bodies_become_links_and_defaults_apply(tmp_path: Path) -> None:
    urdf = expanded(written(tmp_path))
    shoulder = joint(urdf, "shoulder")
    assert shoulder.find("axis").attrib == {"xyz": "0 1 0"}
    assert shoulder.find("limit").attrib == {"lower": "-1.5", "upper": "1.5", "velocity": "0", "effort": "27"}
    assert joint(urdf, "right").find("mimic").attrib == {"joint": "left", "multiplier": "1", "offset": "0"}
    base = urdf.find("link[@name='base']")
    assert base.find("visual/geometry/mesh").attrib == {
        "filename": "meshes/plate.stl", "scale": "0.001 0.001 0.001",
    }  # fmt: skip
    assert base.find("visual/material/color").get("rgba") == "1 0 0 1"
    assert [shape.get("size") for shape in base.findall("collision/geometry/box")] == ["0.2 0.2 0.1"]
    assert len(base.findall("visual")) == 1, "a geom of group 3 is not seen"


def test_shapes_for_contacts_are_not_drawn_over_those_to_be_seen(tmp_path: Path) -> None:
    base = expanded(written(tmp_path, more="", shown="0")).find("link[@name='base']")
    assert [shape.find("geometry")[0].tag for shape in base.findall("visual")] == ["mesh"]
    assert len(base.findall("collision")) == 1
    path = tmp_path / "small.xml"
    path.write_text(path.read_text().replace('<geom contype="0" conaffinity="0" group="1"/>', ""))
    assert len(expanded(path).findall("link[@name='base']/visual")) == 2, "all touch: all are seen"


@pytest.mark.parametrize(
    ("actuator", "effort"),
    [
        ('<motor joint="shoulder" ctrlrange="-80 80"/>', "80"),
        ('<motor joint="shoulder" ctrlrange="-1 1" gear="40"/>', "40"),
        ('<motor joint="shoulder" ctrlrange="-80 80" forcerange="-60 50"/>', "60"),
        ('<motor joint="shoulder" ctrlrange="-80 80" ctrllimited="false"/>', "0"),
        ('<position joint="shoulder" ctrlrange="-1.5 1.5"/>', "0"),
    ],
)
def test_torques_are_those_of_the_actuators(tmp_path: Path, actuator: str, effort: str) -> None:
    path = written(tmp_path)
    path.write_text(path.read_text().replace('<position joint="shoulder" forcerange="-27 27"/>', actuator))
    assert joint(expanded(path), "shoulder").find("limit").get("effort") == effort


@pytest.mark.parametrize("tag", ["general", "motor", "position"])
def test_all_actuators_share_the_defaults_of_a_class(tmp_path: Path, tag: str) -> None:
    path = written(tmp_path)
    text = path.read_text().replace("</default>\n  <asset>", f'<{tag} forcerange="-150 150"/></default>\n  <asset>')
    path.write_text(text.replace(' forcerange="-27 27"', ""))
    assert joint(expanded(path), "shoulder").find("limit").get("effort") == "150"


@pytest.mark.parametrize("inactive", ['polycoef="0 1 0 0 0" active="false"', 'class="off"'])
def test_an_inactive_equality_couples_nothing(tmp_path: Path, inactive: str) -> None:
    path = written(tmp_path)
    off = '<default class="off"><equality active="false"/></default></default>\n  <asset>'
    text = path.read_text().replace("</default>\n  <asset>", off)
    path.write_text(text.replace('joint2="left" polycoef="0 1 0 0 0"', f'joint2="left" {inactive}'))
    assert joint(expanded(path), "right").find("mimic") is None


def test_it_moves_and_weighs_as_the_mjcf_says(tmp_path: Path) -> None:
    robot = model(expanded(written(tmp_path)))
    data = robot.createData()
    q = np.zeros(robot.nq)
    q[robot.joints[robot.getJointId("left")].idx_q] = 0.02
    pin.framesForwardKinematics(robot, data, q)
    turned = np.array([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]])
    expected = np.array([0.1, 0, 0.2]) + turned @ np.array([0, 0.07, 0.3])
    np.testing.assert_allclose(data.oMf[robot.getFrameId("left_finger")].translation, expected, atol=1e-9)
    shoulder = robot.inertias[robot.getJointId("shoulder")]
    assert shoulder.mass == pytest.approx(2.0)
    np.testing.assert_allclose(np.diag(shoulder.inertia), (0.3, 0.2, 0.4), atol=1e-6)
    left = robot.inertias[robot.getJointId("left")].inertia
    np.testing.assert_allclose(left, [[0.02, 0.001, 0.002], [0.001, 0.02, 0.003], [0.002, 0.003, 0.03]], atol=1e-9)


def test_degrees_are_the_default_unit(tmp_path: Path) -> None:
    path = written(tmp_path, angle="degree", turn="28.64788976", range="-90 90")
    robot = model(expanded(path))
    assert robot.upperPositionLimit[0] == pytest.approx(np.pi / 2)
    same = model(expanded(written(tmp_path)))
    np.testing.assert_allclose(robot.jointPlacements[1].rotation, same.jointPlacements[1].rotation, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('<include file="hand.xml"/>', "<include> is not read"),
        ('<frame pos="0 0 1"><body name="b"/></frame>', "<frame> is not read; expand it first"),
        ('<attach model="hand" body="palm" prefix="b_"/>', "<attach> is not read; expand it first"),
        ('<body name="b"><freejoint/></body>', "body 'b': expected at most one joint"),
        ('<body name="b"><joint type="ball"/></body>', "is a ball; expected a hinge or a slide"),
        ('<body name="b"><joint name="j" pos="0 0 1"/></body>', "joint 'j': pos must be 0"),
        ('<body name="b"><joint name="j" ref="0.5"/></body>', "joint 'j': ref is not read"),
        ('<body name="b"><geom size="0.1"/></body>', "'b' has no <inertial>"),
        ('<body><geom size="0.1"/></body>', "a <body> without name"),
        ('<body name="b" xyaxes="1 0 0 0 1 0"/>', "xyaxes of a <body> is not read; use quat or euler or axisangle"),
        ('<geom type="capsule" fromto="0 0 0 0 0 1" size="0.1"/>', "fromto is not read"),
        ('<geom type="mesh" mesh="disc"/>', "no mesh 'disc' with a file in <asset>"),
        ('<geom type="mesh"/>', "no mesh '' with a file in <asset>"),
        ('<geom size="large"/>', "size='large': expected 1 to 3 finite numbers"),
        ('<geom type="capsule" size="0.1"/>', "size='0.1': expected 2 to 3 finite numbers"),
        ('<geom size="0.1" pos="0 nan 0"/>', "pos='0 nan 0': expected 3 finite numbers"),
        ('<geom size="0.1" quat="0 0 0 0"/>', "is not valid: Found zero norm"),
        ('<geom size="0.1" group="one"/>', "group='one': expected 1 finite number"),
        ('<body name="b"><joint range="1"/></body>', "range='1': expected 2 finite numbers"),
        ('<geom type="ellipsoid" size="1 1 1"/>', "type ellipsoid is not read"),
        ('<geom class="soft" size="0.1"/>', "no default class 'soft'; there are main, touch, lift"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, more: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        expanded(written(tmp_path, more=more))


def test_defaults_of_meshes_and_of_a_named_top_class_apply(tmp_path: Path) -> None:
    path = written(tmp_path)
    text = path.read_text().replace("<default><geom", '<default class="arm"><mesh scale="0.001 0.002 0.001"/><geom')
    path.write_text(text.replace(' scale="0.001 0.001 0.001"', ""))
    urdf = expanded(path)
    assert urdf.find("link/visual/geometry/mesh").get("scale") == "0.001 0.002 0.001"
    assert urdf.find("link/collision/geometry/mesh") is None, "contype is 0 by default"
    path.write_text(path.read_text().replace('file="plate.stl"', 'file="plate.stl" refpos="0 0 0.1"'))
    with pytest.raises(ConfigError, match="mesh 'plate': refpos are not read"):
        expanded(path)


def test_mujoco_places_every_body_alike(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason="make render-peers installs MuJoCo")
    path = written(tmp_path, angle="degree", turn="30", range="-90 90")
    theirs = mujoco.MjModel.from_xml_path(str(path))
    ours, state = model(expanded(path)), mujoco.MjData(theirs)
    data, q = ours.createData(), np.zeros(ours.nq)
    for name, value in (("shoulder", 0.7), ("left", 0.03), ("right", 0.01)):
        state.qpos[theirs.joint(name).qposadr[0]] = value
        q[ours.joints[ours.getJointId(name)].idx_q] = value
    mujoco.mj_kinematics(theirs, state)
    pin.framesForwardKinematics(ours, data, q)
    base = state.body("base").xpos
    for name in ("first", "left_finger", "right_finger"):
        np.testing.assert_allclose(data.oMf[ours.getFrameId(name)].translation, state.body(name).xpos - base, atol=1e-9)
